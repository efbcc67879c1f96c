"""Compiled parts of the ground's texture: building its levels, looking it up.

A texel is 32 bits: red, green and blue, ten bits each, of linear light. Looked up, the three
lie 21 bits apart in 64, where one multiplication weighs all of them and sums of up to eight
weighted texels do not meet: a fifth of the work of three channels of bytes.
"""

from __future__ import annotations

from math import floor, log2
from typing import Any, Final, NamedTuple

import numpy as np

from hdmap_tools.simulate.compiled import compiled_fast
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayInt

FULL: Final = 1023
"""A texel's value of a surface that throws all light back."""

WEIGHTS: Final = 256
"""The weights of one look-up add up to this."""

_MOST_TAPS = 6
_GRASS_WORN = 13 * 256 + 255
_LOW, _MIDDLE, _HIGH = np.uint32(0x3FF), np.uint32(0xFFC00), np.uint32(0x3FF00000)
_11, _22 = np.uint64(11), np.uint64(22)
_10, _20 = np.uint32(10), np.uint32(20)
_LANE = np.uint64(0x1FFFFF)
_21, _42 = np.uint64(21), np.uint64(42)


class Footprints(NamedTuple):
    """Parts of the ground that pixels see, arrays (N,) of which the first ones are in use.

    Attributes:
        x, y: Middles, metres from the scene's origin.
        toward_x, toward_y: Unit vectors of their long sides.
        across_m, along_m: Their short and long sides.
    """

    x: NDArrayFloat
    y: NDArrayFloat
    toward_x: NDArrayFloat
    toward_y: NDArrayFloat
    across_m: NDArrayFloat
    along_m: NDArrayFloat


@compiled_fast
def footprints(count: int) -> Footprints:
    """Room for some footprints."""
    return Footprints(
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count),
    )


@compiled_fast
def first_level(
    first: int,
    last: int,
    codes: NDArrayByte,
    wear: NDArrayByte,
    cells: NDArrayAny,
    level: NDArrayAny,
) -> None:
    """Means of two by two cells; at the rim of those there are."""
    rows, cols = codes.shape
    for row in range(first, last):
        low, high = 2 * row, min(2 * row + 1, rows - 1)
        for col in range(level.shape[1]):
            left, right = 2 * col, min(2 * col + 1, cols - 1)
            level[row, col] = _mean(
                cells[np.int64(codes[low, left]) * 256 + wear[low, left]],
                cells[np.int64(codes[low, right]) * 256 + wear[low, right]],
                cells[np.int64(codes[high, left]) * 256 + wear[high, left]],
                cells[np.int64(codes[high, right]) * 256 + wear[high, right]],
            )


@compiled_fast
def next_level(first: int, last: int, finer: NDArrayAny, level: NDArrayAny) -> None:
    """Means of two by two cells of the level before; at the rim of those there are."""
    rows, cols = finer.shape
    for row in range(first, last):
        low, high = 2 * row, min(2 * row + 1, rows - 1)
        for col in range(level.shape[1]):
            left, right = 2 * col, min(2 * col + 1, cols - 1)
            level[row, col] = _mean(
                finer[low, left], finer[low, right], finer[high, left], finer[high, right]
            )


@compiled_fast
def _mean(a: Any, b: Any, c: Any, d: Any) -> Any:
    total = _spread(a) + _spread(b) + _spread(c) + _spread(d)
    two = np.uint64(2)
    red = ((total & _LANE) + two) >> two
    green = (((total >> _21) & _LANE) + two) >> two
    blue = ((total >> _42) + two) >> two
    return np.uint32(np.uint32(red) | (np.uint32(green) << _10) | (np.uint32(blue) << _20))


@compiled_fast
def _spread(texel: Any) -> Any:
    """Its three values 21 bits apart."""
    return (
        np.uint64(texel & _LOW)
        | (np.uint64(texel & _MIDDLE) << _11)
        | (np.uint64(texel & _HIGH) << _22)
    )


@compiled_fast
def look_up(
    count: int,
    places: Footprints,
    codes: NDArrayByte,
    wear: NDArrayByte,
    cells: NDArrayAny,
    pyramid: NDArrayAny,
    level_shapes: NDArrayInt,
    raster: NDArrayFloat,
    colour: NDArrayFloat,
) -> None:
    """Mean albedo of footprints: taps along the long side, each as wide as the short one.

    One function with all loops in it: an array handed on inside is counted in and out,
    atomically, which for every tap takes longer than the work.

    Takes:
        count: Footprints to do.
        places: Where and how large; x and y from the scene's origin.
        codes, wear: The surface raster, which is level 0.
        cells, pyramid, level_shapes, raster: See `GroundTexture`; `raster` is its cell size
            and where it begins.
        colour: (N, 3) written.
    """
    for i in range(count):
        across_m, along_m = places.across_m[i], places.along_m[i]
        fine = max(across_m, along_m / _MOST_TAPS)
        level = 0
        if fine > raster[0]:
            level = min(int(log2(fine / raster[0]) + 0.5), len(level_shapes))
        cell = raster[0] * (1 << level)
        taps = min(max(int(along_m / max(fine, cell) + 0.5), 1), _MOST_TAPS)
        rows, cols, start = codes.shape[0], codes.shape[1], 0
        if level > 0:
            start, rows, cols = (
                level_shapes[level - 1, 0],
                level_shapes[level - 1, 1],
                level_shapes[level - 1, 2],
            )
        per_cell = 1.0 / cell
        step = along_m / taps * per_cell
        # Texels lie at the middles of their cells.
        col_at = (places.x[i] - raster[1]) * per_cell - 0.5
        row_at = (places.y[i] - raster[2]) * per_cell - 0.5
        total = np.uint64(0)
        for k in range(taps):
            offset = (k + 0.5 - 0.5 * taps) * step
            tap_col = col_at + offset * places.toward_x[i]
            tap_row = row_at + offset * places.toward_y[i]
            col, row = floor(tap_col), floor(tap_row)
            u, v = tap_col - col, tap_row - row
            d = int(WEIGHTS * u * v + 0.5)
            b = int(WEIGHTS * u + 0.5) - d
            c = int(WEIGHTS * v + 0.5) - d
            a = WEIGHTS - b - c - d
            if not (0 <= row < rows - 1 and 0 <= col < cols - 1):
                total += np.uint64(WEIGHTS) * _spread(cells[_GRASS_WORN])
                continue
            if level == 0:
                p = cells[np.int64(codes[row, col]) * 256 + wear[row, col]]
                q = cells[np.int64(codes[row, col + 1]) * 256 + wear[row, col + 1]]
                r = cells[np.int64(codes[row + 1, col]) * 256 + wear[row + 1, col]]
                s = cells[np.int64(codes[row + 1, col + 1]) * 256 + wear[row + 1, col + 1]]
            else:
                near = start + row * cols + col
                p, q = pyramid[near], pyramid[near + 1]
                r, s = pyramid[near + cols], pyramid[near + cols + 1]
            total += (
                np.uint64(a) * _spread(p)
                + np.uint64(b) * _spread(q)
                + np.uint64(c) * _spread(r)
                + np.uint64(d) * _spread(s)
            )
        unit = 1.0 / (FULL * WEIGHTS * taps)
        colour[i, 0] = unit * float(np.int64(total & _LANE))
        colour[i, 1] = unit * float(np.int64((total >> _21) & _LANE))
        colour[i, 2] = unit * float(np.int64(total >> _42))
