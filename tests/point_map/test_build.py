"""Point maps of made drives: ground where it is, no trails of what moved, level intensity."""

from dataclasses import replace

import numpy as np
import pytest

from hdmap_tools.config import PointsConfig
from hdmap_tools.errors import CRSMismatchError, PointMapError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.point_map.build import build_point_map
from hdmap_tools.point_map.moving import estimate_lidar_position
from hdmap_tools.point_map.posed_drive import PosedDrive
from hdmap_tools.readers.drive import Drive, Sweep

from .scenes import LIDAR_EGO, Scene, drive_through

PLAIN = PointsConfig(remove_moving=False, normalize_intensity=False)


def build(tmp_path, *drives: Drive, config=PLAIN, name="points"):
    folder = tmp_path / name
    folder.mkdir()
    return build_point_map([PosedDrive.as_given(d) for d in drives], folder, config)


def everything(point_map):
    return point_map.points_in(point_map.bounds_m)


PARKED = (14.0, 2.5, 18.5, 4.3, 1.5)
POLE = (20.0, -5.05, 20.1, -4.95, 4.0)
WALL = (-20.0, 9.0, 70.0, 9.3, 4.0)
STATIC = (PARKED, POLE, WALL)


def moving_boxes(t):
    """One that drives ahead, one that comes, and somebody who crosses."""
    return (
        (12 + 9 * t, -0.9, 16.5 + 9 * t, 0.9, 1.5),
        (60 - 10 * t, 5.0, 64.5 - 10 * t, 6.8, 1.5),
        (26.0, -8 + 1.4 * t, 26.4, -7.6 + 1.4 * t, 1.8),
    )


@pytest.fixture(scope="module")
def traffic():
    return drive_through(Scene(lambda t: (*STATIC, *moving_boxes(t))), 36)


def inside(points, box, margin=0.12):
    x0, y0, x1, y1, _ = box
    x, y = points[:, 0], points[:, 1]
    return ((x > x0 - margin) & (x < x1 + margin) & (y > y0 - margin) & (y < y1 + margin)) & (
        points[:, 2] > 0.12
    )


def test_what_moved_leaves_no_trail_and_all_else_stays(traffic, tmp_path):
    before = everything(build(tmp_path, traffic)).points_city
    config = PLAIN.model_copy(update={"remove_moving": True})
    after_map = build(tmp_path, traffic, config=config, name="clean")
    after = everything(after_map).points_city

    def trail(points):
        is_trail = np.zeros(len(points), dtype=bool)
        for t in 0.1 * np.arange(36):
            for box in moving_boxes(t):
                is_trail |= inside(points, box)
        for box in STATIC:
            is_trail &= ~inside(points, box)
        return is_trail

    assert trail(before).sum() > 8000
    assert trail(after).sum() < 0.12 * trail(before).sum()
    high = after[trail(after), 2] > 0.4  # what could hide ground from a camera
    assert high.sum() < 0.06 * (before[trail(before), 2] > 0.4).sum()
    for box in STATIC:
        assert inside(after, box).sum() >= 0.99 * inside(before, box).sum() > 0
    ground = [(points[:, 2] < 0.05).sum() for points in (before, after)]
    assert ground[1] > 0.9995 * ground[0]


@pytest.mark.parametrize("slope", [0.0, 0.06])
def test_the_ground_is_where_it_is(slope, tmp_path):
    scene = Scene(lambda t: (PARKED,), slope=slope)
    made = build(tmp_path, drive_through(scene, 20, noise_m=0.02))
    points = everything(made)
    near = points.is_ground & (np.abs(points.points_city[:, 1]) < 10)
    near &= (points.points_city[:, 0] > -5) & (points.points_city[:, 0] < 25)
    near &= ~inside(points.points_city + (0, 0, 1.0), PARKED, 0.5)
    error = points.points_city[near, 2] - scene.height(points.points_city[near, 0])
    assert near.sum() > 50_000
    assert np.sqrt(np.mean(error**2)) < 0.004
    xy = np.random.default_rng(0).uniform([2, -4], [12, 2], (500, 2))
    heights = made.ground_at(xy)
    assert np.isfinite(heights).all()
    assert np.abs(heights - scene.height(xy[:, 0])).max() < 0.02
    standing = points.points_city[~points.is_ground]
    assert inside(standing, PARKED).mean() > 0.95
    index = made.tile_indices()[len(made.tile_indices()) // 2]
    assert 0 <= np.median(made.read_tile(index).roughness_mm) < 10


def test_points_are_thinned_to_one_a_voxel_and_sorted(traffic, tmp_path):
    made = build(tmp_path, traffic)
    hits = 0
    for index in made.tile_indices():
        tile = made.read_tile(index)
        x, y, _ = (tile.points_mm // 50).T
        flat = tile.points_mm[~tile.is_ground] // 50
        assert (np.diff(tile.cell.astype(int)) >= 0).all()
        np.testing.assert_array_equal(tile.cell, (y // 4) * 128 + x // 4)
        # Rounding to the millimetre may move a mean over a voxel's edge.
        assert len(np.unique(flat, axis=0)) >= 0.98 * len(flat)
        hits += int(tile.hits.sum())
    sweeps = [traffic.read_sweep(ref).points_ego for ref in traffic.sweeps]
    ranges = [np.linalg.norm(points[:, :2], axis=1) for points in sweeps]
    assert hits == sum(int(((r <= 40.0) & (r >= 2.5)).sum()) for r in ranges)


def test_two_drives_and_their_order_and_what_is_put_aside_give_the_same_points(tmp_path):
    one = drive_through(Scene(), 12, name="one", speed_m_s=40.0)
    two = drive_through(Scene(), 12, name="two", speed_m_s=40.0, origin=(10.0, 1.0))
    both = everything(build(tmp_path, one, two, name="a"))
    turned = everything(build(tmp_path, two, one, name="b"))
    np.testing.assert_array_equal(both.points_city, turned.points_city)
    np.testing.assert_array_equal(both.is_ground, turned.is_ground)
    assert sorted(d.id for d in build(tmp_path, two, one, name="c").meta.drives) == [
        "made:one",
        "made:two",
    ]


def gains(ring, distance, y):
    """Asphalt 20 and paint 80 (|y| near 2) through known gains of rings and a loss over range."""
    reflectivity = np.where(np.abs(np.abs(y) - 2.0) < 0.1, 80.0, 20.0)
    return reflectivity * np.where(ring % 2, 1.6, 0.8) * np.exp(-distance / 25.0) * 2.0


def test_intensity_is_freed_of_ring_and_range(tmp_path):
    drive = drive_through(Scene(intensity=gains), 25)
    config = PLAIN.model_copy(update={"normalize_intensity": True})
    for normalized, chosen in ((False, PLAIN), (True, config)):
        made = build(tmp_path, drive, config=chosen, name=f"n{normalized}")
        points = everything(made)
        x, y = points.points_city[:, 0], points.points_city[:, 1]
        near = points.is_ground & (np.abs(y) < 8) & (x > -15) & (x < 30)
        is_paint = np.abs(np.abs(y) - 2.0) < 0.05
        is_road = np.abs(np.abs(y) - 2.0) > 0.15
        road = points.intensity[near & is_road].astype(float)
        paint = points.intensity[near & is_paint].astype(float)
        spread = road.std() / road.mean()
        if normalized:
            assert spread < 0.12
            assert abs(np.median(road) - made.meta.asphalt_intensity) < 2
            assert abs(np.median(paint) / np.median(road) - 4.0) < 0.4
            assert (paint > road.max()).mean() > 0.95
        else:
            assert spread > 0.25
            assert made.meta.asphalt_intensity is None


def test_the_lidar_is_found_by_its_cones(traffic):
    sweeps = [traffic.read_sweep(ref) for ref in traffic.sweeps[::12]]
    np.testing.assert_allclose(estimate_lidar_position(sweeps), LIDAR_EGO, atol=0.03)
    unknown = [Sweep(s.timestamp_ns, s.points_ego, s.intensity, s.ring * 0) for s in sweeps]
    np.testing.assert_array_equal(estimate_lidar_position(unknown), [0.0, 0.0, 1.8])


def test_drives_that_give_no_map_are_refused(traffic, tmp_path):
    with pytest.raises(PointMapError, match="no lidar sweep"):
        build(tmp_path, replace(traffic, sweeps=()), name="a")
    with pytest.raises(PointMapError, match="same id"):
        build(tmp_path, traffic, traffic, name="b")
    elsewhere = replace(traffic, name="other", frame=MapFrame.from_origin(49.0, 8.4))
    with pytest.raises(CRSMismatchError):
        build(tmp_path, traffic, elsewhere, name="c")

    def in_the_sky(ref):
        sweep = traffic.read_sweep(ref)
        up = SE3(np.eye(3), np.array([0.0, 0.0, 30.0])).transform_from(sweep.points_ego)
        return Sweep(sweep.timestamp_ns, up, sweep.intensity, sweep.ring)

    with pytest.raises(PointMapError, match="No ground"):
        build(tmp_path, replace(traffic, read_sweep=in_the_sky), name="d")

    def nothing(ref):
        none = np.zeros(0, np.uint8)
        return Sweep(ref.timestamp_ns, np.zeros((0, 3)), none, none)

    with pytest.raises(PointMapError, match="No ground"):
        build(tmp_path, replace(traffic, read_sweep=nothing), name="e")
