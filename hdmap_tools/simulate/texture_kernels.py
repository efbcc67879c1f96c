"""Compiled parts of the ground's texture: building its levels, looking it up."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from hdmap_tools.simulate.compiled import compiled_fast, compiled_inline
from hdmap_tools.types import NDArrayByte, NDArrayFloat, NDArrayFloat32, NDArrayInt

_GRASS_WORN = 13 * 256 + 255


@compiled_fast
def first_level(
    first: int,
    last: int,
    codes: NDArrayByte,
    wear: NDArrayByte,
    cells: NDArrayFloat32,
    level: NDArrayByte,
) -> None:
    """Means of two by two cells; at the rim of those there are."""
    rows, cols = codes.shape
    for row in range(first, last):
        for col in range(level.shape[1]):
            red = green = blue = 0.0
            for k in range(4):
                i, j = min(2 * row + k // 2, rows - 1), min(2 * col + k % 2, cols - 1)
                cell = np.int64(codes[i, j]) * 256 + wear[i, j]
                red += cells[cell, 0]
                green += cells[cell, 1]
                blue += cells[cell, 2]
            level[row, col, 0] = int(255.0 * sqrt(red * 0.25) + 0.5)
            level[row, col, 1] = int(255.0 * sqrt(green * 0.25) + 0.5)
            level[row, col, 2] = int(255.0 * sqrt(blue * 0.25) + 0.5)


@compiled_fast
def next_level(first: int, last: int, finer: NDArrayByte, level: NDArrayByte) -> None:
    """Means of two by two cells of the level before; at the rim of those there are."""
    rows, cols = finer.shape[:2]
    for row in range(first, last):
        for col in range(level.shape[1]):
            for c in range(3):
                total = 0.0
                for k in range(4):
                    value = finer[
                        min(2 * row + k // 2, rows - 1), min(2 * col + k % 2, cols - 1), c
                    ]
                    total += float(value) * float(value)
                level[row, col, c] = int(sqrt(total * 0.25) + 0.5)


@compiled_inline
def sample_texture(
    codes: NDArrayByte,
    wear: NDArrayByte,
    cells: NDArrayFloat32,
    pyramid: NDArrayByte,
    level_shapes: NDArrayInt,
    raster: NDArrayFloat,
    level: int,
    x: float,
    y: float,
) -> tuple[float, float, float]:
    """Bilinear albedo at a point; level 0 is the raster itself, x and y from the scene's origin.

    `cells` is (65536, 3): albedo by code and wear.
    """
    per_cell = 1.0 / (raster[0] * (1 << level))
    col_at = (x - raster[1]) * per_cell - 0.5
    row_at = (y - raster[2]) * per_cell - 0.5
    col, row = floor(col_at), floor(row_at)
    u, v = col_at - col, row_at - row
    a, b, c, d = (1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v
    if level == 0:
        rows, cols = codes.shape
        if not (0 <= row < rows - 1 and 0 <= col < cols - 1):
            return cells[_GRASS_WORN, 0], cells[_GRASS_WORN, 1], cells[_GRASS_WORN, 2]
        p = np.int64(codes[row, col]) * 256 + wear[row, col]
        q = np.int64(codes[row, col + 1]) * 256 + wear[row, col + 1]
        r = np.int64(codes[row + 1, col]) * 256 + wear[row + 1, col]
        s = np.int64(codes[row + 1, col + 1]) * 256 + wear[row + 1, col + 1]
        return (
            a * cells[p, 0] + b * cells[q, 0] + c * cells[r, 0] + d * cells[s, 0],
            a * cells[p, 1] + b * cells[q, 1] + c * cells[r, 1] + d * cells[s, 1],
            a * cells[p, 2] + b * cells[q, 2] + c * cells[r, 2] + d * cells[s, 2],
        )
    rows, cols = level_shapes[level - 1, 1], level_shapes[level - 1, 2]
    if not (0 <= row < rows - 1 and 0 <= col < cols - 1):
        return cells[_GRASS_WORN, 0], cells[_GRASS_WORN, 1], cells[_GRASS_WORN, 2]
    near = level_shapes[level - 1, 0] + 3 * (row * cols + col)
    far = near + 3 * cols
    # Interpolated as stored, which differs from the mean of squares by less than any noise.
    red = a * pyramid[near] + b * pyramid[near + 3] + c * pyramid[far] + d * pyramid[far + 3]
    green = (
        a * pyramid[near + 1] + b * pyramid[near + 4] + c * pyramid[far + 1] + d * pyramid[far + 4]
    )
    blue = (
        a * pyramid[near + 2] + b * pyramid[near + 5] + c * pyramid[far + 2] + d * pyramid[far + 5]
    )
    unit = 1.0 / 65025.0
    return red * red * unit, green * green * unit, blue * blue * unit
