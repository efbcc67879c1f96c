"""A sweep as a picture of ranges around its lidar, and the nearest return in windows of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import njit

from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.types import NDArrayAny, NDArrayFloat, NDArrayFloat32

BIN_DEG: Final = 0.125
COLUMNS: Final = int(360 / BIN_DEG)
ROWS: Final = int(60 / BIN_DEG)
LOWEST_DEG: Final = -40.0
MARGIN: Final = 40
"""Columns that go on around on either side of an image: windows need not ask where they are."""
EMPTY_ROWS: Final = 8
"""Above and below what an image saw."""
REACHES: Final = np.array([0, 1, 2, 4])
"""Bins to each side of those windows whose nearest return is kept for all places."""

_NEAREST_M: Final = 1.5
_AT_ONCE: Final = 1024
_BINS_PER_RAD: Final = np.float32(180.0 / np.pi / BIN_DEG)
_FIRST_ROW: Final = np.float32(LOWEST_DEG / BIN_DEG)
_HALF_ROUND: Final = np.float32(COLUMNS / 2)
_UNSURE: Final = np.float32(2e-3)
"""Bins within which of a bin's edge single precision does not tell the side; it errs by 5e-4."""
_SURE: Final = np.float32(1.0) - _UNSURE
_OUTSIDE: Final = -1
_ASK: Final = -2
_PI: Final = np.float32(np.pi)
_HALF_PI: Final = np.float32(np.pi / 2)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_TINY: Final = np.float32(1e-30)
_COEFFICIENTS: Final = (
    0.999999984,
    -0.333330668,
    0.199924836,
    -0.142025705,
    0.106367541,
    -0.0749544544,
    0.0425876075,
    -0.0160050305,
    0.0028340643,
)
"""Of arctan(t) / t in powers of t squared, t up to 1; found by interpolation, errs by 1.2e-8."""
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = (np.float32(c) for c in _COEFFICIENTS)


@dataclass(frozen=True, eq=False)
class RangeImage:
    """How far a sweep saw in each direction; made in any thread.

    Attributes:
        range_m: (rows, columns) float32 nearest return; infinite where nothing came back. The
            rows that saw something with `EMPTY_ROWS` around, all columns with `MARGIN` around.
        first_row: Row of all directions that is the first of these; may be below 0.
        city_SE3_lidar: Where from.
    """

    range_m: NDArrayFloat32
    first_row: int
    city_SE3_lidar: SE3

    @classmethod
    def of(cls, sweep: Sweep, city_SE3_ego: SE3, lidar_ego: NDArrayFloat) -> RangeImage:
        """From a whole sweep at its pose, whose rays come from (3,), ego frame, metres."""
        place, distance_m, low, high = _directions(sweep.points_ego, lidar_ego)
        image = _filled(place, distance_m, low, high)
        return cls(image, low - EMPTY_ROWS, city_SE3_ego @ SE3(np.eye(3), lidar_ego))


class Windows:
    """Nearest returns of an image in windows of some sizes; one image after another."""

    def __init__(self) -> None:
        self._room = np.empty((len(REACHES), 0, 0), dtype=np.float32)

    def of(self, image: RangeImage) -> NDArrayFloat32:
        """(len(REACHES), rows, columns), as the image's own; good until the next is asked for.

        At each place the nearest return at most `REACHES` rows and columns off. Not so at the
        image's edges, where there is less of it.
        """
        shape = image.range_m.shape
        if self._room.shape[1] < shape[0]:
            self._room = np.empty((len(REACHES), *shape), dtype=np.float32)
        found = self._room[:, : shape[0]]
        found[0] = image.range_m
        for k in range(1, len(REACHES)):
            _widened(found[k - 1], REACHES[k] - REACHES[k - 1], found[k])
        return found


@njit(inline="always", error_model="numpy")  # type: ignore[untyped-decorator]
def _arctan(t: np.float32) -> np.float32:
    """Of -1 to 1, radians."""
    u = t * t
    p = _C5 + u * (_C6 + u * (_C7 + u * _C8))
    return t * (_C0 + u * (_C1 + u * (_C2 + u * (_C3 + u * (_C4 + u * p)))))


@njit(inline="always", error_model="numpy")  # type: ignore[untyped-decorator]
def _row_and_column(x: float, y: float, z: float) -> tuple[np.float32, np.float32]:
    """Bins of a direction, lidar frame, with their parts; rows beyond those there are say so only."""
    ahead, aside, up = np.float32(x), np.float32(y), np.float32(z)
    steep = up / np.sqrt(ahead * ahead + aside * aside)
    steep = -_ONE if steep < -_ONE else steep
    steep = _ONE if steep > _ONE else steep
    wide, deep = abs(ahead), abs(aside)
    turned = deep > wide
    short = wide if turned else deep
    long = deep if turned else wide
    long = long if long > _TINY else _TINY
    angle = _arctan(short / long)
    angle = _HALF_PI - angle if turned else angle
    angle = _PI - angle if ahead < _ZERO else angle
    angle = -angle if aside < _ZERO else angle
    return _arctan(steep) * _BINS_PER_RAD - _FIRST_ROW, angle * _BINS_PER_RAD + _HALF_ROUND


@njit(inline="always", error_model="numpy")  # type: ignore[untyped-decorator]
def _is_sure(row: np.float32, column: np.float32) -> Any:
    """Whether single precision tells the bin."""
    part, other = row - np.floor(row), column - np.floor(column)
    return (part > _UNSURE) & (part < _SURE) & (other > _UNSURE) & (other < _SURE)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _exact_row_and_column(x: float, y: float, z: float) -> tuple[int, int]:
    """As `_row_and_column`, in double precision, whole."""
    row = (np.rad2deg(np.arctan2(z, np.sqrt(x * x + y * y))) - LOWEST_DEG) / BIN_DEG
    return int(row), int((np.rad2deg(np.arctan2(y, x)) + 180.0) / BIN_DEG)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def bin_of(x: float, y: float, z: float) -> Any:
    """Row and column (int, int) of a direction, lidar frame; rows may be below 0 or beyond the last."""
    row, column = _row_and_column(x, y, z)
    if _is_sure(row, column):
        return int(row), int(column)
    return _exact_row_and_column(x, y, z)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def nearest_within(
    windows: NDArrayFloat32, first_row: int, last_row: int, column: int, wide: int
) -> float:
    """Nearest return in rows and columns of an image, from its `Windows`; infinite if there is none.

    Args:
        windows: (len(REACHES), rows, columns).
        first_row: With
        last_row: inclusive; what lies outside the image is empty.
        column: Of the middle.
        wide: Columns to each side of it; with the largest reach of a window, not beyond `MARGIN`.
    """
    room = min((last_row - first_row) // 2, wide)
    k = 3 if room >= 4 else 2 if room >= 2 else room
    reach = 4 if room >= 4 else 2 if room >= 2 else room
    rows, step = windows.shape[1], 2 * reach + 1
    left, right = column - wide + reach, column + wide - reach
    nearest = np.float32(np.inf)
    row, last = first_row + reach, last_row - reach
    while True:
        inside = min(max(row, 0), rows - 1)
        at = left
        while True:
            nearest = min(nearest, windows[k, inside, at])
            if at >= right:
                break
            at = min(at + step, right)
        if row >= last:
            return float(nearest)
        row = min(row + step, last)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _directions(
    points: NDArrayFloat, lidar: NDArrayFloat
) -> tuple[NDArrayAny, NDArrayFloat32, Any, Any]:
    """Of returns their place, ``row * COLUMNS + column`` or below 0, distance, and the range of rows."""
    count = len(points)
    place, distance_m = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.float32)
    x0, y0, z0 = lidar[0], lidar[1], lidar[2]
    ahead, aside = np.empty(_AT_ONCE, dtype=np.float32), np.empty(_AT_ONCE, dtype=np.float32)
    up, is_near = np.empty(_AT_ONCE, dtype=np.float32), np.empty(_AT_ONCE, dtype=np.bool_)
    # Side by side and without a branch: sixteen at a time.
    for start in range(0, count, _AT_ONCE):
        number = min(count - start, _AT_ONCE)
        distances, places = distance_m[start : start + number], place[start : start + number]
        part = points[start : start + number]
        for i in range(number):
            x, y, z = part[i, 0] - x0, part[i, 1] - y0, part[i, 2] - z0
            distance = np.sqrt(x * x + y * y + z * z)
            ahead[i], aside[i], up[i] = x, y, z
            distances[i], is_near[i] = distance, distance < _NEAREST_M
        for i in range(number):
            row, column = _row_and_column(ahead[i], aside[i], up[i])
            inside = (row > -_ONE) & (row < np.float32(ROWS))
            at = np.int32(row) * np.int32(COLUMNS) + np.int32(column)
            at = at if inside else np.int32(_OUTSIDE)
            at = at if _is_sure(row, column) else np.int32(_ASK)
            places[i] = np.int32(_OUTSIDE) if is_near[i] else at
    low, high = np.int32(ROWS * COLUMNS), np.int32(0)
    for i in range(count):
        at = place[i]
        if at == _ASK:
            row, column = _exact_row_and_column(
                points[i, 0] - x0, points[i, 1] - y0, points[i, 2] - z0
            )
            inside = 0 <= row < ROWS
            at = np.int32(row * COLUMNS + column % COLUMNS if inside else _OUTSIDE)
            place[i] = at
        if at >= 0:
            low, high = min(low, at), max(high, at)
    return place, distance_m, np.int64(low) // COLUMNS, np.int64(high) // COLUMNS


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _filled(place: NDArrayAny, distance_m: NDArrayFloat32, low: int, high: int) -> NDArrayFloat32:
    """The nearest at each place, of the rows from low to high, with margins."""
    rows = max(high - low + 1, 0)
    image = np.full(
        (rows + 2 * EMPTY_ROWS, COLUMNS + 2 * MARGIN), np.float32(np.inf), dtype=np.float32
    )
    for i in range(len(place)):
        if place[i] >= 0:
            row = place[i] // np.int32(COLUMNS)
            column = place[i] - row * np.int32(COLUMNS)
            row += EMPTY_ROWS - low
            if distance_m[i] < image[row, column + MARGIN]:
                image[row, column + MARGIN] = distance_m[i]
    for row in range(EMPTY_ROWS, EMPTY_ROWS + rows):
        image[row, :MARGIN] = image[row, COLUMNS : COLUMNS + MARGIN]
        image[row, COLUMNS + MARGIN :] = image[row, MARGIN : 2 * MARGIN]
    return image


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _widened(image: NDArrayFloat32, step: int, wider: NDArrayFloat32) -> None:
    """The nearest of the nine places at a step from each other around each."""
    rows, columns = image.shape
    nearest = np.empty(columns, dtype=np.float32)
    inner = columns - 2 * step
    left, middle, right = nearest[:inner], nearest[step : step + inner], nearest[2 * step :]
    for row in range(rows):
        below, own, above = image[max(row - step, 0)], image[row], image[min(row + step, rows - 1)]
        for c in range(columns):
            a, b, d = below[c], own[c], above[c]
            a = a if a < b else b
            nearest[c] = a if a < d else d
        out = wider[row]
        for c in range(step):
            out[c] = out[columns - 1 - c] = np.inf
        out = wider[row, step : step + inner]
        for c in range(inner):
            a, b, d = left[c], middle[c], right[c]
            a = a if a < b else b
            out[c] = a if a < d else d
