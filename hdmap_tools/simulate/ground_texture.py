"""The ground's colour at any scale: the surface raster's albedo and its box-filtered halvings.

Far away one pixel covers many cells of the raster; to look up one of them would make lane
marks flicker and vanish.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdmap_tools.simulate.materials import MATERIALS, Mat
from hdmap_tools.simulate.scene import SurfaceRaster
from hdmap_tools.types import NDArrayByte, NDArrayFloat32

NUM_LEVELS = 8


@dataclass(frozen=True, eq=False)
class GroundTexture:
    """Albedo of the ground.

    Attributes:
        albedo: (256, 3) float32 linear, by material.
        levels: Of cells 2, 4, 8 … times the raster's: (rows, cols, 3) uint8, the
            square root of linear albedo times 255: finer steps where it is dark.
    """

    albedo: NDArrayFloat32
    levels: tuple[NDArrayByte, ...]


def albedo_table() -> NDArrayFloat32:
    """(256, 3) float32 linear albedo by material; grass where the id is no material."""
    table = np.tile(np.array(MATERIALS[Mat.GRASS].albedo, np.float32), (256, 1))
    for mat, material in MATERIALS.items():
        table[mat] = material.albedo
    return table


def ground_texture(surface: SurfaceRaster) -> GroundTexture:
    """The texture of a surface raster; half a second for 100 million cells."""
    from hdmap_tools.simulate.compiled import in_bands
    from hdmap_tools.simulate.texture_kernels import first_level, next_level

    albedo = albedo_table()
    rows, cols = surface.codes.shape
    level = np.empty(((rows + 1) // 2, (cols + 1) // 2, 3), np.uint8)
    in_bands(
        lambda first, last: first_level(first, last, surface.codes, surface.wear, albedo, level),
        len(level),
    )
    levels = [level]
    for _ in range(NUM_LEVELS - 1):
        finer = levels[-1]
        coarser = np.empty(((finer.shape[0] + 1) // 2, (finer.shape[1] + 1) // 2, 3), np.uint8)
        next_level(0, len(coarser), finer, coarser)
        levels.append(coarser)
    return GroundTexture(albedo, tuple(levels))
