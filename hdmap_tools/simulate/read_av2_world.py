"""An Argoverse 2 vector map as a world.

Neighbouring segments each carry a copy of the boundary between them, so what lies on a line
that is there already is that line. The drivable areas are one surface whose outline is taken
for a kerb, but where lanes of the map's edge lead out of it.

Source:
    Mark types: `av2.map.lane_segment.LaneMarkType`. Sizes of paint: MUTCD, section 3A.06 (a
    normal line is 4 to 6 inches wide; broken lines have 10-foot segments and 30-foot gaps).
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely

from hdmap_tools.errors import FormatError, WorldError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.polyline import drop_repeats
from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.readers.av2 import CITY_UTM_ZONE_LAT_LON
from hdmap_tools.simulate.world_map import LaneKind, LineKind, Paint, WorldLane, WorldLine, WorldMap
from hdmap_tools.types import NDArrayFloat

_log = logging.getLogger(__name__)

LANE_KINDS: Final[dict[str, LaneKind]] = {"VEHICLE": "road", "BUS": "road", "BIKE": "bicycle"}
_STYLES: Final = {
    "SOLID": MarkStyle.SOLID,
    "DASHED": MarkStyle.DASHED,
    "DOUBLE_SOLID": MarkStyle.SOLID_SOLID,
    "DOUBLE_DASH": MarkStyle.DASHED,  # no style of two dashed lines
    "DASH_SOLID": MarkStyle.DASHED_SOLID,
    "SOLID_DASH": MarkStyle.SOLID_DASHED,
}
_CITY: Final = re.compile(r"____([A-Z]+)_city_")
_SAME_LINE_M: Final = 0.3
_MIN_KERB_M: Final = 1.5
_MAX_COORDINATE_M: Final = 1e7


def find_av2_map(path: Path) -> Path:
    """The map file of a log folder, a map folder, or the file itself.

    Raises:
        WorldError: If there is none, or more than one.
    """
    if path.is_file():
        return path
    found = sorted(path.glob("log_map_archive_*.json")) + sorted(
        path.glob("map/log_map_archive_*.json")
    )
    if len(found) != 1:
        raise WorldError(
            f"{path} holds {len(found)} files log_map_archive_*.json; expected one, in the folder "
            "or in its folder 'map'."
        )
    return found[0]


def read_av2_world(path: Path, origin: tuple[float, float, float] | None = None) -> WorldMap:
    """Read the vector map of an Argoverse 2 log.

    Args:
        path: ``log_map_archive_<log>____<city>_city_<number>.json``.
        origin: Latitude, longitude (degrees) and height (metres) of its city frame; by
            default that of the city in the file's name.

    Raises:
        FormatError: If the file is damaged.
        WorldError: If its name says no known city and no origin is given.
    """
    frame = _frame(path, origin)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        lanes, marks = _lanes(document["lane_segments"])
        crossings = [
            _crossing(_points(c["edge1"]), _points(c["edge2"]))
            for c in document["pedestrian_crossings"].values()
        ]
        drivable = [
            shapely.make_valid(shapely.Polygon(_points(a["area_boundary"])))
            for a in document["drivable_areas"].values()
        ]
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror or error}.") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error).split("\n")[0][:160]
        raise FormatError(
            f"{path} is no usable Argoverse 2 map: {what}; expected lane_segments, "
            "pedestrian_crossings and drivable_areas as the data set has them."
        ) from error
    surface = _polygons(shapely.union_all(drivable)) if drivable else []
    lanes, lines = _shared_lines(lanes, marks)
    return WorldMap(
        name=path.stem,
        frame=frame,
        lanes=lanes,
        lines=(*lines, *_kerbs(surface, lanes)),
        crosswalks=tuple(crossing for crossing in crossings if crossing is not None),
        areas={"drivable": tuple(surface)} if surface else {},
    )


def _frame(path: Path, origin: tuple[float, float, float] | None) -> MapFrame:
    if origin is not None:
        return MapFrame.from_origin(*origin)
    match = _CITY.search(path.name)
    if match is None or match[1] not in CITY_UTM_ZONE_LAT_LON:
        raise WorldError(
            f"{path.name} names no city of Argoverse 2 ({', '.join(CITY_UTM_ZONE_LAT_LON)}), so its "
            "place on earth is unknown; keep the name log_map_archive_<log>____<city>_city_<n>.json "
            "or give --origin LAT,LON[,ALT]."
        )
    zone, lat, lon = CITY_UTM_ZONE_LAT_LON[match[1]]
    return MapFrame.from_crs(f"EPSG:326{zone}", (lat, lon))


def _lanes(
    segments: Mapping[str, Mapping[str, Any]],
) -> tuple[dict[str, WorldLane], dict[str, tuple[str, str]]]:
    """Lanes by id, and the marks on their left and right."""
    lanes, marks, num_other = {}, {}, 0
    for segment in segments.values():
        identifier = str(int(segment["id"]))
        kind = LANE_KINDS.get(segment["lane_type"])
        if kind is None:
            num_other += 1
            continue
        lanes[identifier] = WorldLane(
            id=identifier,
            left=_points(segment["left_lane_boundary"]),
            right=_points(segment["right_lane_boundary"]),
            kind=kind,
            successors=tuple(sorted(str(int(k)) for k in segment["successors"])),
        )
        marks[identifier] = (
            str(segment["left_lane_mark_type"]),
            str(segment["right_lane_mark_type"]),
        )
    if num_other:
        _log.warning("left out %d lane segments of unknown type", num_other)
    return {
        k: replace(lane, successors=tuple(s for s in lane.successors if s in lanes))
        for k, lane in lanes.items()
    }, marks


def _points(vertices: Iterable[Mapping[str, Any]]) -> NDArrayFloat:
    """(N, 2) without repeats; raises ValueError where there is no line."""
    points = np.array([(v["x"], v["y"]) for v in vertices], dtype=np.float64).reshape(-1, 2)
    if not (np.isfinite(points).all() and (np.abs(points) < _MAX_COORDINATE_M).all()):
        raise ValueError("a coordinate is NaN, infinite or beyond 10,000 km")
    points = drop_repeats(points) if len(points) else points
    if len(points) < 2:
        raise ValueError("a line has less than two different points")
    return points


def _crossing(edge1: NDArrayFloat, edge2: NDArrayFloat) -> shapely.Polygon | None:
    """Between two edges, whichever way each runs."""
    same_way = (edge1[-1] - edge1[0]) @ (edge2[-1] - edge2[0]) >= 0
    area = shapely.Polygon(np.concatenate([edge1, edge2[::-1] if same_way else edge2]))
    area = area if area.is_valid else area.convex_hull
    return area if area.geom_type == "Polygon" and area.area > 0.01 else None


def _paint(mark: str) -> Paint | None:
    style, _, color = mark.rpartition("_")
    if style not in _STYLES or color not in ("WHITE", "YELLOW", "BLUE"):
        return None
    return Paint(_STYLES[style], MarkColor(color.lower()), 0.12, dash_m=3.0, gap_m=9.0)


def _shared_lines(
    lanes: Mapping[str, WorldLane], marks: Mapping[str, tuple[str, str]]
) -> tuple[dict[str, WorldLane], list[WorldLine]]:
    """Lines, each once, and the lanes with the ids of theirs; paint before what is unpainted."""
    sides = [
        (identifier, side, xy, _paint(marks[identifier][k]))
        for identifier, lane in lanes.items()
        for k, (side, xy) in enumerate((("left", lane.left), ("right", lane.right)))
    ]
    sides.sort(key=lambda s: (s[3] is None, -shapely.LineString(s[2]).length, s[0], s[1]))
    near = [shapely.LineString(xy).buffer(_SAME_LINE_M) for _, _, xy, _ in sides]
    tree = shapely.STRtree([shapely.LineString(xy) for _, _, xy, _ in sides])
    line_of: dict[int, str] = {}
    lines: list[WorldLine] = []
    kept: dict[int, str] = {}
    for k, (identifier, side, xy, paint) in enumerate(sides):
        here = shapely.LineString(xy)
        same = [int(j) for j in sorted(tree.query(here)) if j in kept and near[j].covers(here)]
        if same:
            line_of[k] = kept[same[0]]
            continue
        line_of[k] = kept[k] = f"{identifier}:{side}"
        kind = LineKind.VIRTUAL if paint is None else LineKind.PAINT
        lines.append(WorldLine(kept[k], xy, kind, paint))
    found: dict[str, dict[str, str]] = {}
    for k, (identifier, side, _, _) in enumerate(sides):
        found.setdefault(identifier, {})[f"{side}_line"] = line_of[k]
    return {
        k: replace(lane, left_line=found[k]["left_line"], right_line=found[k]["right_line"])
        for k, lane in lanes.items()
    }, lines


def _kerbs(surface: Iterable[shapely.Polygon], lanes: Mapping[str, WorldLane]) -> list[WorldLine]:
    """Outlines of the drivable surface, open where lanes lead out of the map."""
    entered = {s for lane in lanes.values() for s in lane.successors}
    gates = []
    for lane in lanes.values():
        ends = [] if lane.successors else [-1]
        ends += [] if lane.id in entered else [0]
        for end in ends:
            # Not to its ends: a kerb beside a lane that ends within the map stays whole.
            a, b = lane.left[end], lane.right[end]
            gate = shapely.LineString([0.9 * a + 0.1 * b, 0.1 * a + 0.9 * b])
            gates.append(gate.buffer(1.5, cap_style="flat"))
    opening = shapely.union_all(gates).buffer(0.6).buffer(-0.6)
    kerbs = []
    for number, polygon in enumerate(surface):
        for ring, outline in enumerate((polygon.exterior, *polygon.interiors)):
            parts = shapely.get_parts(shapely.line_merge(outline.difference(opening)))
            for part, line in enumerate(parts):
                xy = drop_repeats(shapely.get_coordinates(line))
                if line.length > _MIN_KERB_M and len(xy) > 1:
                    identifier = f"drivable:{number}:{ring}:{part}"
                    kerbs.append(WorldLine(identifier, xy, LineKind.KERB_HIGH))
    return kerbs


def _polygons(geometry: Any) -> list[shapely.Polygon]:
    parts = shapely.get_parts(geometry)
    kept = [p for p in parts if p.geom_type == "Polygon" and p.area > 0.01]
    return sorted(kept, key=lambda p: p.bounds)
