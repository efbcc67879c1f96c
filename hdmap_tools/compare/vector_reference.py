"""A vector map drawn onto a grid, so that a raster can be held against it."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from hdmap_tools.compare.rasterize import coverage_share
from hdmap_tools.compare.reference import (
    DRIVABLE_GROUP,
    Reference,
    ReferenceGroup,
    describe_rule,
    frame_relation,
    is_truth,
    no_overlap,
)
from hdmap_tools.errors import FormatError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MapClass
from hdmap_tools.map_model.elements import (
    Crosswalk,
    Lanelet,
    LaneMark,
    MarkStyle,
    RoadBoundary,
    SidewalkArea,
    StopLine,
    VegetationArea,
)
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.types import NDArrayFloat

DEFAULT_MARK_WIDTH_M: Final = 0.12
"""Width of a lane mark that has none: the narrow line of German and British roads
(RMS-1; Traffic Signs Manual ch. 5: 0.10 to 0.15 m)."""

DEFAULT_STOP_LINE_WIDTH_M: Final = 0.3
"""Width of a stop line that has none (Manual on Uniform Traffic Control Devices, 3B.16: 12 to 24 in)."""

ROAD_LANELETS: Final = frozenset(
    {
        "road",
        "highway",
        "play_street",
        "emergency_lane",
        "bus_lane",
        "bus_bay",
        "exit",
        "bicycle_lane",
    }
)
"""Lanelet2 subtypes that are drivable ground."""


def reference_from_vector_map(
    vector_map: VectorMap,
    grid: BevGrid,
    *,
    source: str = "vector map",
    min_share: float = 0.5,
    mark_width_m: float = DEFAULT_MARK_WIDTH_M,
    assume_same_frame: bool = False,
) -> Reference:
    """Draw a vector map onto a grid.

    Groups, each only where the map has such elements: ``crosswalk``; ``lane_mark``
    (lines and stop lines widened to their paint; the gaps of dashed lines count as
    paint, because maps draw them through); ``drivable`` (lanelets for vehicles or, in a
    map without any, closed road boundaries minus islands); ``road`` (drivable ground without paint, when
    the map has paint); ``sidewalk``; ``vegetation``. The whole grid counts as covered:
    a vector map does not say where it ends.

    Args:
        vector_map: The map to draw.
        grid: Cells to draw on.
        source: Its name in reports.
        min_share: Share of a cell that must be covered for it to be truth; 0 means any.
            Of a line narrower than a cell, this share of what it covers at most (its
            width over the cell's): else half of all thin lines would vanish, those
            that run along a cell edge.
        mark_width_m: Width of lane marks that have none.
        assume_same_frame: See `load_reference`.

    Raises:
        CRSMismatchError: If only one of the two knows its place on earth.
        FormatError: If the map holds no areas or paint, or does not overlap the grid.
    """
    relation = frame_relation(vector_map.frame, grid.frame, source, assume_same_frame)
    notes = list(relation.notes)
    areas, paint = _areas(vector_map), _paint(vector_map, mark_width_m)
    if not areas and not paint:
        found = ", ".join(f"{n} {t}" for t, n in vector_map.counts().items()) or "no elements"
        raise FormatError(
            f"Reference {source} has nothing to draw as cells: found {found}; expected crosswalks, lane "
            "marks, areas, closed road boundaries or lanelets."
        )
    if relation.through_wgs84:
        areas = {
            name: [_taken_over(g, vector_map.frame, grid.frame) for g in geometries]
            for name, geometries in areas.items()
        }
        paint = {
            width: [_taken_over(g, vector_map.frame, grid.frame) for g in geometries]
            for width, geometries in paint.items()
        }
    drawn = [g for some in (*areas.values(), *paint.values()) for g in some]
    x0, y0, x1, y1 = (float(b) for b in shapely.total_bounds(drawn))
    gx0, gy0, gx1, gy1 = grid.bounds_m
    if not (x0 < gx1 and x1 > gx0 and y0 < gy1 and y1 > gy0):
        raise no_overlap(source, (x0, y0, x1, y1), grid)
    truth = {
        name: is_truth(coverage_share(geometries, grid), min_share)
        for name, geometries in areas.items()
    }
    for width_m, geometries in paint.items():
        needed = min_share * min(width_m / grid.resolution_m, 1.0)
        marked = is_truth(coverage_share(geometries, grid), needed)
        truth[MapClass.LANE_MARK] = truth.get(MapClass.LANE_MARK, False) | marked
    groups = []
    if DRIVABLE_GROUP in truth:
        groups.append(ReferenceGroup(DRIVABLE_GROUP, DRIVABLE_CLASSES, truth[DRIVABLE_GROUP]))
        painted = [truth[c] for c in (MapClass.CROSSWALK, MapClass.LANE_MARK) if c in truth]
        if painted:
            bare = truth[DRIVABLE_GROUP] & ~np.logical_or.reduce(painted)
            groups.append(ReferenceGroup(str(MapClass.ROAD), (MapClass.ROAD,), bare))
    else:
        notes.append(f"{source} has no closed road boundary and no lanelet, so no road area.")
    groups += [
        ReferenceGroup(str(c), (c,), truth[c])
        for c in (MapClass.CROSSWALK, MapClass.LANE_MARK, MapClass.SIDEWALK, MapClass.VEGETATION)
        if c in truth
    ]
    if any(m.style != MarkStyle.SOLID for m in vector_map.of_type(LaneMark)):
        notes.append("Gaps of dashed lane marks count as paint in the reference.")
    return Reference(
        grid,
        tuple(groups),
        np.ones(grid.shape, dtype=bool),
        source,
        describe_rule(min_share, has_lines=bool(paint)),
        tuple(notes),
    )


def _paint(vector_map: VectorMap, mark_width_m: float) -> dict[float, list[BaseGeometry]]:
    """2D strips of paint by their width in metres, in the map's own frame."""
    strips: dict[float, list[BaseGeometry]] = {}
    lines = [(m.geometry, m.width_m or mark_width_m) for m in vector_map.of_type(LaneMark)]
    lines += [
        (s.geometry, s.width_m or DEFAULT_STOP_LINE_WIDTH_M) for s in vector_map.of_type(StopLine)
    ]
    for line, width_m in lines:
        strips.setdefault(round(width_m, 3), []).append(_widened(line, width_m))
    return strips


def _areas(vector_map: VectorMap) -> dict[str, list[BaseGeometry]]:
    """2D areas by group, in the map's own frame; only groups that have some."""
    road = _road_areas(vector_map)
    found: dict[str, list[BaseGeometry]] = {
        DRIVABLE_GROUP: road,
        MapClass.CROSSWALK: [c.geometry for c in vector_map.of_type(Crosswalk)],
        MapClass.SIDEWALK: [a.geometry for a in vector_map.of_type(SidewalkArea)],
        MapClass.VEGETATION: [a.geometry for a in vector_map.of_type(VegetationArea)],
    }
    return {name: [shapely.force_2d(g) for g in areas] for name, areas in found.items() if areas}


def _widened(line: BaseGeometry, width_m: float) -> BaseGeometry:
    # Paint ends square where its line ends.
    return shapely.buffer(shapely.force_2d(line), width_m / 2, cap_style="flat", join_style="mitre")


def _road_areas(vector_map: VectorMap) -> list[BaseGeometry]:
    """Ground for vehicles: lanelets where the map has some, else closed boundaries.

    Not both: closed kerbs and edges of a map with lanelets are traffic islands and
    parking areas (2,400 m2 of them beside 19,100 m2 of lanelets in the Karlsruhe
    example map of Lanelet2).
    """
    lines = {element.id: element.geometry for element in vector_map}
    lanes = []
    for lanelet in vector_map.of_type(Lanelet):
        if lanelet.subtype not in ROAD_LANELETS:
            continue
        bounds = (lines.get(lanelet.left_id), lines.get(lanelet.right_id))
        if bounds[0] is not None and bounds[1] is not None:
            left, right = (shapely.get_coordinates(b) for b in bounds)
            left = left[::-1] if lanelet.is_left_reversed else left
            right = right[::-1] if lanelet.is_right_reversed else right
            lanes.append(shapely.make_valid(Polygon(np.concatenate([left, right[::-1]]))))
    if lanes:
        return lanes
    rings = [
        (shapely.make_valid(Polygon(shapely.get_coordinates(b.geometry))), b.is_island)
        for b in vector_map.of_type(RoadBoundary)
        if b.geometry.is_closed and len(b.geometry.coords) >= 4
    ]
    islands = shapely.union_all([ring for ring, is_island in rings if is_island])
    outer = shapely.union_all([ring for ring, is_island in rings if not is_island])
    area = shapely.difference(outer, islands)
    return [] if area.is_empty else [area]


def _taken_over(geometry: BaseGeometry, source: MapFrame, city: MapFrame) -> BaseGeometry:
    def move(xy: NDArrayFloat) -> NDArrayFloat:
        points = np.column_stack([xy, np.zeros(len(xy))])
        return city.from_wgs84(source.to_wgs84(points))[:, :2]

    return shapely.transform(geometry, move)
