"""Vehicles parked along kerbs: on the road where it is wide enough, else beside it."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import shapely

from hdmap_tools.simulate import vehicles
from hdmap_tools.simulate.furniture import moved
from hdmap_tools.simulate.location_noise import Purpose, rng_at, value_noise
from hdmap_tools.simulate.road_area import WorldIndex
from hdmap_tools.simulate.scene import Mesh
from hdmap_tools.simulate.settings import Difficulty, SimulationSettings
from hdmap_tools.simulate.surface import TILE_M, block_of_tile, lane_centre
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.types import NDArrayFloat

ROUTE_CLEAR_M: Final = 2.3 + vehicles.MIRROR_M
"""Between the line that is driven and the side of a parked vehicle, whose mirrors reach further."""

_LANE_CLEAR_M: Final = 1.25
"""Between the middle of any lane and a parked vehicle: others drive there."""

_SHARE: Final = {Difficulty.EASY: 0.06, Difficulty.DEFAULT: 0.2, Difficulty.HARD: 0.45}
"""Of the places along kerbs; about half of them turn out to be free for parking."""


def parked_vehicles(
    index: WorldIndex,
    terrain: Terrain,
    settings: SimulationSettings,
    tile: tuple[int, int],
    route: shapely.LineString,
) -> Mesh:
    """Parked vehicles of a tile, vertices from the tile's south-west corner at height 0.

    They follow from the place, the seed and the route, which they keep clear.
    """
    area = index.road_area(block_of_tile(*tile))
    corner = np.array(tile) * TILE_M
    box = shapely.box(*corner, *(corner + TILE_M))
    if area.boundary.is_empty or not shapely.dwithin(area.boundary, box, 6.0):
        return Mesh.merged([])
    around = box.buffer(14.0)
    lanes = [lane_centre(lane, 1.0) for lane in index.lanes_near(around) if lane.kind == "road"]
    if not lanes:
        return Mesh.merged([])
    middles = shapely.multilinestrings([shapely.LineString(c) for c in lanes])
    keep_off = [index.world.crosswalks[k] for k in index.crosswalk_tree.query(around)]
    keep_off += [index.world.stop_lines[k] for k in index.stop_line_tree.query(around)]
    off_limits = shapely.union_all(keep_off).buffer(6.0)
    parts: list[Mesh] = []
    for xy, yaw, rng in _places(index, settings, tile):
        mesh, (length, width) = vehicles.car(rng)
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        right = np.array([ahead[1], -ahead[0]])  # towards the pavement
        kerb = shapely.Point(xy)
        # How far it may reach into the road before it stands in a lane or in the route's way.
        stretch = shapely.LineString([xy - ahead * length / 2, xy + ahead * length / 2])
        room = min(
            middles.distance(stretch) - _LANE_CLEAR_M, route.distance(stretch) - ROUTE_CLEAR_M
        )
        inset = min(room, width + 0.15)
        if room < width + 0.15:
            inset = min(room, 0.4)  # two wheels on the pavement, or all four
        if inset < -2.5 or off_limits.intersects(kerb):
            continue
        at = xy + right * (width / 2 - inset)
        half_u, half_v = ahead * length / 2, right * width / 2
        outline = shapely.Polygon(
            [at - half_u - half_v, at + half_u - half_v, at + half_u + half_v, at - half_u + half_v]
        )
        if middles.distance(outline) < _LANE_CLEAR_M or route.distance(outline) < ROUTE_CLEAR_M:
            continue  # a bend brings it nearer than its ends say
        height = float(terrain.height_at(at[None])[0])
        slope = terrain.gradient_at(at[None])[0]
        if inset < width:
            share = 1.0 if inset <= 0 else 0.5
            height += share * float(area.raise_at(at[None])[0])
        z = mesh.vertices[:, 0] * float(slope @ ahead) - mesh.vertices[:, 1] * float(slope @ right)
        tilted = Mesh(
            np.column_stack([mesh.vertices[:, :2], mesh.vertices[:, 2] + z]).astype(np.float32),
            mesh.triangles,
            mesh.materials,
        )
        parts.append(moved(tilted, (*(at - corner), height), yaw))
    return Mesh.merged(parts)


def _places(
    index: WorldIndex, settings: SimulationSettings, tile: tuple[int, int]
) -> list[tuple[NDArrayFloat, float, np.random.Generator]]:
    """Places at kerbs of a tile, the road on their left, none within 6.5 m of one of higher rank."""
    candidates = [
        c
        for dx in (-1, 0, 1)
        for dy in (-1, 0, 1)
        for c in _candidates(index, settings, (tile[0] + dx, tile[1] + dy))
    ]
    chosen = []
    for place, xy, yaw, rank in candidates:
        if place[:2] != tile:
            continue
        if any(r > rank and np.hypot(*(o - xy)) < 6.5 for _, o, _, r in candidates):
            continue
        chosen.append((xy, yaw, rng_at(settings.seed, Purpose.PARKED, *place, 1)))
    return chosen


@lru_cache(maxsize=400)
def _candidates(
    index: WorldIndex, settings: SimulationSettings, tile: tuple[int, int]
) -> list[tuple[tuple[int, int, int], NDArrayFloat, float, float]]:
    area = index.road_area(block_of_tile(*tile))
    found: list[tuple[tuple[int, int, int], NDArrayFloat, float, float]] = []
    if area.boundary.is_empty:
        return found
    share = _SHARE[settings.difficulty]
    for k in range(25):
        rng = rng_at(settings.seed, Purpose.PARKED, *tile, k)
        p = (np.array(tile) + (np.array([k % 5, k // 5]) + rng.uniform(0, 1, 2)) / 5) * TILE_M
        rank = float(rng.uniform())
        # Streets full of cars, and streets without.
        crowd = float(value_noise(p[None], 60.0, settings.seed, Purpose.PARKED)[0])
        if rng.uniform() > np.clip(share * 4.0 * (crowd - 0.25), 0.0, 0.95):
            continue
        point = shapely.Point(p)
        if shapely.distance(area.boundary, point) > 6.0:
            continue
        q = shapely.get_coordinates(shapely.shortest_line(area.boundary, point))[0]
        outward = (p - q) * (-1.0 if area.prepared.intersects(point) else 1.0)
        norm = float(np.linalg.norm(outward))
        if norm < 1e-3:
            continue
        yaw = float(np.arctan2(outward[1], outward[0]) + np.pi / 2)
        found.append(((*tile, k), q, yaw, rank))
    return found
