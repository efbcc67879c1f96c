"""Mounts against the truth, and what is reported of their error against their error."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmap_tools.calibration.extrinsics import estimate_extrinsics
from hdmap_tools.calibration.pairs import Pairs
from hdmap_tools.errors import CalibrationError, ConfigError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3

FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes in those of the vehicle, for a camera that looks ahead."""
LENS = PinholeCamera(
    "CAM", 1600, 900, 1250.0, 1255.0, 805.0, 440.0, SE3.identity(), (-0.1, 0.02, 5e-4, -4e-4, 0.0)
)
NOISE_PX = 0.5


def scene(rng, count=40, wrong=0.2, noise_px=NOISE_PX):
    """The true camera, pairs of it, and which of them are right."""
    turn = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()
    mount = SE3(FORWARD @ turn, np.array([1.5, 0.1, 1.6]) + rng.normal(0, 0.2, 3))
    camera = replace(LENS, ego_SE3_cam=mount)
    size = np.array([camera.width_px, camera.height_px])
    uv = rng.uniform(20, size - 20, (count, 2))
    points = mount.translation + camera.rays_ego(uv) * rng.uniform(4, 30, (count, 1))
    uv += rng.normal(0, noise_px, uv.shape)
    is_right = np.arange(count) >= round(wrong * count)
    uv[~is_right] = rng.uniform(20, size - 20, ((~is_right).sum(), 2))
    return camera, Pairs.of(points, uv), is_right


def errors(found, camera):
    """(6,) radians about the camera's axes, and metres along the ego axes."""
    got, true = found.camera.ego_SE3_cam, camera.ego_SE3_cam
    turn = Rotation.from_matrix(got.rotation.T @ true.rotation).as_rotvec()
    return np.concatenate([turn, true.translation - got.translation])


def test_noise_of_half_a_pixel_and_a_fifth_of_wrong_pairs():
    for seed in range(20):
        camera, pairs, is_right = scene(np.random.default_rng(seed))
        found = estimate_extrinsics(pairs, LENS)
        error = errors(found, camera)
        assert np.degrees(np.linalg.norm(error[:3])) < 0.1
        assert np.linalg.norm(error[3:]) < 0.02
        assert not (found.pose.is_used & ~is_right).any()
        assert found.pose.is_used.sum() >= is_right.sum() - 2
        assert found.camera.fx == LENS.fx


def coverage(count, wrong, num_seeds):
    """Normalized squared errors (S,), and which of 6 numbers lie in their interval (S, 6)."""
    squared, is_inside, free = [], [], []
    for seed in range(num_seeds):
        camera, pairs, _ = scene(np.random.default_rng(1000 + seed), count, wrong)
        found = estimate_extrinsics(pairs, LENS)
        error = errors(found, camera)
        squared.append(error @ np.linalg.solve(found.pose.covariance, error))
        half_width = found.interval_factor * np.sqrt(np.diag(found.pose.covariance))
        is_inside.append(np.abs(error) <= half_width)
        free.append(found.pose.degrees_of_freedom)
    return np.array(squared), np.array(is_inside), float(np.median(free))


def check_coverage(count, wrong, num_seeds):
    squared, is_inside, free = coverage(count, wrong, num_seeds)
    # 6 F(6, free): sigma is estimated from the same residuals.
    expected = 6 * free / (free - 2)
    spread = expected * np.sqrt(2 * (free + 4) / (6 * (free - 4)) / num_seeds)
    assert abs(squared.mean() - expected) < 4 * spread
    # The six numbers of one seed are correlated: count them as two.
    assert abs(is_inside.mean() - 0.95) < 4 * np.sqrt(0.95 * 0.05 / (2 * num_seeds))


def test_the_reported_covariance_is_that_of_the_error():
    check_coverage(count=40, wrong=0.2, num_seeds=120)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "wrong"), [(40, 0.2), (15, 0.2), (100, 0.4), (200, 0.0)])
def test_the_reported_covariance_is_that_of_the_error_over_many_seeds(count, wrong):
    check_coverage(count, wrong, num_seeds=200)


def test_the_estimated_noise_is_that_of_the_pixels():
    for noise_px in (0.1, 0.5, 1.5):
        camera, pairs, _ = scene(np.random.default_rng(3), 300, 0.1, noise_px)
        found = estimate_extrinsics(pairs, LENS)
        assert found.pose.sigma_px == pytest.approx(noise_px, rel=0.1)
        assert found.camera.name == camera.name


def test_exact_pairs_give_the_exact_mount():
    camera, pairs, _ = scene(np.random.default_rng(4), 12, 0.0, 0.0)
    found = estimate_extrinsics(pairs, LENS)
    assert np.abs(errors(found, camera)).max() < 1e-7
    assert found.pose.is_used.all()


def test_half_may_be_wrong():
    camera, pairs, is_right = scene(np.random.default_rng(5), 60, 0.5)
    found = estimate_extrinsics(pairs, LENS)
    assert np.linalg.norm(errors(found, camera)[3:]) < 0.03
    assert not (found.pose.is_used & ~is_right).any()
    assert any("pairs agree" in warning for warning in found.warnings)


def test_the_frame_of_the_points_does_not_matter():
    """A turn of the frame turns the result with it, whatever the camera looks at."""
    camera, pairs, _ = scene(np.random.default_rng(6))
    other_SE3_ego = SE3(
        Rotation.from_euler("xyz", [120, 40, -160], degrees=True).as_matrix(),
        np.array([3.0, 8, -5]),
    )
    moved = Pairs.of(other_SE3_ego.transform_from(pairs.points), pairs.uv)
    first = estimate_extrinsics(pairs, LENS).camera.ego_SE3_cam
    second = estimate_extrinsics(moved, LENS).camera.ego_SE3_cam
    np.testing.assert_allclose(second.matrix, (other_SE3_ego @ first).matrix, atol=1e-6)
    assert camera.ego_SE3_cam is not None


def test_the_order_of_the_pairs_and_the_seed_do_not_matter():
    _, pairs, _ = scene(np.random.default_rng(7))
    order = np.random.default_rng(0).permutation(len(pairs))
    first = estimate_extrinsics(pairs, LENS)
    second = estimate_extrinsics(Pairs.of(pairs.points[order], pairs.uv[order]), LENS, seed=5)
    np.testing.assert_allclose(
        first.camera.ego_SE3_cam.matrix, second.camera.ego_SE3_cam.matrix, atol=1e-8
    )
    assert np.array_equal(first.pose.is_used[order], second.pose.is_used)


def test_far_pairs_leave_the_position_weak_and_say_so():
    rng = np.random.default_rng(8)
    camera, pairs, _ = scene(rng, 20, 0.0)
    eye = camera.ego_SE3_cam.translation
    far = Pairs.of(eye + (pairs.points - eye) * 20, pairs.uv)
    found = estimate_extrinsics(far, LENS)
    assert found.sigma_position_m.max() > 0.02
    assert any("add pairs" in warning for warning in found.warnings)
    error = np.abs(errors(found, camera)[3:])
    assert (error < 4 * found.sigma_position_m).all()


@pytest.mark.parametrize("count", [0, 3, 4, 5])
def test_too_few_pairs(count):
    _, pairs, _ = scene(np.random.default_rng(9), 10, 0.0)
    few = Pairs.of(pairs.points[:count], pairs.uv[:count])
    with pytest.raises(CalibrationError, match=f"{count} pairs; expected at least 6"):
        estimate_extrinsics(few, LENS)


def seen_by(camera, points, rng, noise_px=NOISE_PX):
    uv = camera.project(points).uv
    return Pairs.of(points, uv + rng.normal(0, noise_px, uv.shape))


AHEAD = replace(LENS, ego_SE3_cam=SE3(FORWARD, np.array([1.5, 0.0, 1.6])))


def test_points_of_one_line_are_refused():
    rng = np.random.default_rng(10)
    points = np.array([8.0, -2.0, 0.5]) + rng.uniform(0, 4, (20, 1)) * (0.6, 0.8, 0.1)
    points += rng.normal(0, 0.003, points.shape)
    with pytest.raises(CalibrationError, match="one line"):
        estimate_extrinsics(seen_by(AHEAD, points, rng), LENS)


def on_the_ground(count, rng):
    xy = rng.uniform([8, -3], [20, 3], (count, 2))
    return np.column_stack([xy, rng.normal(0, 0.01, count)])


def test_points_of_one_plane_are_refused():
    rng = np.random.default_rng(11)
    with pytest.raises(CalibrationError, match="one plane"):
        estimate_extrinsics(seen_by(AHEAD, on_the_ground(30, rng), rng), LENS)


def test_wrong_pairs_do_not_hide_that_the_right_ones_lie_on_a_plane():
    rng = np.random.default_rng(12)
    ground = seen_by(AHEAD, on_the_ground(40, rng), rng)
    points = ground.points.copy()
    points[:8, 2] += rng.uniform(1, 3, 8)
    with pytest.raises(CalibrationError, match=r"agree with one pose lie on one plane"):
        estimate_extrinsics(Pairs.of(points, ground.uv), LENS)


def test_points_behind_the_camera_are_wrong_pairs():
    camera, pairs, _ = scene(np.random.default_rng(13), 40, 0.0)
    eye = camera.ego_SE3_cam.translation
    points = pairs.points.copy()
    points[:8] = 2 * eye - points[:8]  # the same lines of sight, on the other side
    found = estimate_extrinsics(Pairs.of(points, pairs.uv), LENS)
    assert not found.pose.is_used[:8].any()
    assert np.isinf(found.pose.distances_px[:8]).all()
    assert np.linalg.norm(errors(found, camera)[3:]) < 0.02


@pytest.mark.parametrize("axes", [[1, 1, -1], [1, -1, 1], [-1, -1, -1]])
def test_a_left_handed_frame_is_told_from_wrong_pairs(axes):
    _, pairs, _ = scene(np.random.default_rng(14), 40, 0.1)
    with pytest.raises(CalibrationError, match=r"behind the camera: their frame is left-handed"):
        estimate_extrinsics(Pairs.of(pairs.points * axes, pairs.uv), LENS)


def test_pairs_at_random_agree_with_no_pose():
    rng = np.random.default_rng(15)
    points = rng.uniform([4, -10, -1], [30, 10, 5], (30, 3))
    uv = rng.uniform([0, 0], [1599, 899], (30, 2))
    with pytest.raises(CalibrationError, match="of 30 pairs agree with one pose"):
        estimate_extrinsics(Pairs.of(points, uv), LENS)


@pytest.mark.parametrize("uv", [(1600.0, 5.0), (-1.0, 5.0), (5.0, 899.6)])
def test_pixels_outside_the_picture(uv):
    _, pairs, _ = scene(np.random.default_rng(16), 20, 0.0)
    moved = pairs.uv.copy()
    moved[7] = uv
    with pytest.raises(CalibrationError, match=r"line 8: pixel .* outside the 1600x900 picture"):
        estimate_extrinsics(Pairs.of(pairs.points, moved), LENS)


def test_points_of_a_map_and_repeated_pairs():
    _, pairs, _ = scene(np.random.default_rng(17), 20, 0.0)
    with pytest.raises(CalibrationError, match="not in that of a map"):
        estimate_extrinsics(Pairs.of(pairs.points + (5e5, 5e6, 0), pairs.uv), LENS)
    twice = Pairs.of(np.vstack([pairs.points, pairs.points[3]]), np.vstack([pairs.uv, pairs.uv[3]]))
    with pytest.raises(CalibrationError, match="line 4 is given 2 times"):
        estimate_extrinsics(twice, LENS)


def test_not_a_number_and_no_error_allowed():
    _, pairs, _ = scene(np.random.default_rng(18), 20, 0.0)
    points = pairs.points.copy()
    points[2, 1] = np.nan
    with pytest.raises(CalibrationError, match="NaN"):
        Pairs.of(points, pairs.uv)
    for max_error_px in (0.0, -1.0, np.nan):
        with pytest.raises(ConfigError, match="max_error_px"):
            estimate_extrinsics(pairs, LENS, max_error_px=max_error_px)
