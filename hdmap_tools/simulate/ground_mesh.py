"""The ground as triangles: the road on the terrain, what lies beside it raised by its kerbs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import shapely

from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.road_area import RoadArea
from hdmap_tools.simulate.scene import Mesh
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayFloat

STEP_M: Final = 0.64
"""Of the mesh: at the terrain's strongest curvature a triangle then leaves it by 1 mm."""

_PER_TILE: Final = 40
_WALL_FOOT_M: Final = 0.05
"""Kerb faces reach so far below the road, so that no ray slips between it and them."""


def base_mesh(tiles: set[tuple[int, int]], terrain: Terrain, origin: NDArrayFloat) -> Mesh:
    """The terrain over some tiles, everywhere at road height; from the origin."""
    xs, ys = [t[0] for t in tiles], [t[1] for t in tiles]
    x0, y0, nx, ny = min(xs), min(ys), max(xs) - min(xs) + 1, max(ys) - min(ys) + 1
    x, y = np.meshgrid(
        (x0 * _PER_TILE + np.arange(nx * _PER_TILE + 1)) * STEP_M,
        (y0 * _PER_TILE + np.arange(ny * _PER_TILE + 1)) * STEP_M,
    )
    wanted = np.zeros((ny, nx), dtype=np.bool_)
    for ix, iy in tiles:
        wanted[iy - y0, ix - x0] = True
    wanted = np.repeat(np.repeat(wanted, _PER_TILE, axis=0), _PER_TILE, axis=1)
    return _grid_mesh(x, y, wanted, terrain.height_at, origin, 0.0)


def far_mesh(
    tiles: set[tuple[int, int]],
    bounds_m: tuple[float, float, float, float],
    terrain: Terrain,
    origin: NDArrayFloat,
    is_road: NDArrayAny,
) -> Mesh:
    """Coarse ground out to the horizon, a little lower so that it never covers the tiles."""
    step = 5.12
    x0, y0, x1, y1 = (round(b / step) for b in bounds_m)
    x, y = np.meshgrid(np.arange(x0, x1 + 1) * step, np.arange(y0, y1 + 1) * step)
    mesh = _grid_mesh(
        x, y, np.ones((y1 - y0, x1 - x0), dtype=np.bool_), terrain.bare_height_at, origin, -0.12
    )
    centres = mesh.vertices[mesh.triangles].mean(axis=1)[:, :2] + origin[:2]
    materials = np.where(
        shapely.intersects_xy(is_road, centres), np.uint8(Mat.ASPHALT), np.uint8(Mat.GRASS)
    )
    return Mesh(mesh.vertices, mesh.triangles, materials.astype(np.uint8))


def _grid_mesh(
    x: NDArrayFloat,
    y: NDArrayFloat,
    wanted: NDArrayBool,
    height_at: Callable[[NDArrayFloat], NDArrayFloat],
    origin: NDArrayFloat,
    lift_m: float,
) -> Mesh:
    xy = np.column_stack([x.ravel(), y.ravel()])
    vertices = np.column_stack([xy, height_at(xy) + lift_m]) - origin
    rows, cols = np.nonzero(wanted)
    a = rows * x.shape[1] + cols
    b, c, d = a + 1, a + x.shape[1] + 1, a + x.shape[1]
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    materials = np.full(len(triangles), Mat.GROUND, dtype=np.uint8)
    return Mesh(vertices.astype(np.float32), triangles.astype(np.uint32), materials)


def raised_mesh(ix: int, iy: int, area: RoadArea, terrain: Terrain, origin: NDArrayFloat) -> Mesh:
    """What lies beside the road in one tile, raised, with the faces of the kerbs."""
    nodes = np.arange(_PER_TILE + 1)
    x, y = np.meshgrid((ix * _PER_TILE + nodes) * STEP_M, (iy * _PER_TILE + nodes) * STEP_M)
    lows = (x[:-1, :-1], y[:-1, :-1])
    cells = shapely.box(*lows, x[1:, 1:], y[1:, 1:]).ravel()
    road = area.prepared
    touches = shapely.intersects(road, cells)
    inside = shapely.contains_properly(road, cells)
    parts = shapely.difference(cells[touches & ~inside], area.drivable)
    pieces = shapely.get_parts(parts)
    pieces = pieces[(shapely.get_type_id(pieces) == 3) & (shapely.area(pieces) > 1e-8)]
    rows, cols = np.divmod(np.nonzero(~touches)[0], _PER_TILE)
    a = rows * (_PER_TILE + 1) + cols
    b, c, d = a + 1, a + _PER_TILE + 2, a + _PER_TILE + 1
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    caps = Mesh.merged([])
    if len(triangles):
        used, renumbered = np.unique(triangles, return_inverse=True)
        xy = np.column_stack([x.ravel(), y.ravel()])[used]
        caps = _raised(xy, renumbered.reshape(-1, 3), area, terrain, origin)
    return Mesh.merged([caps, _caps_and_faces(pieces, area, terrain, origin)])


def _caps_and_faces(
    pieces: NDArrayAny, area: RoadArea, terrain: Terrain, origin: NDArrayFloat
) -> Mesh:
    if len(pieces) == 0:
        return Mesh.merged([])
    split = shapely.get_parts(shapely.constrained_delaunay_triangles(pieces))
    split = shapely.orient_polygons(split)
    corners = shapely.get_coordinates(split).reshape(-1, 4, 2)[:, :3]
    triangles = np.arange(3 * len(split)).reshape(-1, 3)
    caps = _raised(corners.reshape(-1, 2), triangles, area, terrain, origin)

    rings = shapely.get_rings(shapely.orient_polygons(pieces))
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    follows = ring[:-1] == ring[1:]
    a, b = xy[:-1][follows], xy[1:][follows]
    faces_road = shapely.dwithin(area.boundary, shapely.points((a + b) / 2), 1e-6)
    a, b = a[faces_road], b[faces_road]
    n = len(a)
    ends = np.concatenate([a, b])
    ground, lift = terrain.height_at(ends), area.raise_at(ends)
    # A ring turns left around its piece, so the road is on the right of its edges.
    feet = np.column_stack([ends, ground - _WALL_FOOT_M])
    tops = np.column_stack([ends, ground + lift])
    vertices = np.concatenate([feet, tops]) - origin
    a0, b0, a1, b1 = (np.arange(n) + k * n for k in range(4))
    faces = np.concatenate([np.column_stack([a0, b0, b1]), np.column_stack([a0, b1, a1])])
    stands = np.tile((lift[:n] + lift[n:]) > 0, 2)
    faces = faces[stands]
    walls = Mesh(
        vertices.astype(np.float32),
        faces.astype(np.uint32),
        np.full(len(faces), Mat.KERB, dtype=np.uint8),
    )
    return Mesh.merged([caps, walls])


def _raised(
    xy: NDArrayFloat,
    triangles: NDArrayAny,
    area: RoadArea,
    terrain: Terrain,
    origin: NDArrayFloat,
) -> Mesh:
    lift = area.raise_at(xy)
    vertices = np.column_stack([xy, terrain.height_at(xy) + lift]) - origin
    kept = triangles[(lift[triangles] > 0).any(axis=1)]  # else the terrain itself is the surface
    return Mesh(
        vertices.astype(np.float32),
        kept.astype(np.uint32),
        np.full(len(kept), Mat.GROUND, dtype=np.uint8),
    )
