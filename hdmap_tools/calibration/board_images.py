"""Pictures of a chessboard: read, checked to be of one camera, and searched for the board."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.calibration.chessboard import Board, find_corners
from hdmap_tools.calibration.intrinsics import View
from hdmap_tools.errors import CalibrationError, ImageError
from hdmap_tools.readers.image import find_damage
from hdmap_tools.types import NDArrayByte

logger = logging.getLogger(__name__)

_SUFFIXES: Final = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"})
_NAMED: Final = 5


@dataclass(frozen=True, eq=False)
class BoardImages:
    """What the pictures show.

    Attributes:
        size_px: Width and height, the same in all.
        views: Pictures in which the board was found.
        without_board: Names of the others.
        repeated: Names of pictures left out because they are copies of earlier ones.
    """

    size_px: tuple[int, int]
    views: tuple[View, ...]
    without_board: tuple[str, ...]
    repeated: tuple[str, ...]


def list_images(paths: Sequence[Path]) -> list[Path]:
    """Picture files, those of folders in the order of their names.

    Raises:
        ImageError: If a path does not exist, or a folder holds no picture.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise ImageError(f"{path} does not exist; expected a picture or a folder of pictures.")
        if not path.is_dir():
            found.append(path)
            continue
        inside = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES and p.is_file())
        if not inside:
            raise ImageError(
                f"{path} holds no pictures; expected files {', '.join(sorted(_SUFFIXES))}."
            )
        found += inside
    return list(dict.fromkeys(found))


def find_boards(
    paths: Sequence[Path], board: Board, progress: Callable[[int, int], None] | None = None
) -> BoardImages:
    """Look for the board in every picture.

    Args:
        paths: Pictures of one camera, as it gives them: not cropped, scaled or undistorted.
        board: What to look for.
        progress: Told how many of how many are done.

    Raises:
        ImageError: If a picture cannot be read.
        CalibrationError: If they are of several sizes, or none shows the board.
    """
    views: list[View] = []
    without: list[str] = []
    repeated: list[str] = []
    sizes: dict[tuple[int, int], Path] = {}
    earlier: dict[bytes, Path] = {}
    for done, path in enumerate(paths):
        gray = read_gray(path)
        size = (gray.shape[1], gray.shape[0])
        if size not in sizes and sizes:
            (first, first_path), *_ = sizes.items()
            raise CalibrationError(
                f"The pictures are of several sizes: {first_path} is {first[0]}x{first[1]} px, {path} is "
                f"{size[0]}x{size[1]} px; calibrate one camera at one size at a time."
            )
        sizes.setdefault(size, path)
        pixels = gray.tobytes()
        if pixels in earlier:
            logger.warning("%s shows the same as %s; left out", path, earlier[pixels])
            repeated.append(str(path))
        else:
            earlier[pixels] = path
            corners = find_corners(gray, board)
            if corners is None:
                logger.info("no board of %dx%d in %s", board.columns, board.rows, path)
                without.append(str(path))
            else:
                views.append(View(str(path), corners))
        if progress is not None:
            progress(done + 1, len(paths))
    if not views:
        names = ", ".join(without[:_NAMED]) + (", …" if len(without) > _NAMED else "")
        raise CalibrationError(
            f"No picture of {len(paths)} shows a chessboard of {board.columns}x{board.rows} inner corners "
            f"({names or 'none given'}). Inner corners are one fewer than squares each way; the whole board "
            "must be in the picture, sharp, flat and with a white margin."
        )
    (size, _), *_ = sizes.items()
    return BoardImages(size, tuple(views), tuple(without), tuple(repeated))


def read_gray(path: Path) -> NDArrayByte:
    """A picture as (h, w) uint8, in the sensor's orientation.

    Raises:
        ImageError: If it cannot be read or is damaged.
    """
    import cv2

    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise ImageError(
            f"{path} cannot be read ({error.strerror or error}); expected a picture."
        ) from error
    if damage := find_damage(encoded):
        raise ImageError(f"{path} is damaged: {damage}. Copy it again or leave it out.")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        gray = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error:
        gray = None
    if gray is None or gray.ndim != 2:
        raise ImageError(f"{path} does not decode ({len(encoded)} bytes); expected a picture.")
    return np.asarray(gray, dtype=np.uint8)
