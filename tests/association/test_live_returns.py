"""What stands in a sweep by the ground of the map: exact scenes, and where the map knows nothing."""

from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.association.live_returns import LiveReturns, clip_of
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.point_map.ground_window import GroundHeights
from hdmap_tools.point_map.point_map import PointMap, PointMapMeta, PointTile
from hdmap_tools.readers.drive import Drive, Sweep, SweepRef
from hdmap_tools.testing.street import camera

SIDE, CELL_MM = 128, 200
CONFIG = AssociationConfig()


def height_m(x, y):
    return 30.0 + 0.06 * x - 0.03 * y


def tile(index, known):
    """Ground in the cells for which known(x, y), city metres, is true; one point."""
    row, column = np.divmod(np.arange(SIDE * SIDE), SIDE)
    x = index[0] * 25.6 + (column + 0.5) * 0.2
    y = index[1] * 25.6 + (row + 0.5) * 0.2
    cells = np.flatnonzero(known(x, y))
    number = len(cells)
    return PointTile(
        np.zeros((1, 3), np.int32),
        np.zeros(1, np.uint8),
        np.ones(1, np.int32),
        np.ones(1, bool),
        np.zeros(1, np.uint16),
        cells.astype(np.uint16),
        np.rint(1000 * height_m(x[cells], y[cells])).astype(np.int32),
        np.zeros(number, np.int32),
        np.ones(number, np.int32),
    )


@pytest.fixture
def points(tmp_path):
    def known(x, y):
        return (np.abs(y) < 12.0) & ~((x > 3.0) & (x < 5.0)) & (x < 40.0)

    indices = [(x, y) for x in range(-2, 3) for y in (-1, 0)]
    return PointMap.create(
        tmp_path / "points", PointMapMeta(), [(i, tile(i, known)) for i in indices]
    )


def drive(points_ego, ring=None):
    """A drive with one sweep, at a pose that is level with the sloping ground."""
    pose = SE3.from_yaw(0.4, (1.0, -2.0, float(height_m(1.0, -2.0))))
    sweep = Sweep(
        10,
        points_ego,
        np.zeros(len(points_ego), np.uint8),
        np.zeros(len(points_ego), np.uint8) if ring is None else ring,
    )
    trajectory = Trajectory(
        np.array([0, 20]), np.stack([pose.rotation] * 2), np.stack([pose.translation] * 2)
    )
    refs = (SweepRef(10, Path("10"), "lidar"),)
    made = Drive("d", "made", Path(), MapFrame(), trajectory, {}, (), refs, lambda _: sweep)
    return made, pose, refs[0]


def scene(pose, shift_m=0.0):
    """Ground in the clip and around it, and what stands on it: their ego positions."""
    rng = np.random.default_rng(0)
    xy = rng.uniform((-20, -25), (40, 25), (6000, 2))
    ground = np.column_stack([xy, height_m(*xy.T) + rng.uniform(-0.08, 0.08, len(xy)) + shift_m])
    standing = ground[:900] + (0, 0, 0.12) + rng.uniform(0, 2, (900, 1)) * (0, 0, 1) + (0, 0, 0.1)
    into = pose.inverse()
    return into.transform_from(ground), into.transform_from(standing)


@pytest.mark.parametrize("shift_m", [0.0, 0.3, -0.3])
def test_what_is_not_at_the_height_of_the_ground_stands(points, shift_m):
    _, pose, _ = drive(np.zeros((1, 3)))
    ground, standing = scene(pose, shift_m)
    made, _, ref = drive(np.concatenate([ground, standing]))
    cam = camera()
    found = LiveReturns(made, points, CONFIG, 0.5).standing_city(ref, cam, pose)
    x0, x1, y0, y1 = clip_of(CONFIG, cam)

    def in_clip(ego):
        return (ego[:, 0] >= x0) & (ego[:, 0] <= x1) & (ego[:, 1] >= y0) & (ego[:, 1] <= y1)

    expected = pose.transform_from(standing[in_clip(standing)])
    assert 100 < len(expected) < 900
    # The middle of noisy ground is known to a centimetre or two: what is near the limit may differ.
    rows = {tuple(np.round(row, 6)) for row in found}
    missing = [row for row in expected if tuple(np.round(row, 6)) not in rows]
    assert len(missing) <= 0.02 * len(expected)
    assert len(found) - (len(expected) - len(missing)) <= 0.02 * in_clip(ground).sum()


def test_where_no_ground_is_known_everything_stands(points):
    made, pose, ref = drive(np.array([[5.0, 0.0, 0.0], [6.0, 1.0, 1.0]]))
    away = SE3(pose.rotation, pose.translation + (500.0, 0.0, 0.0))
    far = LiveReturns(made, points, CONFIG, 0.5)
    assert len(far.standing_city(ref, camera(), pose)) == 1
    elsewhere = drive(np.array([[5.0, 0.0, 0.0], [6.0, 1.0, 1.0]]))[0]
    trajectory = Trajectory(
        np.array([0, 20]), np.stack([away.rotation] * 2), np.stack([away.translation] * 2)
    )
    object.__setattr__(elsewhere, "trajectory", trajectory)
    assert len(LiveReturns(elsewhere, points, CONFIG, 0.5).standing_city(ref, camera(), away)) == 2


def test_rings_are_measured_on_the_whole_drive(points):
    azimuth = np.linspace(-np.pi, np.pi, 400)
    rings = np.arange(16)
    slope = np.tan(np.deg2rad(-15.0 + 1.0 * rings))
    flat = np.full(400, 20.0)
    sweep = np.concatenate(
        [
            np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), 1.8 + flat * s])
            for s in slope
        ]
    )
    made, _, _ = drive(sweep, np.repeat(rings, 400).astype(np.uint8))
    assert LiveReturns(made, points, CONFIG, 0.5).ring_gap_deg("lidar") == pytest.approx(
        1.1, abs=0.05
    )


def test_ground_of_cells_without_is_that_of_the_nearest_up_to_four_metres(points):
    ground = GroundHeights(points)
    heights, first = ground.window(np.array([-30.0, -14.0]), np.array([30.0, 20.0]))
    assert heights.shape == (171, 301)
    assert first == (-150, -70)
    y, x = np.mgrid[: heights.shape[0], : heights.shape[1]]
    x, y = (x + first[0] + 0.5) * 0.2, (y + first[1] + 0.5) * 0.2
    known = (np.abs(y) < 12.0) & ~((x > 3.0) & (x < 5.0))
    np.testing.assert_allclose(heights[known], height_m(x, y)[known], atol=6e-4)
    gap = (np.abs(y) < 11.0) & (x > 3.0) & (x < 5.0)
    assert (np.abs(heights - height_m(x, y))[gap] < 0.07).all()
    beyond = (y > 16.2) | (y < -25.6)
    assert np.isnan(heights[beyond]).all()
    assert np.isfinite(heights[(y > 12) & (y < 15.8)]).all()
    nowhere, _ = ground.window(np.array([500.0, 500.0]), np.array([510.0, 510.0]))
    assert np.isnan(nowhere).all()
