"""Pairs of a lidar point and the pixel that shows it, read from a table and checked."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import CalibrationError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.readers.checks import MAX_RANGE_M, shown, shown_names
from hdmap_tools.types import NDArrayFloat, NDArrayInt

FEWEST_PAIRS: Final = 6
"""EPnP needs four, which any pose fits nearly; six leave something to find a wrong pair by."""

COLUMNS: Final = ("x_m", "y_m", "z_m", "u_px", "v_px")
_MAX_BYTES: Final = 50_000_000


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points and the pixels that show them.

    Attributes:
        points: (N, 3) metres, finite.
        uv: (N, 2) pixels, finite; the centre of the first pixel is (0, 0).
        lines: (N,) line of each pair in its file, from 1, for messages.
    """

    points: NDArrayFloat
    uv: NDArrayFloat
    lines: NDArrayInt

    def __post_init__(self) -> None:
        count = len(self.points)
        if (
            self.points.shape != (count, 3)
            or self.uv.shape != (count, 2)
            or self.lines.shape != (count,)
        ):
            raise ShapeError(
                f"Pairs need points (N, 3), uv (N, 2) and lines (N,), found {self.points.shape}, "
                f"{self.uv.shape} and {self.lines.shape}."
            )
        if not (np.isfinite(self.points).all() and np.isfinite(self.uv).all()):
            raise CalibrationError("Pairs hold NaN or infinite values; remove or correct them.")

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def of(cls, points: NDArrayFloat, uv: NDArrayFloat) -> Pairs:
        """From arrays, numbered from 1."""
        points, uv = np.asarray(points, dtype=np.float64), np.asarray(uv, dtype=np.float64)
        return cls(points, uv, np.arange(1, len(points) + 1))


def read_pairs(path: Path) -> Pairs:
    """Read ``x_m,y_m,z_m,u_px,v_px`` from a CSV file.

    The first line names the columns, in any order; others are ignored, and so are empty
    lines and lines that start with #.

    Raises:
        CalibrationError: If the file cannot be read, a column is missing, or a value is no
            finite number; names the line.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CalibrationError(
                f"{path} has {path.stat().st_size} bytes; expected a table of pairs, at most {_MAX_BYTES}."
            )
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise CalibrationError(
            f"{path} cannot be read ({error.strerror or error}); expected a CSV file with "
            f"{','.join(COLUMNS)}."
        ) from error
    except UnicodeDecodeError as error:
        raise CalibrationError(
            f"{path} is not text (byte {error.start}); expected a CSV file with {','.join(COLUMNS)}."
        ) from error
    # Numbered first, so that messages name the line that an editor shows.
    numbered = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise CalibrationError(f"{path} is empty; expected the line {','.join(COLUMNS)} and pairs.")
    try:
        rows = list(csv.reader(io.StringIO("\n".join(line for _, line in numbered)), strict=True))
    except csv.Error as error:
        raise CalibrationError(f"{path} is not a CSV file: {error}.") from error
    if len(rows) != len(numbered):
        raise CalibrationError(
            f"{path}: a quoted value runs over several lines; remove the quotes."
        )
    header, rows = [name.strip() for name in rows[0]], rows[1:]
    lines = [number for number, _ in numbered[1:]]
    missing = [name for name in COLUMNS if header.count(name) != 1]
    if missing:
        raise CalibrationError(
            f"{path}, line {numbered[0][0]}: lacks (or repeats) the columns {', '.join(missing)}; it has "
            f"{shown_names(header)}. The first line names the columns: {','.join(COLUMNS)}."
        )
    places = [header.index(name) for name in COLUMNS]
    values = np.array(
        [
            _numbers(row, places, len(header), path, line)
            for row, line in zip(rows, lines, strict=True)
        ]
    ).reshape(-1, len(COLUMNS))
    return Pairs(values[:, :3], values[:, 3:], np.array(lines, dtype=np.int64))


def _numbers(
    row: Sequence[str], places: Sequence[int], width: int, path: Path, line: int
) -> list[float]:
    if len(row) != width:
        raise CalibrationError(f"{path}, line {line}: {len(row)} values, expected {width}.")
    numbers = []
    for name, place in zip(COLUMNS, places, strict=True):
        try:
            number = float(row[place])
        except ValueError:
            number = float("nan")
        if not np.isfinite(number):
            raise CalibrationError(
                f"{path}, line {line}: {name} is {shown(row[place])}; expected a finite number. Correct "
                "or remove the line."
            )
        numbers.append(number)
    return numbers


def require_usable(pairs: Pairs, camera: PinholeCamera) -> None:
    """Refuse pairs that no pose can be found from.

    Raises:
        CalibrationError: With too few pairs, a pixel outside the picture, a point further
            than any lidar measures, or one pair given twice.
    """
    if len(pairs) < FEWEST_PAIRS:
        raise CalibrationError(
            f"{len(pairs)} pairs; expected at least {FEWEST_PAIRS}: a pose has six unknowns, four pairs "
            "are the least EPnP takes, and only more can show that one is wrong. Better 15 or more."
        )
    uv, size = pairs.uv, (camera.width_px, camera.height_px)
    outside = ((uv < -0.5) | (uv >= np.array(size) - 0.5)).any(axis=1)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        raise CalibrationError(
            f"Pair in line {pairs.lines[k]}: pixel ({uv[k, 0]:g}, {uv[k, 1]:g}) lies outside the "
            f"{size[0]}x{size[1]} picture of camera {camera.name} ({int(outside.sum())} of {len(pairs)} do); "
            "are the pixels of another size of picture, or u and v swapped?"
        )
    far = (np.abs(pairs.points) > MAX_RANGE_M).any(axis=1)
    if far.any():
        k = int(np.flatnonzero(far)[0])
        raise CalibrationError(
            f"Pair in line {pairs.lines[k]}: point {pairs.points[k].tolist()} lies beyond {MAX_RANGE_M:g} m; "
            "expected metres in the sensor's or vehicle's frame, not in that of a map."
        )
    both = np.column_stack([pairs.points, pairs.uv])
    _, first, counts = np.unique(both, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        k = int(first[np.argmax(counts > 1)])
        raise CalibrationError(
            f"Pair in line {pairs.lines[k]} is given {int(counts.max())} times; a repeated pair counts as "
            "new evidence and makes the result look better than it is. Remove the copies."
        )
