"""Compiled parts of the ground's texture: building its levels, looking it up."""

from __future__ import annotations

from math import floor, sqrt

from hdmap_tools.simulate.compiled import compiled
from hdmap_tools.types import NDArrayByte, NDArrayFloat, NDArrayFloat32

_ASPHALT = 1
_FIRST_PAINT, _LAST_PAINT = 4, 9
_ZEBRA_GAP = 7
_GRASS = 13


@compiled
def cell_albedo(
    codes: NDArrayByte, wear: NDArrayByte, albedo: NDArrayFloat32, row: int, col: int
) -> tuple[float, float, float]:
    """Albedo of one cell: paint as far as it is left, on asphalt; grass outside the raster."""
    rows, cols = codes.shape
    if not (0 <= row < rows and 0 <= col < cols):
        return albedo[_GRASS, 0], albedo[_GRASS, 1], albedo[_GRASS, 2]
    code = codes[row, col]
    if code == 0:
        code = _GRASS
    red, green, blue = albedo[code, 0], albedo[code, 1], albedo[code, 2]
    if _FIRST_PAINT <= code <= _LAST_PAINT and code != _ZEBRA_GAP:
        left = wear[row, col] * (1.0 / 255.0)
        red = left * red + (1.0 - left) * albedo[_ASPHALT, 0]
        green = left * green + (1.0 - left) * albedo[_ASPHALT, 1]
        blue = left * blue + (1.0 - left) * albedo[_ASPHALT, 2]
    return red, green, blue


@compiled
def first_level(
    first: int,
    last: int,
    codes: NDArrayByte,
    wear: NDArrayByte,
    albedo: NDArrayFloat32,
    level: NDArrayByte,
) -> None:
    """Means of two by two cells."""
    for row in range(first, last):
        for col in range(level.shape[1]):
            red = green = blue = 0.0
            for k in range(4):
                r, g, b = cell_albedo(codes, wear, albedo, 2 * row + k // 2, 2 * col + k % 2)
                red += r
                green += g
                blue += b
            level[row, col, 0] = int(255.0 * sqrt(red * 0.25) + 0.5)
            level[row, col, 1] = int(255.0 * sqrt(green * 0.25) + 0.5)
            level[row, col, 2] = int(255.0 * sqrt(blue * 0.25) + 0.5)


@compiled
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


@compiled
def _level_albedo(
    level: NDArrayByte, albedo: NDArrayFloat32, row: int, col: int
) -> tuple[float, float, float]:
    if not (0 <= row < level.shape[0] and 0 <= col < level.shape[1]):
        return albedo[_GRASS, 0], albedo[_GRASS, 1], albedo[_GRASS, 2]
    red = level[row, col, 0] * (1.0 / 255.0)
    green = level[row, col, 1] * (1.0 / 255.0)
    blue = level[row, col, 2] * (1.0 / 255.0)
    return red * red, green * green, blue * blue


@compiled
def sample_texture(
    codes: NDArrayByte,
    wear: NDArrayByte,
    albedo: NDArrayFloat32,
    levels: tuple[NDArrayByte, ...],
    raster: NDArrayFloat,
    level: int,
    x: float,
    y: float,
) -> tuple[float, float, float]:
    """Bilinear albedo at a point; level 0 is the raster itself, x and y from the scene's origin."""
    cell = raster[0] * (1 << level)
    col_at = (x - raster[1]) / cell - 0.5
    row_at = (y - raster[2]) / cell - 0.5
    col, row = int(floor(col_at)), int(floor(row_at))
    u, v = col_at - col, row_at - row
    red = green = blue = 0.0
    for k in range(4):
        i, j = k // 2, k % 2
        weight = (v if i else 1.0 - v) * (u if j else 1.0 - u)
        if level == 0:
            r, g, b = cell_albedo(codes, wear, albedo, row + i, col + j)
        else:
            r, g, b = _level_albedo(levels[level - 1], albedo, row + i, col + j)
        red += weight * r
        green += weight * g
        blue += weight * b
    return red, green, blue
