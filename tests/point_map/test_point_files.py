"""Point clouds out and in: nothing lost, a place on earth kept, damage named."""

import sys

import numpy as np
import pytest

from hdmap_tools.config import PointsConfig
from hdmap_tools.errors import CRSMismatchError, MissingExtraError, PointMapError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.point_map.from_cloud import build_from_file, find_ground
from hdmap_tools.point_map.point_files import read_point_file, write_point_file
from hdmap_tools.point_map.values import MapPoints

FRAME = MapFrame.from_origin(49.01, 8.43, 115.0)
ELSEWHERE = MapFrame.from_crs("EPSG:25832", (49.0, 8.4), 100.0)


@pytest.fixture
def points():
    rng = np.random.default_rng(0)
    return MapPoints(
        rng.uniform(-50, 50, (1000, 3)) + (4e3, -3e3, 100),
        rng.integers(0, 256, 1000).astype(np.uint8),
        rng.random(1000) < 0.5,
    )


@pytest.mark.parametrize("suffix", ["pcd", "ply", "las", "laz"])
def test_what_is_written_comes_back_and_is_the_same_again(points, tmp_path, suffix):
    path = tmp_path / f"p.{suffix}"
    if suffix in ("las", "laz"):
        pytest.importorskip("laspy")
    assert write_point_file(path, [points], FRAME) == 1000
    first = path.read_bytes()
    write_point_file(path, [points], FRAME, overwrite=True)
    assert path.read_bytes() == first
    cloud = read_point_file(path)
    atol = 0.00051 if suffix in ("las", "laz") else 0.0
    np.testing.assert_allclose(cloud.in_frame(FRAME), points.points_city, rtol=0, atol=atol)
    np.testing.assert_array_equal(cloud.intensity, points.intensity)
    np.testing.assert_array_equal(cloud.is_ground, points.is_ground)


def test_a_georeferenced_file_is_brought_into_another_frame(points, tmp_path):
    pytest.importorskip("laspy")
    path = tmp_path / "p.las"
    write_point_file(path, [points], ELSEWHERE)
    cloud = read_point_file(path)
    expected = FRAME.from_wgs84(ELSEWHERE.to_wgs84(points.points_city))
    np.testing.assert_allclose(cloud.in_frame(FRAME), expected, atol=0.002)
    with pytest.raises(CRSMismatchError, match="--origin"):
        cloud.in_frame(MapFrame())


def test_points_with_nan_are_left_out(points, tmp_path):
    path = tmp_path / "p.pcd"
    broken = points.points_city.copy()
    broken[::10] = np.nan
    write_point_file(path, [MapPoints(broken, points.intensity, points.is_ground)], FRAME)
    cloud = read_point_file(path)
    assert (len(cloud), cloud.num_dropped) == (900, 100)
    write_point_file(
        path, [MapPoints(broken * np.nan, points.intensity, points.is_ground)], FRAME, True
    )
    with pytest.raises(PointMapError, match="0 of them usable"):
        read_point_file(path)


@pytest.mark.parametrize("suffix", ["pcd", "ply", "las", "laz"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.95])
def test_a_file_cut_short_is_named(points, tmp_path, suffix, share):
    if suffix in ("las", "laz"):
        pytest.importorskip("laspy")
    path = tmp_path / f"p.{suffix}"
    write_point_file(path, [points], FRAME)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(PointMapError, match=path.name):
        read_point_file(path)


def test_without_laspy_the_pip_line_is_given(points, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'hdmap-tools\[lidar\]'"):
        write_point_file(tmp_path / "p.laz", [points], FRAME)


def street(rng):
    """A road on a slope with a kerb, a wall, a car and noise; which points are ground."""
    xy = rng.uniform([0, -15], [60, 15], (120_000, 2))
    kerb = np.where(np.abs(xy[:, 1]) > 5, 0.12, 0.0)
    ground = np.column_stack([xy, 0.05 * xy[:, 0] + kerb + rng.normal(0, 0.01, len(xy))])
    car = rng.uniform([20, 1, 0.25], [24.5, 2.8, 1.5], (4000, 3)) + (0, 0, 1.1)
    wall = rng.uniform([0, 14.9, 0.3], [60, 15, 5.0], (9000, 3))
    wall[:, 2] += 0.05 * wall[:, 0] + 0.12
    points = np.concatenate([ground, car, wall])
    return points, np.arange(len(points)) < len(ground)


def test_ground_is_found_in_a_cloud_without_classes():
    points, is_ground = street(np.random.default_rng(1))
    found = find_ground(points, 0.1)
    assert (found & is_ground).sum() > 0.97 * is_ground.sum()
    assert (found & ~is_ground).sum() < 0.03 * (~is_ground).sum()


def test_a_point_map_is_made_from_a_cloud_of_someone_else(tmp_path):
    points, _ = street(np.random.default_rng(1))
    path, folder = tmp_path / "p.ply", tmp_path / "map"
    folder.mkdir()
    flat = np.zeros(len(points), np.uint8)
    write_point_file(path, [MapPoints(points, flat, np.zeros(len(points), bool))], MapFrame())
    made = build_from_file(path, folder, PointsConfig(), MapFrame())
    assert made.meta.source == "p.ply"
    xy = np.random.default_rng(2).uniform([2, -4.5], [18, 4.5], (300, 2))
    height = made.ground_at(xy)
    known = np.isfinite(height)  # with 2.7 points a cell, a few cells have none
    assert known.mean() > 0.95
    np.testing.assert_allclose(height[known], 0.05 * xy[known, 0], atol=0.025)
