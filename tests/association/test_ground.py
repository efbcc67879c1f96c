import numpy as np
import pytest

from hdmap_tools.association.ground import GroundedSweep, estimate_ground
from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.testing.street import Street, flat, slope, stripes

BOX = (12.0, -1.0, 16.0, 1.0, 1.8)


@pytest.mark.parametrize("height", [flat, slope])
def test_ground_points_are_found_and_no_others(height):
    points = Street(height, stripes, BOX).sweep(SE3.identity()).points_ego
    surface = estimate_ground(points)
    true_height = points[:, 2] - height(points[:, 0], points[:, 1])
    found = surface.is_near(points, 0.1)
    within = np.linalg.norm(points[:, :2], axis=1) < 40.0
    assert found[within & (np.abs(true_height) < 0.01)].mean() > 0.97
    assert not found[true_height > 0.25].any()


def test_heights_between_the_rings_are_right_on_a_slope():
    points = Street(slope, stripes).sweep(SE3.identity()).points_ego
    x, y = np.meshgrid(np.linspace(4.0, 25.0, 60), np.linspace(-4.0, 4.0, 20))
    xy = np.column_stack([x.ravel(), y.ravel()])
    error = estimate_ground(points).height_at(xy) - slope(xy[:, 0], xy[:, 1])
    assert np.isfinite(error).all()
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_ground_is_not_guessed_far_from_ground_that_was_seen():
    points = Street(flat, stripes).sweep(SE3.identity()).points_ego
    near = points[np.linalg.norm(points[:, :2], axis=1) < 20.0]
    height = estimate_ground(near).height_at(np.array([[10.0, 0.0], [60.0, 0.0]]))
    assert np.isfinite(height[0])
    assert np.isnan(height[1])


def test_single_returns_from_below_do_not_pull_the_ground_down():
    rng = np.random.default_rng(0)
    points = Street(flat, stripes).sweep(SE3.identity()).points_ego
    ghosts = np.column_stack([rng.uniform(-30, 30, (60, 2)), rng.uniform(-3, -1, 60)])
    surface = estimate_ground(np.concatenate([points, ghosts]))
    height = surface.height_at(np.array([[8.0, 1.0], [-7.0, 3.0], [15.0, -5.0]]))
    assert np.abs(height).max() < 0.05


def test_an_ego_frame_above_the_ground_is_no_matter():
    points = Street(flat, stripes).sweep(SE3.identity()).points_ego - (0.0, 0.0, 0.33)
    assert estimate_ground(points).height_at(np.array([[8.0, 0.0]]))[0] == pytest.approx(
        -0.33, abs=0.02
    )


def test_the_plane_through_the_ground():
    tilted = Street(lambda x, y: 0.02 * x - 0.01 * y, stripes).sweep(SE3.identity()).points_ego
    a, b, c = estimate_ground(tilted).plane()
    assert (a, b, c) == pytest.approx((0.02, -0.01, 0.0), abs=0.004)


def test_no_points_no_ground():
    surface = estimate_ground(np.zeros((0, 3)))
    assert np.isnan(surface.height_at(np.array([[1.0, 1.0]])))
    assert surface.plane() is None
    assert not surface.is_near(np.array([[5.0, 0.0, 0.0]]), 0.1)


def test_points_of_the_wrong_shape_are_refused():
    with pytest.raises(ShapeError, match=r"\(N, 3\), found \(4, 2\)"):
        estimate_ground(np.zeros((4, 2)))


def test_a_grounded_sweep_is_in_the_city_frame():
    pose = SE3.from_yaw(0.7, (100.0, -40.0, 0.0))
    sweep = Street(flat, stripes).sweep(pose)
    grounded = GroundedSweep.from_sweep(sweep, pose, 40.0, 0.1)
    np.testing.assert_allclose(grounded.points_city, pose.transform_from(sweep.points_ego))
    assert grounded.is_ground.mean() > 0.9
