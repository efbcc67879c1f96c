"""The store: what is written comes back, what is damaged is named."""

import json

import numpy as np
import pytest

from hdmap_tools.errors import PointMapError
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.point_map.point_map import (
    DriveOfPoints,
    PointMap,
    PointMapMeta,
    PointTile,
    is_point_map,
)

SIDE = 128
TRAJECTORY = Trajectory(
    np.array([5, 10]),
    np.array([SE3.from_yaw(a).rotation for a in (0.1, 0.2)]),
    np.array([[-3.0, 2.0, 1.0], [4.0, 2.0, 1.0]]),
)


def tile(seed, count=3000):
    """Random points, sorted by cell; a tilted ground in every cell of the western half."""
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 25_600, (count, 3)).astype(np.int32)
    cell = (points[:, 1] // 200) * SIDE + points[:, 0] // 200
    order = np.argsort(cell, kind="stable")
    cells = np.flatnonzero(np.arange(SIDE * SIDE) % SIDE < SIDE // 2)
    height = (cells % SIDE) * 10
    return PointTile(
        points[order],
        rng.integers(0, 256, count).astype(np.uint8),
        np.ones(count, np.int32),
        rng.random(count) < 0.5,
        cell[order].astype(np.uint16),
        cells.astype(np.uint16),
        height.astype(np.int32),
        np.full(len(cells), 3, np.int32),
        np.ones(len(cells), np.int32),
    )


TILES = {index: tile(number) for number, index in enumerate([(-1, 0), (0, 0), (3, -2)])}
META = PointMapMeta(
    drives=(DriveOfPoints(id="made:a/b", poses="0_a.feather", is_refined=True, num_sweeps=2),)
)


@pytest.fixture
def made(tmp_path):
    return PointMap.create(tmp_path / "points", META, TILES.items(), {"made:a/b": TRAJECTORY})


def all_points():
    return np.concatenate([t.to_points(i).points_city for i, t in sorted(TILES.items())])


def test_what_is_written_comes_back(made):
    again = PointMap.open(made.path)
    assert again.meta == made.meta
    assert again.tile_indices() == ((-1, 0), (0, 0), (3, -2))
    assert again.num_points == 9000
    assert again.bounds_m == (-25.6, -51.2, 102.4, 25.6)
    for index, written in TILES.items():
        read = again.read_tile(index)
        for name in PointTile.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    poses = again.trajectory_of("made:a/b")
    np.testing.assert_array_equal(poses.timestamps_ns, TRAJECTORY.timestamps_ns)
    np.testing.assert_allclose(poses.rotations, TRAJECTORY.rotations, atol=1e-15)
    assert again.trajectory_of("made:other") is None


@pytest.mark.parametrize(
    "bounds",
    [(-25.6, 0, 0, 25.6), (-3.3, 2.2, 7.7, 9.1), (0.0, 0.0, 0.05, 0.05), (-99, -99, 200, 99)],
)
def test_points_in_bounds_are_those_whose_cells_touch_them(made, bounds):
    points = all_points()
    x0, y0, x1, y1 = bounds
    cell = np.floor(points[:, :2] / 0.2 + 1e-9)
    low, high = np.floor(np.array([x0, y0]) / 0.2), np.floor(np.array([x1, y1]) / 0.2)
    expected = points[((cell >= low) & (cell <= high)).all(axis=1)]
    found = made.points_in(bounds)
    key = np.lexsort
    np.testing.assert_allclose(
        found.points_city[key(found.points_city.T)], expected[key(expected.T)], atol=1e-9
    )


def test_points_where_there_is_no_tile_are_none(made):
    assert len(made.points_in((500.0, 500.0, 520.0, 520.0))) == 0


def test_the_ground_is_known_between_cells_and_across_tiles_and_nowhere_else(made):
    xy = np.array([[0.1, 3.0], [3.33, 3.05], [12.0, 20.0], [20.0, 3.0], [300.0, 0.0], [-0.1, 3.0]])
    found = made.ground_at(xy)
    # Cell k of a row is at (k + 0.5) * 0.2 m and 10 k mm high.
    np.testing.assert_allclose(found[:3], (xy[:3, 0] / 0.2 - 0.5) * 0.01, atol=1e-9)
    assert np.isnan(found[3:]).all()


def test_the_same_points_give_the_same_bytes(made, tmp_path):
    again = PointMap.create(tmp_path / "again", META, TILES.items(), {"made:a/b": TRAJECTORY})
    files = sorted(p.relative_to(made.path) for p in made.path.rglob("*") if p.is_file())
    assert len(files) == 8
    for name in files:
        assert (made.path / name).read_bytes() == (again.path / name).read_bytes()


def test_a_drive_elsewhere_is_refused_with_both_bounds(made):
    made.require_overlap(TRAJECTORY, "near")
    away = Trajectory(
        TRAJECTORY.timestamps_ns, TRAJECTORY.rotations, TRAJECTORY.translations + (900.0, 0.0, 0.0)
    )
    with pytest.raises(PointMapError, match=r"x -26 to 102.*x 897 to 904"):
        made.require_overlap(away, "far")


def test_damage_is_named(made, tmp_path):
    path = made.path / "tiles" / "0_0.feather"
    whole = path.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", b"ARROW1"):
        path.write_bytes(damage)
        with pytest.raises(PointMapError, match=r"0_0\.feather.*truncated"):
            PointMap.open(made.path).read_tile((0, 0))
    path.write_bytes((made.path / "tiles" / "-1_0.feather").read_bytes())
    with pytest.raises(PointMapError, match=r"0_0\.feather.*another tile"):  # as many points
        PointMap.open(made.path).read_tile((0, 0))
    meta = made.path / "meta.json"
    document = json.loads(meta.read_text())
    for tile in document["tiles"]:  # a map that was written without them
        del tile["points_crc32"], tile["cells_crc32"]
    meta.write_text(json.dumps(document))
    PointMap.open(made.path).read_tile((0, 0))
    path.write_bytes((made.path / "cells" / "0_0.feather").read_bytes())
    with pytest.raises(PointMapError, match="no column x_mm"):
        PointMap.open(made.path).read_tile((0, 0))
    path.unlink()
    with pytest.raises(PointMapError, match="missing"):
        PointMap.open(made.path).points_in((0, 0, 1, 1))


def test_what_is_no_point_map_is_refused(made, tmp_path):
    with pytest.raises(PointMapError, match="hdmap points"):
        PointMap.open(tmp_path)
    assert is_point_map(made.path)
    meta = made.path / "meta.json"
    document = json.loads(meta.read_text())
    for change, says in (
        ({"schema_version": 2}, "schema_version"),
        ({"cell_mm": 333}, "must divide"),
        ({"frame_document": {}}, "frame"),
        ({"tiles": "many"}, "tiles"),
    ):
        meta.write_text(json.dumps(document | change))
        with pytest.raises(PointMapError, match=says):
            PointMap.open(made.path)
    meta.write_text("[")
    with pytest.raises(PointMapError, match="cannot be read"):
        PointMap.open(made.path)
    assert not is_point_map(made.path)


def test_a_map_without_a_point_is_not_made(tmp_path):
    with pytest.raises(PointMapError, match="No points"):
        PointMap.create(tmp_path / "none", PointMapMeta(), [])
