"""Where the road is: the drivable area of a world, piece by piece, and how high its kerbs are.

The world is cut into fixed blocks, and what is said of a block never depends on where a
vehicle drives, so scenes that overlap agree.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from hdmap_tools.geometry.polyline import drop_repeats, resample
from hdmap_tools.simulate.world_map import LineKind, WorldLane, WorldLine, WorldMap
from hdmap_tools.types import NDArrayFloat

BLOCK_M: Final = 102.4
"""Side of a block: four tiles of the surface raster."""

MARGIN_M: Final = 40.0
"""What a block knows of its surroundings; set-backs of buildings look that far."""

KERB_HIGH_M: Final = 0.12
KERB_LOW_M: Final = 0.03

_CLOSING_M: Final = 0.8
"""Gaps up to twice this between lanes, or between a lane and a kerb, are road."""

_OPENING_M: Final = 0.3
"""Slivers narrower than twice this are no road: kerb lines that bound nothing."""

_EXTENSION_M: Final = 60.0
"""Lanes at the map's edge go on straight, so that no street ends at a lawn in view."""

_RAISE: Final = {LineKind.KERB_HIGH: KERB_HIGH_M, LineKind.KERB_LOW: KERB_LOW_M, LineKind.EDGE: 0.0}


class WorldIndex:
    """A world with what is needed to ask it about a place.

    Attributes:
        world: The map.
        road_lanes: Lanes that belong to the drivable area.
    """

    def __init__(self, world: WorldMap) -> None:
        self.world = world
        self.road_lanes = _lanes_on_road(world)
        self._lane_areas = np.array([_lane_area(lane) for lane in self.road_lanes], dtype=object)
        ends = [piece for lane in self.road_lanes for piece in self._extensions(lane)]
        self._road_areas = np.concatenate(
            [self._lane_areas, np.array([*ends, *world.areas.get("drivable", ())], dtype=object)]
        )
        self._road_tree = shapely.STRtree(self._road_areas)
        self.lane_tree = shapely.STRtree(self._lane_areas)
        self.lines = world.lines
        self._line_geometries = np.array(
            [shapely.LineString(line.xy) for line in world.lines], dtype=object
        )
        self.line_tree = shapely.STRtree(self._line_geometries)
        self.crosswalk_tree = shapely.STRtree(list(world.crosswalks))
        self.stop_line_tree = shapely.STRtree(list(world.stop_lines))
        self._areas: OrderedDict[tuple[int, int], RoadArea] = OrderedDict()

    def road_area(self, block: tuple[int, int]) -> RoadArea:
        """The drivable area of a block; the last few dozen are kept."""
        if block not in self._areas:
            self._areas[block] = self._road_area(block)
            if len(self._areas) > 48:
                self._areas.popitem(last=False)
        self._areas.move_to_end(block)
        return self._areas[block]

    def rough_road(self, box: BaseGeometry) -> BaseGeometry:
        """Roads in a box without closing what lies between lanes; for what is seen from afar."""
        found = np.sort(self._road_tree.query(box, predicate="intersects"))
        area = shapely.union_all(self._road_areas[found])
        shapely.prepare(area)
        return area

    def lines_near(self, box: BaseGeometry) -> list[int]:
        """Indices of the lines that meet a box, in the order of the map."""
        return sorted(self.line_tree.query(box, predicate="intersects").tolist())

    def lanes_near(self, box: BaseGeometry) -> list[WorldLane]:
        """Lanes of the drivable area that meet a box, in the order of the map."""
        found = sorted(self.lane_tree.query(box, predicate="intersects").tolist())
        return [self.road_lanes[k] for k in found]

    def lane_area(self, lane: WorldLane) -> BaseGeometry:
        """The polygon of one lane."""
        return self._area_by_id[lane.id]

    @cached_property
    def _area_by_id(self) -> dict[str, BaseGeometry]:
        return {lane.id: a for lane, a in zip(self.road_lanes, self._lane_areas, strict=True)}

    @cached_property
    def _entered(self) -> set[str]:
        return {s for lane in self.world.lanes.values() for s in lane.successors}

    def _extensions(self, lane: WorldLane) -> list[BaseGeometry]:
        """What a lane that begins or ends at the map's edge goes on as, clear of other lanes."""
        pieces = []
        is_last = not any(s in self.world.lanes for s in lane.successors)
        for left, right, is_open in (
            (lane.left, lane.right, is_last),
            (lane.left[::-1], lane.right[::-1], lane.id not in self._entered),
        ):
            if not is_open or lane.kind != "road":
                continue
            ahead = _direction_at_end(left) + _direction_at_end(right)
            norm = float(np.linalg.norm(ahead))
            if norm < 1.0:
                continue
            ahead = ahead / norm
            across = right[-1] - left[-1]
            # A lane that another one goes on from without the map saying so ends nowhere.
            mouth = shapely.Point((left[-1] + right[-1]) / 2 + 2.0 * ahead)
            tree = self._bare_tree
            if len(tree.query(mouth, predicate="intersects")) or np.linalg.norm(across) > 8.0:
                continue
            corners = np.array(
                [
                    left[-1] - 0.2 * ahead,
                    right[-1] - 0.2 * ahead,
                    right[-1] + _EXTENSION_M * ahead,
                    left[-1] + _EXTENSION_M * ahead,
                ]
            )
            piece = shapely.Polygon(corners)
            hit = tree.query(
                shapely.LineString([mouth, shapely.Point((corners[2] + corners[3]) / 2)]).buffer(
                    float(np.linalg.norm(across))
                ),
                predicate="intersects",
            )
            others = [k for k in hit.tolist() if self.road_lanes[k].id != lane.id]
            if any(
                self._lane_areas[k].distance(mouth) > 6.0 for k in others
            ):  # it would run into another street
                continue
            if piece.is_valid:
                pieces.append(piece)
        return pieces

    @cached_property
    def _bare_tree(self) -> shapely.STRtree:
        return shapely.STRtree(self._lane_areas)

    def _road_area(self, block: tuple[int, int]) -> RoadArea:
        bx, by = block
        inner = shapely.box(bx * BLOCK_M, by * BLOCK_M, (bx + 1) * BLOCK_M, (by + 1) * BLOCK_M)
        outer = inner.buffer(MARGIN_M, join_style="mitre")
        wide = inner.buffer(MARGIN_M + 5.0, join_style="mitre")
        found = np.sort(self._road_tree.query(wide, predicate="intersects"))
        lines = [self.lines[k] for k in self.lines_near(wide)]
        kerbs = [shapely.LineString(line.xy) for line in lines if line.kind in _RAISE]
        crossings = self.crosswalk_tree.query(wide, predicate="intersects")
        zebras = shapely.union_all([self.world.crosswalks[k] for k in np.sort(crossings)])
        if len(found) == 0:
            return RoadArea(block, shapely.Polygon(), *_kerb_samples(lines, outer), zebras)
        lanes = shapely.union_all(self._road_areas[found])
        # Kerbs far from any lane bound pavements, not the road.
        near = [shapely.intersection(k, lanes.buffer(2.0)).buffer(0.01) for k in kerbs]
        road = shapely.union_all([lanes, *near])
        road = road.buffer(_CLOSING_M).buffer(-_CLOSING_M - _OPENING_M).buffer(_OPENING_M)
        road = shapely.make_valid(shapely.intersection(road, wide))
        return RoadArea(block, _polygons(road), *_kerb_samples(lines, outer), zebras)


@dataclass(frozen=True, eq=False)
class RoadArea:
    """The drivable area in and around one block.

    Attributes:
        block: Which.
        drivable: Polygons, city metres; right within `MARGIN_M` around the block.
        kerb_xy: (K, 2) points along the map's kerbs and edges.
        kerb_raise_m: (K,) how much what lies beyond is higher than the road.
        crosswalks: Union of the zebra crossings; kerbs are lowered where they end.
    """

    block: tuple[int, int]
    drivable: BaseGeometry
    kerb_xy: NDArrayFloat
    kerb_raise_m: NDArrayFloat
    crosswalks: BaseGeometry

    @cached_property
    def boundary(self) -> BaseGeometry:
        """Where the drivable area ends, without the cut at the margin."""
        bx, by = self.block
        inside = shapely.box(
            bx * BLOCK_M, by * BLOCK_M, (bx + 1) * BLOCK_M, (by + 1) * BLOCK_M
        ).buffer(MARGIN_M, join_style="mitre")
        edge = shapely.intersection(shapely.boundary(self.drivable), inside)
        shapely.prepare(edge)
        return edge

    @cached_property
    def prepared(self) -> BaseGeometry:
        """`drivable`, prepared for many questions."""
        shapely.prepare(self.drivable)
        return self.drivable

    def raise_at(self, xy: NDArrayFloat) -> NDArrayFloat:
        """(N,) metres that ground outside the road lies above the road's height there.

        Near a kerb of the map it is that kerb's height, far from all of them
        that of a high kerb, and between them it passes smoothly from one to the other.
        """
        # Weights fall with the fourth power of the distance; a high kerb at 4 m stands for "none".
        weight = np.full(len(xy), 4.0**-4)
        total = weight * KERB_HIGH_M
        for height, tree in self._kerb_trees:
            distance, _ = tree.query(xy, distance_upper_bound=20.0)
            own = 1.0 / (distance**4 + 1e-6)
            weight += own
            total += own * height
        raise_m = total / weight
        if not self.crosswalks.is_empty:
            beside = shapely.distance(self.crosswalks, shapely.points(xy))
            t = np.clip((beside - 0.3) / 1.5, 0.0, 1.0)
            lowered = np.minimum(raise_m, KERB_LOW_M)
            raise_m = lowered + (raise_m - lowered) * t * t * (3.0 - 2.0 * t)
        # What is nearly level is level: a step of a millimetre is no kerb.
        return np.where(raise_m < 0.004, 0.0, raise_m)

    @cached_property
    def _kerb_trees(self) -> list[tuple[float, Any]]:
        from scipy.spatial import cKDTree

        return [
            (float(height), cKDTree(self.kerb_xy[self.kerb_raise_m == height]))
            for height in np.unique(self.kerb_raise_m)
        ]


def block_of(xy: NDArrayFloat) -> tuple[int, int]:
    """The block that a city point lies in."""
    return math.floor(float(xy[0]) / BLOCK_M), math.floor(float(xy[1]) / BLOCK_M)


def _lanes_on_road(world: WorldMap) -> list[WorldLane]:
    """Road lanes, and bicycle lanes that only paint parts from the road."""
    kinds = {line.id: line.kind for line in world.lines}
    bounds = {
        bound
        for lane in world.lanes.values()
        if lane.kind == "road"
        for bound in (lane.left_line, lane.right_line)
        if bound is not None and kinds.get(bound) in (LineKind.PAINT, LineKind.VIRTUAL)
    }
    return [
        lane
        for lane in world.lanes.values()
        if lane.kind == "road"
        or (lane.kind == "bicycle" and bounds & {lane.left_line, lane.right_line})
    ]


def _lane_area(lane: WorldLane) -> BaseGeometry:
    ring = np.concatenate([lane.left, lane.right[::-1]])
    return _polygons(shapely.make_valid(shapely.Polygon(ring)))


def _polygons(geometry: BaseGeometry) -> BaseGeometry:
    """The areas of a geometry, without the points and lines that repair leaves."""
    parts = shapely.get_parts(geometry)
    parts = shapely.get_parts(parts)  # a collection may hold collections
    return shapely.union_all([p for p in parts if p.geom_type in ("Polygon", "MultiPolygon")])


def _direction_at_end(xy: NDArrayFloat) -> NDArrayFloat:
    xy = drop_repeats(xy)
    if len(xy) < 2:
        return np.zeros(2)
    ahead = xy[-1] - xy[max(len(xy) - 3, 0)]
    return np.asarray(ahead / max(float(np.linalg.norm(ahead)), 1e-9))


def _kerb_samples(
    lines: list[WorldLine], around: BaseGeometry
) -> tuple[NDArrayFloat, NDArrayFloat]:
    points, raises = [np.zeros((0, 2))], [np.zeros(0)]
    for line in lines:
        if line.kind in _RAISE:
            dense = resample(line.xy, 0.25)
            dense = dense[np.asarray(shapely.intersects_xy(around, dense))]
            points.append(dense)
            raises.append(np.full(len(dense), _RAISE[line.kind]))
    return np.concatenate(points), np.concatenate(raises)
