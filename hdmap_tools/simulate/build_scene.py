"""From a map and a route to what the sensors see around one piece of the route."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from hdmap_tools.errors import WorldError
from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.simulate.ground_mesh import base_mesh, far_mesh, raised_mesh
from hdmap_tools.simulate.objects import RoadsideObjects
from hdmap_tools.simulate.parked import parked_vehicles
from hdmap_tools.simulate.road_area import WorldIndex
from hdmap_tools.simulate.road_crown import RoadCrown
from hdmap_tools.simulate.route import Route
from hdmap_tools.simulate.scene import Actor, Mesh, Scene
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.surface import TILE_M, SurfaceTiles, block_of_tile
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.simulate.world_map import WorldMap
from hdmap_tools.types import NDArrayFloat

NEAR_M: Final = 60.0
"""Ground in full detail so far from the route."""

FAR_M: Final = 95.0
"""Buildings and trees so far from the route, so that the horizon is not empty."""

HORIZON_M: Final = 260.0
"""Coarse ground so far beyond the stretch."""


class SceneBuilder:
    """Builds scenes of one world; what neighbouring stretches share is made once.

    Attributes:
        world: The map.
        settings: Everything random follows from its seed.
        terrain: Heights, the same for all scenes.
        index: The world, ready to be asked about a place.
        tiles: What its ground is made of.
    """

    def __init__(
        self, world: WorldMap, settings: SimulationSettings, terrain: Terrain | None = None
    ) -> None:
        self.world = world
        self.settings = settings
        self.index = WorldIndex(world)
        self.terrain = terrain or Terrain(settings.place_seed, crown=RoadCrown(self.index))
        self.tiles = SurfaceTiles(self.index, settings)
        self.objects = RoadsideObjects(self.index, self.terrain, settings)

    def scene(
        self, route: Route, stretch_m: tuple[float, float], actors: tuple[Actor, ...] = ()
    ) -> Scene:
        """The scene around the part of a route between two arc lengths.

        Args:
            route: Where the vehicle drives.
            stretch_m: First and last arc length at which it may be.
            actors: Of the whole drive; those that come near stay.

        Raises:
            WorldError: If the stretch does not meet the route.
        """
        driven = route_piece(route, stretch_m)
        near = tiles_within(driven, NEAR_M)
        far = tiles_within(driven, FAR_M)
        middle = (driven.min(axis=0) + driven.max(axis=0)) / 2
        height = float(self.terrain.height_at(middle[None])[0])
        origin = np.round(np.array([*middle, height]))
        way = shapely.LineString(route.xy)
        shapely.prepare(way)
        parts = [base_mesh(near, self.terrain, origin)]
        for tile in sorted(near):
            area = self.index.road_area(block_of_tile(*tile))
            parts.append(raised_mesh(*tile, area, self.terrain, origin))
        for tile in sorted(far):
            corner = np.array([tile[0] * TILE_M, tile[1] * TILE_M, 0.0])
            mesh = self.objects.mesh(*tile)
            if tile in near:
                parked = parked_vehicles(self.index, self.terrain, self.settings, tile, way)
                mesh = Mesh.merged([mesh, parked])
            shifted = mesh.vertices.astype(np.float64) + (corner - origin)
            parts.append(Mesh(shifted.astype(np.float32), mesh.triangles, mesh.materials))
        parts.append(self._horizon(driven, near, origin))
        close = tuple(actor for actor in actors if _comes_near(actor, driven))
        return Scene(origin, Mesh.merged(parts), self.tiles.raster(near), close, stretch_m)

    def _horizon(
        self, driven: NDArrayFloat, near: set[tuple[int, int]], origin: NDArrayFloat
    ) -> Mesh:
        low, high = driven.min(axis=0) - HORIZON_M, driven.max(axis=0) + HORIZON_M
        bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        road = self.index.rough_road(shapely.box(*bounds))
        return far_mesh(near, bounds, self.terrain, origin, road)


def build_scene(
    world: WorldMap,
    route: Route,
    stretch_m: tuple[float, float],
    settings: SimulationSettings,
    actors: tuple[Actor, ...] = (),
) -> Scene:
    """One scene; for several of one world make a `SceneBuilder`."""
    return SceneBuilder(world, settings).scene(route, stretch_m, actors)


def route_piece(route: Route, stretch_m: tuple[float, float]) -> NDArrayFloat:
    """(N, 2) the part of a route between two arc lengths, city metres.

    Raises:
        WorldError: If they do not meet the route.
    """
    along = arc_lengths(route.xy)
    first, last = max(stretch_m[0], 0.0), min(stretch_m[1], float(along[-1]))
    if last < first:
        raise WorldError(
            f"The stretch {stretch_m[0]} to {stretch_m[1]} m does not meet the route, which is "
            f"{along[-1]:.1f} m long."
        )
    at = np.append(np.arange(first, last, 1.0), last)
    return np.column_stack([np.interp(at, along, route.xy[:, d]) for d in (0, 1)])


def tiles_within(xy: NDArrayFloat, reach_m: float) -> set[tuple[int, int]]:
    """Tiles of the surface raster that come within reach of any of the points (N, 2)."""
    found: set[tuple[int, int]] = set()
    span = int(np.ceil(reach_m / TILE_M))
    dx, dy = np.meshgrid(np.arange(-span, span + 1), np.arange(-span, span + 1))
    for p in xy[:: max(int(len(xy) // 200), 1)].tolist() + [xy[-1].tolist()]:
        ix = np.floor(p[0] / TILE_M) + dx
        iy = np.floor(p[1] / TILE_M) + dy
        gap_x = np.maximum(np.maximum(ix * TILE_M - p[0], p[0] - (ix + 1) * TILE_M), 0.0)
        gap_y = np.maximum(np.maximum(iy * TILE_M - p[1], p[1] - (iy + 1) * TILE_M), 0.0)
        meets = gap_x**2 + gap_y**2 <= reach_m**2
        found |= set(
            zip(ix[meets].astype(int).tolist(), iy[meets].astype(int).tolist(), strict=True)
        )
    return found


def _comes_near(actor: Actor, driven: NDArrayFloat) -> bool:
    low, high = driven.min(axis=0) - FAR_M, driven.max(axis=0) + FAR_M
    xy = actor.xyz_city[:, :2]
    return bool(((xy >= low) & (xy <= high)).all(axis=1).any())
