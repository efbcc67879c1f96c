"""What stands beside the road, tile by tile: where it is follows from the seed and the place.

Nothing here depends on where a vehicle drives or on what was made before. What would overlap
gives way to its neighbour of higher rank, and the rank is a number of the place too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeVar

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from hdmap_tools.geometry.polyline import resample
from hdmap_tools.simulate import furniture
from hdmap_tools.simulate.location_noise import Purpose, rng_at, value_noise
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.road_area import RoadArea, WorldIndex
from hdmap_tools.simulate.scene import Mesh
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.surface import KERB_WIDTH_M, TILE_M, block_of_tile, sidewalk_width
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.simulate.world_map import LineKind
from hdmap_tools.types import NDArrayFloat

_WALLS: Final = (Mat.BUILDING_PLASTER, Mat.BUILDING_BRICK, Mat.BUILDING_CONCRETE)

_BARRIERS: Final = {
    # height, thickness, foot, material
    LineKind.FENCE: (1.4, 0.04, 0.05, Mat.FENCE),
    LineKind.WALL: (1.6, 0.25, -0.3, Mat.WALL),
    LineKind.GUARD_RAIL: (0.75, 0.08, 0.45, Mat.GUARD_RAIL),
}

_HEADROOM_M: Final = 2.6
"""Crowns over the road begin so high above the foot of their tree."""

T = TypeVar("T")


@dataclass(frozen=True)
class Placed:
    """A candidate for a thing at a place.

    Attributes:
        footprint: The ground it needs.
        xy: (2,) where its frame lies, city metres.
        yaw_rad: Of its x axis.
        rank: The higher gets the ground.
        rng_place: Seeds its shape.
        size: Width along x and depth of a building, height twice of a tree; metres.
    """

    footprint: BaseGeometry
    xy: NDArrayFloat
    yaw_rad: float
    rank: float
    rng_place: tuple[int, ...]
    size: tuple[float, float]


class RoadsideObjects:
    """Meshes of what stands in each tile.

    Attributes:
        index: The world.
        terrain: What it stands on.
        settings: Its seed decides what stands where.
    """

    def __init__(self, index: WorldIndex, terrain: Terrain, settings: SimulationSettings) -> None:
        self.index = index
        self.terrain = terrain
        self.settings = settings
        self._lots = _kept(self._lot_candidates)
        self._accepted_lots = _kept(self._choose_lots)
        self._trees = _kept(self._tree_candidates)
        self._meshes = _kept(self._make)

    def mesh(self, ix: int, iy: int) -> Mesh:
        """All that stands in a tile, vertices from the tile's south-west corner at height 0."""
        return self._meshes((ix, iy))

    def _make(self, tile: tuple[int, int]) -> Mesh:
        corner = np.array([tile[0] * TILE_M, tile[1] * TILE_M])
        parts = [
            *self._buildings(tile, corner),
            *self._tree_meshes(tile, corner),
            *self._lamps_and_signs(tile, corner),
            *self._hedges(tile, corner),
            *self._barriers(tile, corner),
            *self._traffic_lights(tile, corner),
        ]
        return Mesh.merged(parts)

    def _area(self, tile: tuple[int, int]) -> RoadArea:
        return self.index.road_area(block_of_tile(*tile))

    def _stand(
        self,
        shape: Mesh,
        placed_xy: NDArrayFloat,
        yaw: float,
        corner: NDArrayFloat,
        lift: float = 0.0,
    ) -> Mesh:
        z = float(self.terrain.height_at(placed_xy[None])[0]) + lift
        return furniture.moved(shape, (*(placed_xy - corner), z), yaw)

    # Buildings

    def _lot_candidates(self, tile: tuple[int, int]) -> list[Placed]:
        area = self._area(tile)
        if area.boundary.is_empty:
            return []
        seed, found = self.settings.place_seed, []
        walk_m = sidewalk_width((0, 0), seed)
        for k in range(4):
            rng = rng_at(seed, Purpose.LOT, *tile, k)
            p = (np.array(tile) + np.array([k % 2, k // 2]) / 2 + rng.uniform(0, 0.5, 2)) * TILE_M
            width, depth = float(rng.uniform(9, 20)), float(rng.uniform(8, 12))
            front = float(value_noise(p[None], 70.0, seed, Purpose.LOT)[0])
            setback = KERB_WIDTH_M + walk_m + 2.0 + 9.0 * front**1.5
            is_built = rng.uniform() < 0.85
            nearest = _nearest(area, p)
            if nearest is None or not is_built:
                continue
            q, away, distance = nearest
            if not setback - 3.0 < distance < setback + depth + 8.0:
                continue
            xy = q + away * (setback + depth / 2)
            yaw = float(np.arctan2(away[1], away[0]) - np.pi / 2)
            footprint = _rectangle(xy, yaw, width, depth)
            if shapely.distance(area.drivable, footprint) < min(setback - 1.5, 6.0):
                continue
            if any(footprint.distance(b) < 2.0 for b in self.index.world.areas.get("building", ())):
                continue
            found.append(
                Placed(footprint, xy, yaw, float(rng.uniform()), (*tile, k), (width, depth))
            )
        return found

    def _choose_lots(self, tile: tuple[int, int]) -> list[Placed]:
        """Those that no overlapping candidate outranks."""
        others = [lot for t in _around(tile, 2) for lot in self._lots(t)]
        return [
            lot
            for lot in self._lots(tile)
            if not any(o.rank > lot.rank and o.footprint.intersects(lot.footprint) for o in others)
        ]

    def _buildings(self, tile: tuple[int, int], corner: NDArrayFloat) -> list[Mesh]:
        meshes = self._mapped_buildings(tile, corner)
        for lot in self._accepted_lots(tile):
            rng = rng_at(self.settings.place_seed, Purpose.LOT, *lot.rng_place, 99)
            wall = _WALLS[int(rng.integers(len(_WALLS)))]
            shape = furniture.building(*lot.size, float(rng.uniform(5.5, 17)), wall, rng)
            meshes.append(self._stand(shape, lot.xy, lot.yaw_rad, corner, 0.1))
        return meshes

    def _mapped_buildings(self, tile: tuple[int, int], corner: NDArrayFloat) -> list[Mesh]:
        """What of the map's buildings stands in a tile, off the road, as blocks over their outline."""
        meshes = []
        box = shapely.box(*corner, *(corner + TILE_M))
        area = self._area(tile)
        for polygon in self.index.world.areas.get("building", ()):
            if not polygon.intersects(box):
                continue
            middle = np.array([polygon.centroid.x, polygon.centroid.y])
            rng = rng_at(self.settings.place_seed, Purpose.LOT, *np.round(middle).astype(int))
            wall = _WALLS[int(rng.integers(len(_WALLS)))]
            top = float(self.terrain.height_at(middle[None])[0] + rng.uniform(6, 18))
            part = shapely.intersection(polygon, box)
            part = shapely.difference(part, area.drivable.buffer(1.5))
            for piece in shapely.get_parts(part):
                if piece.geom_type != "Polygon" or piece.area < 1.0:
                    continue
                # Walls along the tile's own sides are inside the building.
                meshes.append(
                    furniture.outlined_building(
                        piece, corner, box.exterior, self.terrain, top, wall
                    )
                )
        return meshes

    # Vegetation

    def _tree_candidates(self, tile: tuple[int, int]) -> list[Placed]:
        area = self._area(tile)
        seed, found = self.settings.place_seed, []
        for k in range(16):
            rng = rng_at(seed, Purpose.TREE, *tile, k)
            p = (np.array(tile) + np.array([k % 4, k // 4]) / 4 + rng.uniform(0, 0.25, 2)) * TILE_M
            wooded = float(value_noise(p[None], 45.0, seed, Purpose.TREE)[0])
            is_kept = rng.uniform() < (0.15 + 0.6 * wooded)
            height = float(rng.uniform(4.5, 12.0))
            nearest = _nearest(area, p)
            if not is_kept or area.prepared.intersects(shapely.Point(p)):
                continue
            if nearest is not None:
                q, away, distance = nearest
                if distance < 4.5:
                    if distance < 0.4 or wooded < 0.45:
                        continue
                    p = q + away * 1.1  # a row along the kerb
                    height = min(height, 8.0)
                if area.drivable.distance(shapely.Point(p)) < 0.9:
                    continue
            footprint = shapely.Point(p).buffer(2.2, quad_segs=3)
            found.append(
                Placed(footprint, p, 0.0, float(rng.uniform()), (*tile, k), (height, height))
            )
        return found

    def _tree_meshes(self, tile: tuple[int, int], corner: NDArrayFloat) -> list[Mesh]:
        lots = [lot.footprint for t in _around(tile, 1) for lot in self._accepted_lots(t)]
        lots += [a for a in self.index.world.areas.get("building", ())]
        others = [tree for t in _around(tile, 1) for tree in self._trees(t)]
        meshes = []
        for tree in self._trees(tile):
            if any(o.rank > tree.rank and np.hypot(*(o.xy - tree.xy)) < 4.4 for o in others):
                continue
            if any(lot.distance(shapely.Point(tree.xy)) < 2.6 for lot in lots):
                continue
            rng = rng_at(self.settings.place_seed, Purpose.TREE, *tree.rng_place, 99)
            shape = _pruned(furniture.tree(tree.size[0], rng), tree.xy, self._area(tile))
            meshes.append(self._stand(shape, tree.xy, 0.0, corner, 0.1))
        return meshes

    def _hedges(self, tile: tuple[int, int], corner: NDArrayFloat) -> list[Mesh]:
        area, seed = self._area(tile), self.settings.place_seed
        lots = [lot.footprint for t in _around(tile, 1) for lot in self._accepted_lots(t)]
        meshes = []
        for k in range(4):
            rng = rng_at(seed, Purpose.HEDGE, *tile, k)
            p = (np.array(tile) + np.array([k % 2, k // 2]) / 2 + rng.uniform(0, 0.5, 2)) * TILE_M
            length, height = float(rng.uniform(4, 11)), float(rng.uniform(0.7, 1.7))
            nearest = _nearest(area, p)
            if nearest is None or rng.uniform() > 0.45:
                continue
            q, away, distance = nearest
            if not 2.0 < distance < 12.0:
                continue
            p = q + away * (KERB_WIDTH_M + sidewalk_width((0, 0), seed) + 0.7)
            yaw = float(np.arctan2(away[1], away[0]) - np.pi / 2)
            footprint = _rectangle(p, yaw, length, 1.0)
            if area.drivable.distance(footprint) < 1.2 or any(
                lot.distance(footprint) < 0.2 for lot in lots
            ):
                continue
            meshes.append(self._stand(furniture.hedge(length, height, rng), p, yaw, corner, 0.1))
        return meshes

    # Poles

    def _lamps_and_signs(self, tile: tuple[int, int], corner: NDArrayFloat) -> list[Mesh]:
        area, seed = self._area(tile), self.settings.place_seed
        meshes = []
        for k, purpose in enumerate((Purpose.LAMP, Purpose.SIGN, Purpose.SIGN)):
            rng = rng_at(seed, purpose, *tile, k)
            p = (np.array(tile) + rng.uniform(0.1, 0.9, 2)) * TILE_M
            nearest = _nearest(area, p)
            if nearest is None:
                continue
            q, away, distance = nearest
            if not 0.0 < distance < 14.0:
                continue
            xy = q + away * 0.65
            if area.drivable.distance(shapely.Point(xy)) < 0.5:
                continue
            outward = float(np.arctan2(away[1], away[0]))
            if purpose == Purpose.LAMP:
                shape, yaw = furniture.lamp(float(rng.uniform(6, 9))), outward - np.pi / 2
            elif rng.uniform() < 0.5:
                # Its face looks against the traffic on its side: the road is on its left.
                shape, yaw = furniture.sign(int(rng.integers(3))), outward + np.pi / 2
            else:
                continue
            meshes.append(self._stand(shape, xy, yaw, corner, 0.1))
        return meshes

    def _traffic_lights(self, tile: tuple[int, int], corner: NDArrayFloat) -> list[Mesh]:
        meshes = []
        box = shapely.box(*corner, *(corner + TILE_M)).buffer(15.0)
        area = self._area(tile)
        for k in np.sort(self.index.stop_line_tree.query(box, predicate="intersects")):
            line = shapely.get_coordinates(self.index.world.stop_lines[k])
            rng = rng_at(self.settings.place_seed, Purpose.SIGN, *np.round(line[0]).astype(int))
            if rng.uniform() > 0.7:
                continue
            ahead = self._ahead_at(self.index.world.stop_lines[k])
            if ahead is None:
                continue
            right = np.array([ahead[1], -ahead[0]])
            end = max(line[[0, -1]], key=lambda p: float(p @ right))
            for out in np.arange(0.4, 8.0, 0.4):
                xy = end + right * out
                if area.drivable.distance(shapely.Point(xy)) >= 0.5:
                    break
            else:
                continue
            if tuple(np.floor(xy / TILE_M).astype(int)) == tile:
                yaw = float(np.arctan2(ahead[1], ahead[0]))
                meshes.append(self._stand(furniture.traffic_light(), xy, yaw, corner, 0.1))
        return meshes

    def _ahead_at(self, line: BaseGeometry) -> NDArrayFloat | None:
        from hdmap_tools.simulate.surface import lane_centre

        middle = shapely.line_interpolate_point(line, 0.5, normalized=True)
        for lane in self.index.lanes_near(middle.buffer(1.0)):
            centre = lane_centre(lane, 0.5)
            k = int(np.argmin(np.hypot(*(centre - (middle.x, middle.y)).T)))
            k = min(max(k, 1), len(centre) - 1)
            step = centre[k] - centre[k - 1]
            norm = float(np.linalg.norm(step))
            if lane.kind == "road" and norm > 1e-6:
                return np.asarray(step / norm)
        return None

    # Lines of the map

    def _barriers(self, tile: tuple[int, int], corner: NDArrayFloat) -> list[Mesh]:
        """Fences, walls and guard rails, panel by panel; a panel is the tile's its middle lies in."""
        meshes = []
        box = shapely.box(*corner, *(corner + TILE_M)).buffer(3.0)
        area = self._area(tile)
        for k in self.index.lines_near(box):
            line = self.index.lines[k]
            if line.kind not in _BARRIERS:
                continue
            height, thick, foot, mat = _BARRIERS[line.kind]
            xy = resample(line.xy, 2.0)
            middle = (xy[:-1] + xy[1:]) / 2
            mine = (np.floor(middle / TILE_M).astype(int) == tile).all(axis=1)
            z = self.terrain.height_at(xy)
            for j in np.nonzero(mine)[0]:
                panel = shapely.LineString(xy[j : j + 2])
                if area.prepared.intersects(panel.buffer(0.1)):
                    continue
                xyz = np.column_stack([xy[j : j + 2] - corner, z[j : j + 2]])
                meshes.append(furniture.barrier(xyz, height, thick, foot, mat))
        return meshes


def _nearest(area: RoadArea, p: NDArrayFloat) -> tuple[NDArrayFloat, NDArrayFloat, float] | None:
    """Nearest point of the road's boundary, unit vector from there to p, and distance.

    None on the road, and where no road is near.
    """
    point = shapely.Point(p)
    if area.boundary.is_empty or area.prepared.intersects(point):
        return None
    line = shapely.shortest_line(area.boundary, point)
    q = shapely.get_coordinates(line)[0]
    distance = float(np.linalg.norm(p - q))
    if distance < 1e-3 or distance > 38.0:
        return None
    return q, (p - q) / distance, distance


def _pruned(tree: Mesh, xy: NDArrayFloat, area: RoadArea) -> Mesh:
    """A tree at a place without the twigs that hang into the way of vehicles."""
    low = tree.vertices[:, 2] < _HEADROOM_M
    trunk = tree.triangles[tree.materials != Mat.FOLIAGE]
    low[trunk.ravel()] = False
    if low.any():
        twigs = shapely.points(tree.vertices[low, :2].astype(np.float64) + xy)
        # Triangles reach between their corners.
        low[low] = shapely.dwithin(area.drivable, twigs, 1.0)
    if not low.any():
        return tree
    vertices = tree.vertices.copy()
    vertices[low, 2] = _HEADROOM_M
    return Mesh(vertices, tree.triangles, tree.materials)


def _rectangle(xy: NDArrayFloat, yaw: float, width: float, depth: float) -> BaseGeometry:
    u = np.array([np.cos(yaw), np.sin(yaw)]) * width / 2
    v = np.array([-np.sin(yaw), np.cos(yaw)]) * depth / 2
    return shapely.Polygon([xy - u - v, xy + u - v, xy + u + v, xy - u + v])


def _around(tile: tuple[int, int], reach: int) -> list[tuple[int, int]]:
    return [
        (tile[0] + dx, tile[1] + dy)
        for dx in range(-reach, reach + 1)
        for dy in range(-reach, reach + 1)
    ]


def _kept(make: Callable[[tuple[int, int]], T]) -> Callable[[tuple[int, int]], T]:
    """The function with its last few hundred results kept."""
    kept: Callable[[tuple[int, int]], T] = lru_cache(maxsize=400)(make)
    return kept
