"""The chessboard, and where its corners are in an image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from hdmap_tools.errors import CalibrationError
from hdmap_tools.types import NDArrayByte, NDArrayFloat

_FEWEST: Final = 3
_MOST: Final = 100
_MIN_SPACING_PX: Final = 5.0
"""Corners nearer than this have no edge of their own to be refined on."""
_MAX_HALF_WINDOW_PX: Final = 11
_WINDOW_SHARE: Final = 0.4
"""Of the distance to the next corner: a window must not see the next corner's edges."""


@dataclass(frozen=True)
class Board:
    """A flat chessboard.

    Attributes:
        columns, rows: Inner corners, where four squares meet: one fewer than squares.
        square_m: Side of a square, metres.
    """

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if not all(_FEWEST <= count <= _MOST for count in (self.columns, self.rows)):
            raise CalibrationError(
                f"A board of {self.columns}x{self.rows} inner corners cannot be used; expected "
                f"{_FEWEST} to {_MOST} each way."
            )
        if not (np.isfinite(self.square_m) and self.square_m > 0):
            raise CalibrationError(
                f"The side of a square is {self.square_m} m; expected a positive length in metres."
            )

    @classmethod
    def from_text(cls, text: str, square_m: float) -> Board:
        """From ``9x6``, inner corners.

        Raises:
            CalibrationError: If the text is not of that form, or no such board can be used.
        """
        found = re.fullmatch(r"\s*([0-9]{1,4})\s*[xX]\s*([0-9]{1,4})\s*", text)
        if found is None:
            raise CalibrationError(
                f"Board {text!r}: expected COLUMNSxROWS of inner corners, for example 9x6 for a board "
                "of 10 by 7 squares."
            )
        return cls(int(found[1]), int(found[2]), square_m)

    @property
    def num_corners(self) -> int:
        """Inner corners."""
        return self.columns * self.rows

    @cached_property
    def corners_board(self) -> NDArrayFloat:
        """(N, 3) metres: the corners in the board's own frame, row by row, z = 0."""
        rows, columns = np.indices((self.rows, self.columns), dtype=np.float64)
        flat = np.zeros_like(rows)
        return np.stack([columns, rows, flat], axis=-1).reshape(-1, 3) * self.square_m


def find_corners(gray: NDArrayByte, board: Board) -> NDArrayFloat | None:
    """The board's inner corners in an image, to a small part of a pixel.

    Args:
        gray: (h, w) uint8.
        board: What to look for; all of it must be in the picture.

    Returns:
        (N, 2) pixels, u right and v down, the centre of the first pixel at (0, 0), in the
        order of `Board.corners_board` up to a turn or mirror image of a symmetric board;
        None where the board is not found.

    Source:
        Duda and Frese, Accurate Detection and Localization of Checkerboard Corners for
        Calibration, BMVC 2018 (the first detector); Förstner and Gülch, A Fast Operator for
        Detection and Precise Location of Distinct Points, 1987 (the refinement).
    """
    import cv2

    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(gray, size, flags=flags)
    if not found:
        # Slower to give up on small and weakly lit boards.
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(gray, size, flags=flags)
    if not found or corners is None:
        return None
    # OpenCV 4 gives (N, 1, 2), OpenCV 5 may give (N, 2) or (1, N, 2).
    uv = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    if len(uv) != board.num_corners or not np.isfinite(uv).all():
        return None
    spacing_px = _smallest_spacing(uv, board)
    if spacing_px < _MIN_SPACING_PX:
        return None
    return _refined(gray, uv, spacing_px)


def _refined(gray: NDArrayByte, uv: NDArrayFloat, spacing_px: float) -> NDArrayFloat:
    import cv2

    half = int(np.clip(_WINDOW_SHARE * spacing_px, 2, _MAX_HALF_WINDOW_PX))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    start = np.ascontiguousarray(uv, dtype=np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(gray, start.copy(), (half, half), (-1, -1), stop)
    moved = np.asarray(refined, dtype=np.float64).reshape(-1, 2)
    # What ran away from where the detector saw the corner has followed something else.
    is_near = np.linalg.norm(moved - uv, axis=1) <= max(1.0, 0.2 * half)
    return np.where(is_near[:, None], moved, uv)


def _smallest_spacing(uv: NDArrayFloat, board: Board) -> float:
    grid = uv.reshape(board.rows, board.columns, 2)
    along = np.linalg.norm(np.diff(grid, axis=1), axis=2).min()
    across = np.linalg.norm(np.diff(grid, axis=0), axis=2).min()
    return float(min(along, across))
