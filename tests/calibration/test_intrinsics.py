"""Intrinsics against the camera that took the views."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmap_tools.calibration.board_images import find_boards, list_images
from hdmap_tools.calibration.intrinsics import View, coverage_counts, estimate_intrinsics
from hdmap_tools.errors import CalibrationError
from hdmap_tools.geometry.se3 import SE3

from .rendering import BOARD, TRUE_CAMERA, views

SIZE = (TRUE_CAMERA.width_px, TRUE_CAMERA.height_px)
TRUTH = np.array(
    [TRUE_CAMERA.fx, TRUE_CAMERA.fy, TRUE_CAMERA.cx, TRUE_CAMERA.cy, *TRUE_CAMERA.distortion]
)


def values(camera):
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def seen(poses, rng, noise_px=0.05):
    """Views as a detector would see them, with noise in each coordinate."""
    found = []
    for k, pose in enumerate(poses):
        uv = TRUE_CAMERA.project(pose.transform_from(BOARD.corners_board)).uv
        found.append(View(f"{k:02d}", uv + rng.normal(0, noise_px, uv.shape)))
    return found


def test_fifteen_photos_give_the_camera(board_photos):
    boards = find_boards(list_images([board_photos]), BOARD)
    assert len(boards.views) == 15
    found = estimate_intrinsics(boards.views, BOARD, boards.size_px, "CAM")
    error = values(found.camera) - TRUTH
    assert np.abs(error[:2] / TRUTH[:2]).max() < 0.001  # asked for is 0.2 %
    assert np.abs(error[2:4]).max() < 1.0
    assert found.rms_px < 0.1  # asked for is 0.3
    assert found.rms_px < found.held_out_rms_px < 0.1
    assert found.warnings == ()
    assert found.camera.name == "CAM"
    # The whole mapping, not its numbers one by one: rays all over the picture.
    v, u = np.mgrid[60:540:9j, 80:880:13j]
    uv = np.column_stack([u.ravel(), v.ravel()])
    angle = np.linalg.norm(found.camera.rays_ego(uv) - TRUE_CAMERA.rays_ego(uv), axis=1)
    assert angle.max() * TRUE_CAMERA.fx < 2.0


def test_exact_corners_give_the_exact_camera():
    rng = np.random.default_rng(0)
    exact = seen(views(BOARD, TRUE_CAMERA, 12, rng), rng, noise_px=0.0)
    found = estimate_intrinsics(exact, BOARD, SIZE)
    np.testing.assert_allclose(values(found.camera), TRUTH, rtol=2e-3, atol=2e-5)
    assert found.rms_px < 1e-3


def test_the_reported_sigma_is_that_of_the_error():
    normalized = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        found = estimate_intrinsics(seen(views(BOARD, TRUE_CAMERA, 12, rng), rng, 0.3), BOARD, SIZE)
        normalized.append((values(found.camera) - TRUTH) / found.sigma)
    # 25 seeds of 9 numbers, those of one seed correlated.
    assert 0.8 < np.sqrt(np.mean(np.square(normalized))) < 1.25


def test_the_error_on_views_held_out_is_that_of_the_noise():
    rng = np.random.default_rng(4)
    found = estimate_intrinsics(seen(views(BOARD, TRUE_CAMERA, 20, rng), rng, 0.2), BOARD, SIZE)
    noise = 0.2 * np.sqrt(2)
    assert found.rms_px == pytest.approx(noise, rel=0.1)
    # The pose of each is fitted to half of its corners, which adds a little.
    assert noise < found.held_out_rms_px < 1.3 * noise


def test_views_held_out_show_what_the_fit_hides():
    """Few views at the picture's middle: k3 bends to the noise where it is seen, and not beyond."""
    rng = np.random.default_rng(5)
    poses = views(BOARD, TRUE_CAMERA, 4, rng)
    found = estimate_intrinsics(seen(poses, rng, 0.5), BOARD, SIZE)
    assert found.held_out_rms_px > 1.15 * found.rms_px


def test_without_enough_views_nothing_is_held_out():
    rng = np.random.default_rng(6)
    found = estimate_intrinsics(seen(views(BOARD, TRUE_CAMERA, 3, rng), rng, 0.01), BOARD, SIZE)
    assert found.held_out_rms_px is None
    assert all(view.held_out_rms_px is None for view in found.views)
    assert any("only 3 views" in warning for warning in found.warnings)


def test_a_view_with_a_wrong_corner_is_named():
    rng = np.random.default_rng(7)
    all_views = seen(views(BOARD, TRUE_CAMERA, 12, rng), rng)
    spoilt = all_views[4].uv.copy()
    spoilt[10] += 25.0
    all_views[4] = View("spoilt", spoilt)
    found = estimate_intrinsics(all_views, BOARD, SIZE)
    assert any("spoilt" in warning for warning in found.warnings)
    assert max(found.views, key=lambda view: view.rms_px).name == "spoilt"


def test_coverage_counts_corners_where_they_are():
    view = View("one", np.array([[-0.4, -0.4], [0.0, 0.0], [959.4, 599.4], [480.0, 0.0]]))
    counts = coverage_counts([view], SIZE)
    assert counts.shape == (6, 8)
    assert counts[0, 0] == 2
    assert counts[5, 7] == 1
    assert counts[0, 4] == 1
    assert counts.sum() == 4


def test_tilt_is_the_angle_to_the_optical_axis():
    rng = np.random.default_rng(8)
    poses = views(BOARD, TRUE_CAMERA, 8, rng)
    found = estimate_intrinsics(seen(poses, rng, 0.01), BOARD, SIZE)
    true = [np.degrees(np.arccos(abs(pose.rotation[2, 2]))) for pose in poses]
    np.testing.assert_allclose([view.tilt_deg for view in found.views], true, atol=0.3)


def parallel_views(count, rng):
    middle = BOARD.corners_board.mean(axis=0)
    return [
        SE3(np.eye(3), rng.uniform([-0.15, -0.1, 1.3], [0.15, 0.1, 1.31]) - middle)
        for _ in range(count)
    ]


def test_boards_parallel_to_the_picture_do_not_give_a_focal_length():
    rng = np.random.default_rng(9)
    with pytest.raises(CalibrationError, match="stand the same way"):
        estimate_intrinsics(seen(parallel_views(10, rng), rng, 0.3), BOARD, SIZE)


def test_boards_of_one_tilt_leave_the_focal_length_open_and_say_how_far():
    """OpenCV's own sigma is a thousandth of the error here."""
    turn = Rotation.from_euler("xyz", [30, -10, 0], degrees=True)
    middle = BOARD.corners_board.mean(axis=0)
    normalized = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        poses = []
        for _ in range(10):
            # Just enough variety not to be refused.
            tilt = (turn * Rotation.from_rotvec(rng.normal(0, 0.06, 3))).as_matrix()
            poses.append(
                SE3(tilt, rng.uniform([-0.15, -0.1, 1.3], [0.15, 0.1, 1.8]) - tilt @ middle)
            )
        found = estimate_intrinsics(seen(poses, rng, 0.1), BOARD, SIZE)
        assert any("tilt the board" in warning for warning in found.warnings)
        normalized.append((found.camera.fx - TRUTH[0]) / found.sigma[0])
    assert np.sqrt(np.mean(np.square(normalized))) < 2.0


def test_too_few_views():
    rng = np.random.default_rng(10)
    with pytest.raises(CalibrationError, match="2 views show the board; expected at least 3"):
        estimate_intrinsics(seen(views(BOARD, TRUE_CAMERA, 2, rng), rng), BOARD, SIZE)


def test_corners_in_no_order_are_no_camera():
    rng = np.random.default_rng(12)
    shuffled = [
        View(view.name, rng.permutation(view.uv))
        for view in seen(views(BOARD, TRUE_CAMERA, 6, rng), rng)
    ]
    with pytest.raises(CalibrationError):
        estimate_intrinsics(shuffled, BOARD, SIZE)


def test_turned_views_do_not_matter():
    """The detector may begin at either end of a board."""
    rng = np.random.default_rng(13)
    all_views = seen(views(BOARD, TRUE_CAMERA, 10, rng), rng)
    turned = [View(v.name, v.uv[::-1]) if k % 2 else v for k, v in enumerate(all_views)]
    first = values(estimate_intrinsics(all_views, BOARD, SIZE).camera)
    second = values(estimate_intrinsics(turned, BOARD, SIZE).camera)
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-4)


def test_the_same_views_give_the_same_numbers():
    rng = np.random.default_rng(14)
    all_views = seen(views(BOARD, TRUE_CAMERA, 6, rng), rng)
    first, second = (estimate_intrinsics(all_views, BOARD, SIZE) for _ in range(2))
    assert np.array_equal(values(first.camera), values(second.camera))
    assert first.held_out_rms_px == second.held_out_rms_px


def test_rotation_convention_of_the_renderer():
    """A board turned about the optical axis by 90 degrees has its columns down the picture."""
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    uv = TRUE_CAMERA.project(BOARD.corners_board @ turn.T + (0.2, -0.3, 2.0)).uv
    assert uv[1, 1] > uv[0, 1] + 10
