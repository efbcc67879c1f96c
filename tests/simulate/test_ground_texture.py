"""The ground's texture against plain means of its cells' albedo."""

import numpy as np
import pytest

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.simulate.ground_texture import GroundTexture, ground_texture
from hdmap_tools.simulate.materials import MATERIALS, Mat
from hdmap_tools.simulate.scene import SurfaceRaster
from hdmap_tools.simulate.texture_kernels import footprints, look_up
from hdmap_tools.types import NDArrayFloat

CELL_M = 0.02
STEP = 1.0 / 1023


def surface_of(codes: NDArrayFloat) -> SurfaceRaster:
    rows, cols = codes.shape
    grid = BevGrid(CELL_M, 0, 0, cols, rows)
    return SurfaceRaster(grid, codes.astype(np.uint8), np.full(codes.shape, 255, np.uint8))


def mixed(rows: int, cols: int) -> NDArrayFloat:
    kinds = np.array([Mat.ASPHALT, Mat.PAINT_WHITE, Mat.PAINT_YELLOW, Mat.SIDEWALK, Mat.GRASS])
    return kinds[np.random.default_rng(4).integers(0, len(kinds), (rows, cols))]


def albedo_of(codes: NDArrayFloat) -> NDArrayFloat:
    return np.array([MATERIALS[Mat(int(c))].albedo for c in codes.ravel()]).reshape(*codes.shape, 3)


def seen(
    surface: SurfaceRaster,
    texture: GroundTexture,
    xy: NDArrayFloat,
    across_m: float,
    along_m: float,
    toward: tuple[float, float] = (1.0, 0.0),
) -> NDArrayFloat:
    places = footprints(len(xy))
    places.x[:], places.y[:] = xy.T
    places.toward_x[:], places.toward_y[:] = toward
    places.across_m[:], places.along_m[:] = across_m, along_m
    colour = np.full((len(xy), 3), np.nan)
    look_up(
        len(xy),
        places,
        surface.codes,
        surface.wear,
        texture.cells,
        texture.pyramid,
        texture.level_shapes,
        np.array([CELL_M, 0.0, 0.0]),
        colour,
    )
    return colour


def test_up_close_it_is_bilinear_between_the_cells() -> None:
    codes = mixed(40, 60)
    surface = surface_of(codes)
    albedo = albedo_of(codes)
    xy = np.random.default_rng(5).uniform((0.1, 0.1), (1.1, 0.7), (500, 2))
    at = xy / CELL_M - 0.5
    col, row = np.floor(at).astype(int).T
    u, v = (at - np.floor(at)).T[:, :, None]
    expected = (
        (1 - u) * (1 - v) * albedo[row, col]
        + u * (1 - v) * albedo[row, col + 1]
        + (1 - u) * v * albedo[row + 1, col]
        + u * v * albedo[row + 1, col + 1]
    )
    found = seen(surface, ground_texture(surface), xy, 0.004, 0.01)
    # Weights come in 256ths, each off by half of one at most, and albedo in 1023rds.
    np.testing.assert_allclose(found, expected, atol=4 * 0.8 / 256 * 0.75 + STEP)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_far_away_it_is_the_mean_of_what_a_pixel_covers(level: int) -> None:
    codes = mixed(64, 128)
    surface = surface_of(codes)
    size = 2**level
    blocks = albedo_of(codes).reshape(64 // size, size, 128 // size, size, 3).mean(axis=(1, 3))
    rows, cols = np.indices(blocks.shape[:2])
    inner = (rows > 0) & (rows < len(blocks) - 1) & (cols > 0) & (cols < blocks.shape[1] - 1)
    xy = np.column_stack([cols[inner] + 0.5, rows[inner] + 0.5]) * size * CELL_M
    found = seen(surface, ground_texture(surface), xy, size * CELL_M, size * CELL_M)
    np.testing.assert_allclose(found, blocks[inner], atol=(0.5 * level + 0.6) * STEP)


def test_a_slanting_look_is_the_mean_along_its_line_and_not_across() -> None:
    # A white line along x, one cell wide: seen along itself it is white, across it a fifth.
    codes = np.full((64, 64), Mat.ASPHALT)
    codes[30] = Mat.PAINT_WHITE
    surface = surface_of(codes)
    texture = ground_texture(surface)
    middle = np.array([[32.5, 30.5]]) * CELL_M
    along = seen(surface, texture, middle, CELL_M, 5 * CELL_M, (1.0, 0.0))[0]
    across = seen(surface, texture, middle, CELL_M, 5 * CELL_M, (0.0, 1.0))[0]
    white = np.array(MATERIALS[Mat.PAINT_WHITE].albedo)
    asphalt = np.array(MATERIALS[Mat.ASPHALT].albedo)
    np.testing.assert_allclose(along, white, atol=STEP)
    np.testing.assert_allclose(across, 0.2 * white + 0.8 * asphalt, atol=2 * STEP)


def test_beyond_its_rim_the_ground_is_grass() -> None:
    surface = surface_of(np.full((32, 32), Mat.ASPHALT))
    outside = np.array([[-1.0, 0.3], [0.3, 5.0], [1e6, -1e6]])
    for size in (0.01, 0.1):
        found = seen(surface, ground_texture(surface), outside, size, size)
        np.testing.assert_allclose(found, [MATERIALS[Mat.GRASS].albedo] * 3, atol=STEP)
