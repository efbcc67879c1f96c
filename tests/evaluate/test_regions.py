"""Which cells a drive passed and how its road runs, against cells counted one by one."""

import numpy as np
import pytest

from hdmap_tools.evaluate.regions import GRADE_CHANGE_M, SLOPE, passed_mask, terrain_masks
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.se3 import SE3, Trajectory

GRID = BevGrid(0.5, -40, -30, 50, 60)
"""Not square about the origin, so that swapped axes show."""


def cells_where(true) -> np.ndarray:
    """(y, x) bool of a condition on the cells' centres."""
    x, y = np.meshgrid(GRID.x_centres_m, GRID.y_centres_m)
    return true(x, y)


@pytest.mark.parametrize(
    ("yaw_deg", "at", "true"),
    [
        (0, (0, 0), lambda x, y: (x > 0) & (x < 10) & (abs(y) < 3)),
        (90, (0, 0), lambda x, y: (y > 0) & (y < 10) & (abs(x) < 3)),
        (180, (0, 0), lambda x, y: (x > -10) & (x < 0) & (abs(y) < 3)),
        (-90, (2, 1), lambda x, y: (y > -9) & (y < 1) & (abs(x - 2) < 3)),
        # A quarter of a cell over: the same centres. Three quarters: one column on.
        (0, (0.125, 0.0), lambda x, y: (x > 0) & (x < 10) & (abs(y) < 3)),
        (0, (0.375, 0.0), lambda x, y: (x > 0.5) & (x < 10.5) & (abs(y) < 3)),
    ],
)
def test_the_clip_of_one_pose_to_the_cell(yaw_deg, at, true):
    pose = SE3.from_yaw(np.radians(yaw_deg), (*at, 5.0))
    found = passed_mask(GRID, [pose], (0.0, 10.0), 3.0)
    np.testing.assert_array_equal(found, cells_where(true))
    assert found.sum() == 20 * 12


def test_a_turned_clip_holds_the_centres_that_its_pose_takes_into_it():
    pose = SE3.from_yaw(0.6, (3.1, 4.7, 0.0))
    x, y = np.meshgrid(GRID.x_centres_m, GRID.y_centres_m)
    ego = pose.inverse().transform_from(np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]))
    inside = (ego[:, 0] > 4) & (ego[:, 0] <= 9) & (abs(ego[:, 1]) <= 2.5)
    found = passed_mask(GRID, [pose], (4.0, 9.0), 2.5)
    np.testing.assert_array_equal(found.ravel(), inside)


def test_poses_add_up_and_what_lies_outside_the_grid_is_left_out():
    near, far = SE3.from_yaw(0.0), SE3.from_yaw(0.0, (22.0, 0.0, 0.0))
    away = SE3.from_yaw(1.0, (500.0, -800.0, 0.0))
    both = passed_mask(GRID, [near, far, away], (0.0, 10.0), 3.0)
    np.testing.assert_array_equal(
        both,
        cells_where(lambda x, y: (((x > 0) & (x < 10)) | (x > 22)) & (abs(y) < 3)),
    )
    assert not passed_mask(GRID, [away], (0.0, 10.0), 3.0).any()
    assert not passed_mask(GRID, [], (0.0, 10.0), 3.0).any()


def along_x(height) -> Trajectory:
    """Driven from x = -15 m to 20 m at y = 5 m, at a height by x."""
    x = np.arange(-15.0, 20.01, 0.25)
    places = np.column_stack([x, np.full(len(x), 5.0), height(x)])
    times = np.arange(len(x), dtype=np.int64) * 10**8
    return Trajectory(times, np.tile(np.eye(3), (len(x), 1, 1)), places)


def test_a_level_road_is_flat_as_far_as_it_reaches():
    masks = terrain_masks(GRID, along_x(lambda x: 0 * x), reach_m=6.0)
    assert set(masks) == {"flat", "sloped", "bent"}
    assert not masks["sloped"].any()
    assert not masks["bent"].any()
    rows, cols = np.nonzero(masks["flat"])
    assert (GRID.x_centres_m[cols].min(), GRID.x_centres_m[cols].max()) == (-19.75, 24.75)
    assert (GRID.y_centres_m[rows].min(), GRID.y_centres_m[rows].max()) == (-0.75, 10.75)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_ramp_is_sloped_and_not_bent(sign):
    steep = terrain_masks(GRID, along_x(lambda x: sign * 1.2 * SLOPE * x), reach_m=3.0)
    assert steep["sloped"].sum() > 500
    assert not steep["flat"].any()
    assert not steep["bent"].any()
    gentle = terrain_masks(GRID, along_x(lambda x: sign * 0.8 * SLOPE * x), reach_m=3.0)
    assert not gentle["sloped"].any()
    np.testing.assert_array_equal(gentle["flat"], steep["sloped"])


def test_a_crest_is_bent_from_where_the_road_leaves_the_plane():
    """Level up to x = 0, then falling 4 in 100: 0.1 m below the plane at 2.5 m, and bent for 10 m."""
    masks = terrain_masks(GRID, along_x(lambda x: -0.04 * np.maximum(x, 0.0)), reach_m=2.0)
    _, cols = np.nonzero(masks["bent"])
    bent_x = GRID.x_centres_m[cols]
    first_m = GRADE_CHANGE_M / 0.04
    assert bent_x.min() == pytest.approx(first_m, abs=1.0)
    # Seen from beyond the crest, the falling road is a plane again.
    assert bent_x.max() == pytest.approx(10.0, abs=1.0)
    _, cols = np.nonzero(masks["sloped"])
    assert GRID.x_centres_m[cols].min() == pytest.approx(0.0, abs=1.0)


def test_a_drive_that_stands_still_has_terrain_too():
    still = Trajectory(np.array([0]), np.eye(3)[None], np.array([[1.0, 2.0, 3.0]]))
    masks = terrain_masks(GRID, still, reach_m=2.0)
    x, y = np.meshgrid(GRID.x_centres_m, GRID.y_centres_m)
    np.testing.assert_array_equal(masks["flat"], np.hypot(x - 1, y - 2) < 2.0)
    waiting = Trajectory(np.array([0, 10**9]), np.tile(np.eye(3), (2, 1, 1)), np.ones((2, 3)))
    assert terrain_masks(GRID, waiting)["flat"].any()
