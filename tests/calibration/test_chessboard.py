"""The board's corners in photos whose truth is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmap_tools.calibration.chessboard import Board, find_corners
from hdmap_tools.errors import CalibrationError
from hdmap_tools.geometry.se3 import SE3

from .rendering import BOARD, TRUE_CAMERA, Renderer


def posed(depth_m=1.4, tilt=(20, -25, 8)):
    turn = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
    return SE3(turn, np.array([0.0, 0.0, depth_m]) - turn @ BOARD.corners_board.mean(axis=0))


@pytest.fixture(scope="module")
def renderer():
    return Renderer(TRUE_CAMERA)


def error_px(found, pose):
    true = TRUE_CAMERA.project(pose.transform_from(BOARD.corners_board)).uv
    # A board of 9 by 6 looks the same turned by half a turn.
    return min(np.sqrt(((uv - true) ** 2).sum(axis=1).mean()) for uv in (found, found[::-1]))


@pytest.mark.parametrize(("blur_px", "noise"), [(0.5, 1.0), (0.8, 2.0), (1.5, 4.0)])
def test_corners_are_found_to_a_small_part_of_a_pixel(renderer, blur_px, noise):
    rng = np.random.default_rng(0)
    image = renderer.image(BOARD, posed(), rng, blur_px, noise)
    found = find_corners(image, BOARD)
    assert found is not None
    assert found.shape == (54, 2)
    assert found.dtype == np.float64
    assert error_px(found, posed()) < 0.06


def test_corners_have_no_bias_of_half_a_pixel(renderer):
    rng = np.random.default_rng(1)
    found = find_corners(renderer.image(BOARD, posed(), rng), BOARD)
    true = TRUE_CAMERA.project(posed().transform_from(BOARD.corners_board)).uv
    assert np.abs(found.mean(axis=0) - true.mean(axis=0)).max() < 0.02


def test_no_board_is_found_where_there_is_none_or_only_a_part(renderer):
    rng = np.random.default_rng(2)
    noise = rng.integers(0, 256, (240, 320)).astype(np.uint8)
    assert find_corners(noise, BOARD) is None
    assert find_corners(np.full((240, 320), 128, dtype=np.uint8), BOARD) is None
    image = renderer.image(BOARD, posed(), rng)
    assert find_corners(np.ascontiguousarray(image[:, :480]), BOARD) is None


def test_a_board_of_other_size_is_not_found(renderer):
    image = renderer.image(BOARD, posed(), np.random.default_rng(3))
    assert find_corners(image, Board(10, 7, 0.1)) is None


def test_board_from_text():
    assert Board.from_text(" 9X6 ", 0.1) == BOARD
    assert BOARD.num_corners == 54
    corners = BOARD.corners_board
    np.testing.assert_allclose(corners[1] - corners[0], [0.1, 0, 0])
    np.testing.assert_allclose(corners[9] - corners[0], [0, 0.1, 0], atol=1e-15)


@pytest.mark.parametrize(
    "text", ["9", "9x", "x6", "9x6x2", "a x b", "-9x6", "9.5x6", "2x6", "999x6"]
)
def test_boards_that_are_none(text):
    with pytest.raises(CalibrationError, match="inner corners"):
        Board.from_text(text, 0.1)


@pytest.mark.parametrize("square_m", [0.0, -0.1, np.nan, np.inf])
def test_squares_that_are_none(square_m):
    with pytest.raises(CalibrationError, match="side of a square"):
        Board(9, 6, square_m)
