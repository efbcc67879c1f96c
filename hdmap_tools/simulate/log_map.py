"""The `map/` folder of a simulated log: the world around the route, in Argoverse 2's form.

Source:
    Argoverse 2 user guide, HD maps; what `av2.map.map_api` reads.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely

from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.simulate.vehicle_motion import HeightAt
from hdmap_tools.simulate.world_map import LineKind, WorldLane, WorldLine, WorldMap
from hdmap_tools.simulate.write_log import write_json
from hdmap_tools.types import NDArrayFloat

CITY: Final = "SIM"
"""Stands for the city in file names; the place on earth is in ``map_frame.json``."""

_SURROUNDINGS_M: Final = 100.0
_VERTEX_SPACING_M: Final = 5.0
"""Between vertices of lines, so that they follow the ground."""
_GROUND_CELL_M: Final = 0.3
_GROUND_REACH_M: Final = 60.0
_MAX_GROUND_CELLS: Final = 16_000_000
_SMALLEST_AREA_M2: Final = 1.0

_MARK_STYLE: Final = {
    MarkStyle.SOLID: "SOLID",
    MarkStyle.DASHED: "DASHED",
    MarkStyle.SOLID_SOLID: "DOUBLE_SOLID",
    MarkStyle.DASHED_SOLID: "DASH_SOLID",
    MarkStyle.SOLID_DASHED: "SOLID_DASH",
}
_OTHER_WAY: Final = {"DASH_SOLID": "SOLID_DASH", "SOLID_DASH": "DASH_SOLID"}
_MARK_COLOR: Final = {MarkColor.WHITE: "WHITE", MarkColor.YELLOW: "YELLOW"}


def write_log_map(
    log: Path, log_id: str, world: WorldMap, route_xy: NDArrayFloat, height_at: HeightAt
) -> None:
    """Write vector map and ground heights.

    Args:
        log: Folder of the log.
        log_id: Names the files.
        world: The map; what lies further than 100 m from the route is left out.
        route_xy: (N, 2) of the route, city frame, metres.
        height_at: The ground.
    """
    near = shapely.simplify(shapely.LineString(route_xy), 1.0).buffer(_SURROUNDINGS_M)
    lanes = {
        id_: lane
        for id_, lane in world.lanes.items()
        if lane.kind != "walkway" and near.intersects(shapely.LineString(lane.left))
    }
    document = {
        "lane_segments": _lane_segments(lanes, world.lines, height_at),
        "pedestrian_crossings": _crossings(
            [area for area in world.crosswalks if near.intersects(area)], height_at
        ),
        "drivable_areas": _drivable_areas(
            [_lane_polygon(lane) for lane in lanes.values()]
            + [area for area in world.areas.get("drivable", ()) if near.intersects(area)],
            height_at,
        ),
    }
    write_json(log / "map" / f"log_map_archive_{log_id}____{CITY}_city_1.json", document)
    _write_ground(log / "map", log_id, route_xy, height_at)


def _lane_segments(
    lanes: Mapping[str, WorldLane], lines: Iterable[WorldLine], height_at: HeightAt
) -> dict[str, Any]:
    number = _numbers(lanes)
    line_of = {line.id: line for line in lines}
    predecessors: dict[str, list[int]] = defaultdict(list)
    lane_right_of: dict[str, str] = {}
    lane_left_of: dict[str, str] = {}
    for id_, lane in lanes.items():
        for successor in lane.successors:
            predecessors[successor].append(number[id_])
        if lane.left_line is not None:
            lane_right_of.setdefault(lane.left_line, id_)
        if lane.right_line is not None:
            lane_left_of.setdefault(lane.right_line, id_)
    crossed = _crossed_lanes(lanes)
    document = {}
    for id_, lane in lanes.items():
        right_neighbor = lane_right_of.get(lane.right_line or "")
        left_neighbor = lane_left_of.get(lane.left_line or "")
        document[str(number[id_])] = {
            "id": number[id_],
            "is_intersection": id_ in crossed,
            "lane_type": "BIKE" if lane.kind == "bicycle" else "VEHICLE",
            "left_lane_boundary": _points(lane.left, height_at),
            "left_lane_mark_type": _mark_type(line_of.get(lane.left_line or ""), lane.left),
            "left_neighbor_id": number[left_neighbor] if left_neighbor else None,
            "right_lane_boundary": _points(lane.right, height_at),
            "right_lane_mark_type": _mark_type(line_of.get(lane.right_line or ""), lane.right),
            "right_neighbor_id": number[right_neighbor] if right_neighbor else None,
            "predecessors": sorted(predecessors[id_]),
            "successors": sorted(number[s] for s in lane.successors if s in number),
        }
    return document


def _numbers(lanes: Mapping[str, WorldLane]) -> dict[str, int]:
    """A positive whole number for each lane: its own id where all have such ids."""
    if all(id_.isascii() and id_.isdecimal() and len(id_) < 19 for id_ in lanes):
        numbers = {id_: int(id_) for id_ in lanes}
        if len(set(numbers.values())) == len(numbers):
            return numbers
    return {id_: k for k, id_ in enumerate(sorted(lanes), start=1)}


def _crossed_lanes(lanes: Mapping[str, WorldLane]) -> set[str]:
    """Lanes that others cut, as they do only on intersections."""
    ids = list(lanes)
    polygons = [_lane_polygon(lanes[id_]).buffer(-0.3) for id_ in ids]
    tree = shapely.STRtree(polygons)
    first, second = tree.query(polygons, predicate="intersects")
    crossed = set()
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        if a < b and polygons[a].intersection(polygons[b]).area > _SMALLEST_AREA_M2:
            crossed |= {ids[a], ids[b]}
    return crossed


def _lane_polygon(lane: WorldLane) -> shapely.Geometry:
    return shapely.make_valid(shapely.Polygon(np.vstack([lane.left, lane.right[::-1]])))


def _mark_type(line: WorldLine | None, boundary: NDArrayFloat) -> str:
    if line is None or line.kind is not LineKind.PAINT or line.paint is None:
        return "NONE"
    style = _MARK_STYLE.get(line.paint.style)
    if style is not None and line.paint.color is MarkColor.BLUE:
        return "SOLID_BLUE"
    color = _MARK_COLOR.get(line.paint.color)
    if style is None or color is None:
        return "UNKNOWN"
    runs_back = float((line.xy[-1] - line.xy[0]) @ (boundary[-1] - boundary[0])) < 0
    return f"{_OTHER_WAY.get(style, style) if runs_back else style}_{color}"


def _crossings(areas: Iterable[shapely.Polygon], height_at: HeightAt) -> dict[str, Any]:
    """Each as the two long edges of the smallest rectangle around it: the form knows no other."""
    document = {}
    for number, area in enumerate(areas, start=1):
        box = shapely.minimum_rotated_rectangle(area)
        if not isinstance(box, shapely.Polygon):
            continue  # without an area
        a, b, c, d = shapely.get_coordinates(box)[:4]
        if np.linalg.norm(b - a) < np.linalg.norm(c - b):
            a, b, c, d = b, c, d, a
        document[str(number)] = {
            "id": number,
            "edge1": _vertices(np.array([a, b]), height_at),
            "edge2": _vertices(np.array([d, c]), height_at),
        }
    return document


def _drivable_areas(areas: Iterable[shapely.Geometry], height_at: HeightAt) -> dict[str, Any]:
    """Their union, cut into pieces without holes: the form knows none."""
    # Lanes that share a bound may leave slivers of nothing between them.
    union = shapely.union_all(list(areas)).buffer(0.05).buffer(-0.05)
    polygons = [part for part in shapely.get_parts(union) if isinstance(part, shapely.Polygon)]
    pieces = [piece for polygon in polygons for piece in _without_holes(polygon)]
    kept = [piece for piece in pieces if piece.area > _SMALLEST_AREA_M2]
    return {
        str(number): {
            "id": number,
            "area_boundary": _points(shapely.get_coordinates(piece.exterior), height_at)[:-1],
        }
        for number, piece in enumerate(kept, start=1)
    }


def _without_holes(polygon: shapely.Polygon) -> list[shapely.Polygon]:
    """Cut through a hole from south to north, and go on with what that gives."""
    if not polygon.interiors:
        return [polygon]
    hole_x0, _, hole_x1, _ = polygon.interiors[0].bounds
    x0, y0, x1, y1 = polygon.bounds
    cut = (hole_x0 + hole_x1) / 2
    halves = [shapely.box(x0 - 1, y0 - 1, cut, y1 + 1), shapely.box(cut, y0 - 1, x1 + 1, y1 + 1)]
    parts = [part for half in halves for part in shapely.get_parts(polygon.intersection(half))]
    return [
        piece
        for part in parts
        if isinstance(part, shapely.Polygon)
        for piece in _without_holes(part)
    ]


def _points(xy: NDArrayFloat, height_at: HeightAt) -> list[dict[str, float]]:
    return _vertices(
        shapely.get_coordinates(shapely.segmentize(shapely.LineString(xy), _VERTEX_SPACING_M)),
        height_at,
    )


def _vertices(xy: NDArrayFloat, height_at: HeightAt) -> list[dict[str, float]]:
    xyz = np.round(np.column_stack([xy, height_at(xy)]), 3)
    return [{"x": x, "y": y, "z": z} for x, y, z in xyz.tolist()]


def _write_ground(folder: Path, log_id: str, route_xy: NDArrayFloat, height_at: HeightAt) -> None:
    """Heights at the centres of cells, NaN far from the route; float32, for float16 is 3 cm at 40 m.

    Cells are those of recorded logs, 0.3 m, as long as these fit into memory.
    """
    low = np.floor(route_xy.min(axis=0) - _GROUND_REACH_M)
    extent = np.ceil(route_xy.max(axis=0) + _GROUND_REACH_M) - low
    cell = max(_GROUND_CELL_M, float(np.sqrt(extent.prod() / _MAX_GROUND_CELLS)))
    columns, rows = np.ceil(extent / cell).astype(int)
    near = shapely.simplify(shapely.LineString(route_xy), 1.0).buffer(_GROUND_REACH_M)
    shapely.prepare(near)
    heights = np.full((rows, columns), np.nan, dtype=np.float32)
    x = low[0] + (np.arange(columns) + 0.5) * cell
    for first in range(0, rows, 256):
        y = low[1] + (np.arange(first, min(first + 256, rows)) + 0.5) * cell
        xx, yy = np.meshgrid(x, y)
        inside = shapely.contains_xy(near, xx, yy)
        heights[first : first + 256][inside] = height_at(np.column_stack([xx[inside], yy[inside]]))
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"{log_id}_ground_height_surface____{CITY}.npy", heights)
    # av2 maps a city point p to s * (R p + t), and takes the whole part for the cell.
    write_json(
        folder / f"{log_id}___img_Sim2_city.json",
        {"R": [1.0, 0.0, 0.0, 1.0], "t": (-low).tolist(), "s": 1 / cell},
    )
