"""A street made by hand: level ground, stripes, a house, a car that drives by."""

from functools import cache

import numpy as np

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.scene import Actor, Mesh, Scene, SurfaceRaster

ORIGIN = np.array([1000.0, 2000.0, 100.0])
RESOLUTION_M = 0.02
BOUNDS_M = (-20.0, -15.0, 60.0, 15.0)
"""Of the surface raster, from ORIGIN; the ground's mesh reaches 200 m."""

HOUSE = ((20.0, 8.0, 0.0), (32.0, 14.0, 7.0))
CAR = ((-2.2, -0.9, 0.0), (2.2, 0.9, 1.5))
CAR_Y = -5.0
CAR_MPS = 10.0


def box(low: tuple[float, ...], high: tuple[float, ...], mat: Mat) -> Mesh:
    """A box, its triangles counter-clockwise seen from outside."""
    corners = np.array(
        [
            [(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]]
            for k in (0, 1)
            for j in (0, 1)
            for i in (0, 1)
        ],
        np.float32,
    )
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Mesh(corners, np.array(triangles, np.uint32), np.full(12, mat, np.uint8))


def ground(slope: float = 0.0) -> Mesh:
    """A plane z = slope * x."""
    vertices = np.array(
        [[x, y, slope * x] for x, y in ((-200, -200), (200, -200), (200, 200), (-200, 200))],
        np.float32,
    )
    return Mesh(
        vertices, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), np.full(2, Mat.GROUND, np.uint8)
    )


def surface() -> SurfaceRaster:
    """Asphalt 7 m wide with edge lines, a dashed middle, a zebra at x = 10..13, pavement, grass."""
    grid = BevGrid.from_bounds(
        (
            BOUNDS_M[0] + ORIGIN[0],
            BOUNDS_M[1] + ORIGIN[1],
            BOUNDS_M[2] + ORIGIN[0],
            BOUNDS_M[3] + ORIGIN[1],
        ),
        RESOLUTION_M,
    )
    x = (grid.x_centres_m - ORIGIN[0])[None, :]
    y = (grid.y_centres_m - ORIGIN[1])[:, None]
    codes = np.full(grid.shape, Mat.GRASS, np.uint8)
    codes[np.broadcast_to(np.abs(y) < 7.0, grid.shape)] = Mat.SIDEWALK
    codes[np.broadcast_to(np.abs(y) < 3.62, grid.shape)] = Mat.KERB
    codes[np.broadcast_to(np.abs(y) < 3.5, grid.shape)] = Mat.ASPHALT
    codes[np.broadcast_to(np.abs(np.abs(y) - 3.2) < 0.06, grid.shape)] = Mat.PAINT_WHITE
    codes[(np.abs(y) < 0.06) & (x % 9.0 < 3.0)] = Mat.PAINT_WHITE
    zebra = (x >= 10.0) & (x < 13.0) & (np.abs(y) < 3.0)
    codes[zebra & (y % 1.0 < 0.5)] = Mat.ZEBRA_PAINT
    codes[zebra & (y % 1.0 >= 0.5)] = Mat.ZEBRA_GAP
    return SurfaceRaster(grid, codes, np.full(grid.shape, 255, np.uint8))


def driving_car() -> Actor:
    """Passes x = 0 at second 0 and drives along x."""
    times = np.array([-5.0, 5.0])
    x = CAR_MPS * times
    return Actor(
        box(*CAR, Mat.CAR_BODY_RED),
        times,
        np.column_stack([x, np.full(2, CAR_Y), np.zeros(2)]) + ORIGIN,
        np.zeros(2),
    )


@cache
def street(*, with_car: bool = False, with_house: bool = True, slope: float = 0.0) -> Scene:
    """The street."""
    meshes = [ground(slope)]
    if with_house:
        meshes.append(box(*HOUSE, Mat.BUILDING_PLASTER))
    return Scene(
        origin_city=ORIGIN,
        static=Mesh.merged(meshes),
        surface=surface(),
        actors=(driving_car(),) if with_car else (),
    )
