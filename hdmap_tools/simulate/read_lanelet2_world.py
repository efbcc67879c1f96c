"""A Lanelet2 map as a world: lanes, painted lines, kerbs, crossings, areas."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import shapely

from hdmap_tools.errors import WorldError
from hdmap_tools.formats.lanelet2_geometry import are_reversed, assemble_rings, crosswalk_outline
from hdmap_tools.formats.osm_document import OsmDocument, OsmRelation, OsmWay
from hdmap_tools.formats.osm_xml import read_osm
from hdmap_tools.formats.records import frame_around, parse_metadata
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.simulate.lane_links import Gate, bridge_gaps, successors_by_gate
from hdmap_tools.simulate.lanelet2_lines import AREA_KINDS, line_of, speed_limit_mps
from hdmap_tools.simulate.marked_crossings import are_on_road, crossings_between
from hdmap_tools.simulate.world_map import LaneKind, LineKind, WorldLane, WorldLine, WorldMap
from hdmap_tools.types import NDArrayFloat

_log = logging.getLogger(__name__)

LANE_KINDS: Final[dict[str, LaneKind]] = {
    "road": "road",
    "highway": "road",
    "play_street": "road",
    "bus_lane": "road",
    "bicycle_lane": "bicycle",
    "walkway": "walkway",
    "shared_walkway": "walkway",
    "sidewalk": "walkway",
}
_BOTH_WAYS_BY_DEFAULT: Final = frozenset({"walkway", "shared_walkway", "sidewalk"})
_CROSSING_LINES: Final = ("zebra_marking", "pedestrian_marking")


def read_lanelet2_world(path: Path, origin: tuple[float, float, float] | None = None) -> WorldMap:
    """Read a Lanelet2 file as a world; what is broken in it is left out and counted in the log.

    A road lanelet with ``one_way=no`` becomes two lanes, the one against the direction of
    the lanelet with ``~`` after its id. Lanes succeed each other where both their end points
    are the same, as in the library, and else where they are within 0.5 m.

    Args:
        path: An ``.osm`` file.
        origin: Latitude, longitude (degrees) and height (metres) of the city frame; by
            default the frame in the file, or else the middle of its nodes.

    Raises:
        FormatError: If the file is damaged.
        WorldError: If its nodes have only the local coordinates of the Autoware tags and no
            origin is given.
    """
    document = read_osm(path)
    frame, points = _place(document, path, origin)
    reader = _Reader(document, points)
    world = reader.read(path.stem, frame)
    if reader.left_out:
        counts = ", ".join(f"{n} {what}" for what, n in sorted(reader.left_out.items()))
        _log.warning("%s: left out %s.", path, counts)
    return world


def _place(
    document: OsmDocument, path: Path, origin: tuple[float, float, float] | None
) -> tuple[MapFrame, dict[int, NDArrayFloat]]:
    """The city frame, and where each node lies in it."""
    nodes = list(document.nodes.values())
    geographic = np.array([(n.lon, n.lat, n.ele) for n in nodes]).reshape(-1, 3)
    given = MapFrame.from_origin(*origin) if origin is not None else None
    is_nowhere = len(nodes) > 1 and bool((np.ptp(geographic[:, :2], axis=0) == 0).all())
    if is_nowhere and all({"local_x", "local_y"} <= n.tags.keys() for n in nodes):
        if given is None:
            raise WorldError(
                f"{path} gives its nodes in local metres (tags local_x, local_y) and no latitude "
                "and longitude; say where local (0, 0) lies with --origin LAT,LON[,ALT]."
            )
        points = np.array([_local(n.tags, path, n.id) for n in nodes])
        return given, dict(zip(document.nodes, points, strict=True))
    stored = parse_metadata(document.metadata, str(path))[0] if document.metadata else None
    frame = given or stored or frame_around(geographic)
    points = frame.from_wgs84(geographic)[:, :2] if len(nodes) else geographic[:, :2]
    return frame, dict(zip(document.nodes, points, strict=True))


def _local(tags: dict[str, str], path: Path, node_id: int) -> tuple[float, float]:
    try:
        x, y = float(tags["local_x"]), float(tags["local_y"])
    except ValueError:
        x = y = float("nan")
    if not (np.isfinite([x, y]).all() and max(abs(x), abs(y)) < 1e7):
        raise WorldError(
            f"{path}: node {node_id} has local_x {tags['local_x'][:40]!r} and local_y "
            f"{tags['local_y'][:40]!r}; expected finite metres."
        )
    return x, y


class _Reader:
    def __init__(self, document: OsmDocument, points: dict[int, NDArrayFloat]) -> None:
        self.left_out: Counter[str] = Counter()
        self._document = document
        self._points = points
        self._entries: dict[str, Gate] = {}
        self._exits: dict[str, Gate] = {}
        self._bounds: set[int] = set()

    def read(self, name: str, frame: MapFrame) -> WorldMap:
        lanes: dict[str, WorldLane] = {}
        crosswalks: list[shapely.Polygon] = []
        areas: dict[str, list[shapely.Polygon]] = {}
        crossing_ways: set[int] = set()
        for relation in self._document.relations.values():
            kind, subtype = relation.tags.get("type", ""), relation.tags.get("subtype", "road")
            if kind == "lanelet" and subtype == "crosswalk":
                crosswalks += self._crossing(relation)
                crossing_ways |= {member.ref for member in relation.members}
            elif kind == "lanelet" and subtype in LANE_KINDS:
                for lane in self._lanes(relation, LANE_KINDS[subtype]):
                    lanes[lane.id] = lane
            elif kind == "multipolygon" and subtype in AREA_KINDS:
                areas.setdefault(AREA_KINDS[subtype], []).extend(self._area(relation))
            elif kind == "lanelet":
                self.left_out[f"lanelets for {subtype}"] += 1
        lines = self._lines()
        stop_lines, pairs = self._stop_lines_and_crossing_lines(crossing_ways)
        paved = [lane.polygon() for lane in lanes.values() if lane.kind != "walkway"]
        # Footpaths and refuges of islands stand in real maps as crossings too; no zebra is there.
        on_road = are_on_road(crosswalks, paved)
        for crossing, is_on_road in zip(crosswalks, on_road, strict=True):
            if not is_on_road:
                areas.setdefault("sidewalk", []).append(crossing)
        if num_beside := on_road.count(False):
            _log.info("%s: took %d crossings beside the road for pavement", name, num_beside)
        crosswalks = [c for c, is_on_road in zip(crosswalks, on_road, strict=True) if is_on_road]
        crosswalks += crossings_between(pairs, crosswalks, paved)
        known = {line.id for line in lines}
        links = bridge_gaps(lanes, successors_by_gate(lanes, self._entries, self._exits))
        lanes = {
            k: replace(
                lane,
                successors=links[k],
                left_line=lane.left_line if lane.left_line in known else None,
                right_line=lane.right_line if lane.right_line in known else None,
            )
            for k, lane in lanes.items()
        }
        return WorldMap(
            name=name,
            frame=frame,
            lanes=lanes,
            lines=tuple(lines),
            crosswalks=tuple(crosswalks),
            stop_lines=tuple(stop_lines),
            areas={kind: tuple(found) for kind, found in sorted(areas.items()) if found},
        )

    def _lanes(self, relation: OsmRelation, kind: LaneKind) -> list[WorldLane]:
        sides = self._sides(relation)
        if sides is None:
            return []
        (left_ids, left_line), (right_ids, right_line) = sides
        left, right = self._at(left_ids), self._at(right_ids)
        identifier = str(relation.id)
        lane = WorldLane(
            id=identifier,
            left=left,
            right=right,
            kind=kind,
            left_line=left_line,
            right_line=right_line,
            speed_limit_mps=speed_limit_mps(relation, self._document),
        )
        self._entries[identifier] = left_ids[0], right_ids[0]
        self._exits[identifier] = left_ids[-1], right_ids[-1]
        if kind != "road" or _is_one_way(relation.tags):
            return [lane]
        other = f"{identifier}~"
        self._entries[other] = right_ids[-1], left_ids[-1]
        self._exits[other] = right_ids[0], left_ids[0]
        reverse = replace(
            lane,
            id=other,
            left=right[::-1],
            right=left[::-1],
            left_line=right_line,
            right_line=left_line,
        )
        return [lane, reverse]

    def _sides(
        self, relation: OsmRelation
    ) -> tuple[tuple[list[int], str | None], tuple[list[int], str | None]] | None:
        """Node ids in driving direction and the id of the line, left and right."""
        chains = []
        for role in ("left", "right"):
            refs = [m.ref for m in relation.members if m.role == role and m.kind == "way"]
            chain = self._chain(refs)
            if chain is None:
                self.left_out["lanelets without two whole bounds"] += 1
                return None
            self._bounds |= set(refs)
            chains.append((chain, str(refs[0]) if len(refs) == 1 else None))
        (left, left_line), (right, right_line) = chains
        turn_left, turn_right = are_reversed(self._at(left), self._at(right))
        return (
            (left[:: -1 if turn_left else 1], left_line),
            (right[:: -1 if turn_right else 1], right_line),
        )

    def _chain(self, refs: Sequence[int]) -> list[int] | None:
        """Nodes of ways that continue one another, whichever way each runs; None if they do not."""
        chain: list[int] = []
        for ref in refs:
            way = self._document.ways.get(ref)
            ids = None if way is None else self._node_ids(way)
            if ids is None:
                return None
            if not chain:
                chain = ids
            elif chain[-1] in (ids[0], ids[-1]):
                chain = chain + (ids if ids[0] == chain[-1] else ids[::-1])[1:]
            elif chain[0] in (ids[0], ids[-1]):
                chain = (ids if ids[-1] == chain[0] else ids[::-1])[:-1] + chain
            else:
                return None
        return chain or None

    def _crossing(self, relation: OsmRelation) -> list[shapely.Polygon]:
        sides = self._sides(relation)
        if sides is None:
            return []
        left, right = (self._at(ids) for ids, _ in sides)
        return self._polygon(crosswalk_outline(left, right), [], "crossings")

    def _area(self, relation: OsmRelation) -> list[shapely.Polygon]:
        rings: dict[str, list[tuple[int, ...]]] = {"outer": [], "inner": []}
        for member in relation.members:
            if member.role in rings:
                way = self._document.ways.get(member.ref)
                ids = None if way is None else self._node_ids(way)
                if ids is None:
                    self.left_out["areas with an unreadable outline"] += 1
                    return []
                rings[member.role].append(tuple(ids))
        outer, inner = assemble_rings(rings["outer"]), assemble_rings(rings["inner"])
        if not outer or inner is None:
            self.left_out["areas whose outline does not close"] += 1
            return []
        holes = [self._at(ring) for ring in inner if len(ring) > 2]
        found: list[shapely.Polygon] = []
        for ring in outer:
            found += self._polygon(self._at(ring), holes if len(outer) == 1 else [], "areas")
        return found

    def _polygon(
        self, ring: NDArrayFloat, holes: list[NDArrayFloat], what: str
    ) -> list[shapely.Polygon]:
        if len(ring) < 3:
            self.left_out[f"{what} of less than three points"] += 1
            return []
        valid = shapely.make_valid(shapely.Polygon(ring, holes))
        parts = [p for p in shapely.get_parts(valid) if p.geom_type == "Polygon" and p.area > 0.01]
        if not parts:
            self.left_out[f"{what} without extent"] += 1
        return sorted(parts, key=lambda p: -p.area)[:1] if what == "crossings" else parts

    def _lines(self) -> list[WorldLine]:
        lines = []
        for way in self._document.ways.values():
            kind, paint = line_of(way.tags)
            if kind is None and way.id in self._bounds:
                kind = LineKind.VIRTUAL
            ids = self._node_ids(way) if kind is not None else None
            if kind is not None and ids is None:
                self.left_out["lines with less than two points"] += 1
            elif kind is not None and ids is not None:
                lines.append(WorldLine(str(way.id), self._at(ids), kind, paint))
        return lines

    def _stop_lines_and_crossing_lines(
        self, used: set[int]
    ) -> tuple[list[shapely.LineString], list[NDArrayFloat]]:
        stops, crossings = [], []
        for way in self._document.ways.values():
            kind = way.tags.get("type")
            if kind != "stop_line" and (kind not in _CROSSING_LINES or way.id in used):
                continue
            ids = self._node_ids(way)
            if ids is None:
                self.left_out["lines with less than two points"] += 1
            elif kind == "stop_line":
                stops.append(shapely.LineString(self._at(ids)))
            else:
                crossings.append(self._at(ids))
        return stops, crossings

    def _node_ids(self, way: OsmWay) -> list[int] | None:
        """Ids without repeats of a place in a row; None if less than two, or a node is missing."""
        if not set(way.node_ids) <= self._points.keys():
            return None
        ids: list[int] = []
        for node in way.node_ids:
            if not ids or np.hypot(*(self._points[node] - self._points[ids[-1]])) > 1e-6:
                ids.append(node)
        return ids if len(ids) > 1 else None

    def _at(self, node_ids: Sequence[int]) -> NDArrayFloat:
        return np.array([self._points[n] for n in node_ids])


def _is_one_way(tags: dict[str, str]) -> bool:
    value = tags.get("one_way:vehicle", tags.get("one_way"))
    if value is None:
        return tags.get("subtype") not in _BOTH_WAYS_BY_DEFAULT
    return value.lower() not in ("no", "false", "0")
