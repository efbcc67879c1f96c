"""The ground's colour at any scale: the surface raster's albedo and its box-filtered halvings.

Far away one pixel covers many cells of the raster; to look up one of them would make lane
marks flicker and vanish.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.simulate.materials import MATERIALS, Mat
from hdmap_tools.simulate.scene import SurfaceRaster
from hdmap_tools.types import NDArrayAny, NDArrayFloat32, NDArrayInt

NUM_LEVELS: Final = 8
PAINTS: Final = (
    Mat.PAINT_WHITE,
    Mat.PAINT_YELLOW,
    Mat.ZEBRA_PAINT,
    Mat.STOP_PAINT,
    Mat.SYMBOL_PAINT,
)
"""Materials that wear off."""


@dataclass(frozen=True, eq=False)
class GroundTexture:
    """Albedo of the ground.

    Attributes:
        albedo: (256, 3) float32 linear, by material.
        cells: (65536,) uint32 texels by 256 times material plus wear: paint as far as it
            is left, on asphalt. Red, green and blue are ten bits each, red lowest, of linear
            albedo.
        pyramid: (B,) uint32: one after the other the levels, of cells 2, 4, 8 … times the
            raster's, each (rows, cols) texels.
        level_shapes: (L, 3) where in `pyramid` each level begins, its rows, its columns.
    """

    albedo: NDArrayFloat32
    cells: NDArrayAny
    pyramid: NDArrayAny
    level_shapes: NDArrayInt


def albedo_table() -> NDArrayFloat32:
    """(256, 3) float32 linear albedo by material; grass where the id is no material."""
    table = np.tile(np.array(MATERIALS[Mat.GRASS].albedo, np.float32), (256, 1))
    for mat, material in MATERIALS.items():
        table[mat] = material.albedo
    return table


def _worn(albedo: NDArrayFloat32) -> NDArrayAny:
    from hdmap_tools.simulate.texture_kernels import FULL

    cells = np.repeat(albedo, 256, axis=0).reshape(256, 256, 3)
    left = np.linspace(0.0, 1.0, 256, dtype=np.float32)[:, None]
    for mat in PAINTS:
        cells[mat] = left * albedo[mat] + (1 - left) * albedo[Mat.ASPHALT]
    cells[Mat.GROUND] = albedo[Mat.GRASS]
    steps = np.rint(FULL * cells.reshape(-1, 3)).astype(np.uint32)
    return np.asarray(steps[:, 0] | steps[:, 1] << 10 | steps[:, 2] << 20)


def ground_texture(surface: SurfaceRaster) -> GroundTexture:
    """The texture of a surface raster; half a second for 100 million cells."""
    from hdmap_tools.simulate.compiled import ENOUGH_ROWS, in_bands
    from hdmap_tools.simulate.texture_kernels import first_level, next_level

    albedo = albedo_table()
    cells = _worn(albedo)
    shapes = []
    start = 0
    rows, cols = surface.codes.shape
    for _ in range(NUM_LEVELS):
        rows, cols = (rows + 1) // 2, (cols + 1) // 2
        shapes.append((start, rows, cols))
        start += rows * cols
    pyramid = np.empty(start, np.uint32)
    levels = [pyramid[s : s + r * c].reshape(r, c) for s, r, c in shapes]
    in_bands(
        lambda first, last: first_level(first, last, surface.codes, surface.wear, cells, levels[0]),
        len(levels[0]),
        ENOUGH_ROWS,
    )
    for finer, coarser in itertools.pairwise(levels):
        next_level(0, len(coarser), finer, coarser)
    return GroundTexture(albedo, cells, pyramid, np.array(shapes, dtype=np.int64))
