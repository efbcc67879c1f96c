"""Writing Lanelet2.

| element | in the file |
|---|---|
| lane mark | way ``line_thin`` or ``line_thick``, subtype, width, color |
| road boundary | way ``curbstone`` high or low, or ``road_border`` |
| virtual boundary, stop line | way ``virtual``, ``stop_line`` |
| crosswalk | lanelet ``subtype=crosswalk`` between two ways ``pedestrian_marking`` |
| sidewalk, vegetation | relation ``multipolygon``, ``walkway`` or ``vegetation`` |
| lanelet | relation ``lanelet`` on the ways of its bounds |
| centerline | not written: Lanelet2 has it only as part of a lanelet |

Bounds that end in the same point share the node there; that is how readers find successors.
Ids are numbered from 1 in the order of the map, so they are the same in every run.
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from hdmap_tools.errors import CRSMismatchError, FormatError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.formats.lanelet2_geometry import (
    are_reversed,
    centerline_between,
    split_crosswalk,
)
from hdmap_tools.formats.lanelet2_tags import AREA_SUBTYPES, ELEMENT_TAGS, element_tags, line_tags
from hdmap_tools.formats.osm_document import (
    COORDINATE_DECIMALS,
    GENERATOR,
    HEIGHT_DECIMALS,
    OsmDocument,
    OsmMember,
    OsmNode,
    OsmRelation,
    OsmWay,
    require_valid_lanelet2,
    to_xml,
)
from hdmap_tools.formats.osm_xml import read_osm
from hdmap_tools.formats.records import dump_metadata
from hdmap_tools.map_model.elements import (
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    RoadBoundary,
    SidewalkArea,
    VegetationArea,
    VirtualBoundary,
)
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.types import NDArrayFloat

_log = logging.getLogger(__name__)

SAME_CENTERLINE_M: Final = 5e-4
"""A lanelet's centerline is written only if it is not, within this, the middle of its bounds."""
NEAR_POINTS_M: Final = 0.05
"""Lanelet2 warns about points nearer to each other than this."""


def write_lanelet2(
    vector_map: VectorMap, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write the map as Lanelet2 OSM XML.

    What the format cannot hold is logged as a warning with its count.

    Raises:
        NoOriginError: If the map has no place on earth.
        OutputExistsError: If the file exists and overwrite is False.
        FormatError: If an element would break the format's rules; the message names it.
    """
    document = to_osm(vector_map)
    text = to_xml(document)

    def validate(temporary: Path) -> None:
        found = read_osm(temporary)
        require_valid_lanelet2(found)
        if found != document:
            raise FormatError(f"{path} did not come back as it was written; nothing was changed.")

    with atomic_output(path, overwrite, validate=validate) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def to_osm(vector_map: VectorMap) -> OsmDocument:
    """The map as an OSM document that keeps Lanelet2's rules.

    Raises:
        NoOriginError: If the map has no place on earth.
        FormatError: If an element would break the format's rules.
    """
    _ = vector_map.frame.crs
    builder = _Builder(vector_map)
    for element in vector_map:
        if isinstance(element, Lanelet):
            continue  # needs the ways of its bounds
        if isinstance(element, Crosswalk):
            builder.add_crosswalk(element)
        elif isinstance(element, SidewalkArea | VegetationArea):
            builder.add_area(element, AREA_SUBTYPES[type(element)])
        else:
            builder.add_line(element)
    for lanelet in vector_map.of_type(Lanelet):
        builder.add_lanelet(lanelet)
    builder.compare_successors()
    builder.report()
    document = builder.finish()
    require_valid_lanelet2(document)
    return document


class _Builder:
    """Collects primitives, each numbered from 0 among its kind; ids are given at the end."""

    def __init__(self, vector_map: VectorMap) -> None:
        self._map = vector_map
        self._nodes: list[tuple[float, float, float]] = []
        self._ways: list[tuple[list[int], dict[str, str]]] = []
        self._relations: list[tuple[list[tuple[int, str]], dict[str, str]]] = []
        self._shared: dict[tuple[float, float, float], int] = {}
        self._way_of_element: dict[str, int] = {}
        self._points_of_element: dict[str, NDArrayFloat] = {}
        self._gates: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {}
        self._lost: Counter[str] = Counter()
        self._num_near = 0

    def add_line(self, element: MapElement) -> None:
        tags = line_tags(element)
        if tags is None:
            self._lost[element.element_type] += 1
            return
        points = shapely.get_coordinates(element.geometry, include_z=True)
        is_bound = isinstance(element, LaneMark | RoadBoundary | VirtualBoundary)
        self._way_of_element[element.id] = self._way(element, points, tags, shares_ends=is_bound)
        self._points_of_element[element.id] = points

    def add_crosswalk(self, element: Crosswalk) -> None:
        polygon = element.geometry
        assert isinstance(polygon, Polygon)
        if polygon.interiors:
            self._lost["hole of a crosswalk"] += len(polygon.interiors)
        _refuse_repeats(element, shapely.get_coordinates(polygon.exterior, include_z=True))
        sides = split_crosswalk(polygon)
        if sides is None:
            raise FormatError(
                f"crosswalk {element.id!r} has no two sides that a Lanelet2 reader could tell apart; "
                "split it into simpler polygons."
            )
        ways = [
            (self._way(element, side, {"type": "pedestrian_marking"}), role)
            for side, role in zip(sides, ("left", "right"), strict=True)
        ]
        own = {
            "type": "lanelet",
            "subtype": "crosswalk",
            "location": "urban",
            "one_way": "no",
            "participant:pedestrian": "yes",
        }
        self._relations.append((ways, {**element_tags(element), **own}))

    def add_area(self, element: MapElement, subtype: str) -> None:
        polygon = element.geometry
        assert isinstance(polygon, Polygon)
        # Clockwise, as the library keeps its areas and holes.
        rings = [polygon.exterior, *polygon.interiors]
        members = []
        for ring in rings:
            points = shapely.get_coordinates(orient(Polygon(ring), -1.0).exterior, include_z=True)
            way = self._way(element, points, {"type": "virtual"})
            members.append((way, "outer" if ring is rings[0] else "inner"))
        own = {"type": "multipolygon", "subtype": subtype, "location": "urban"}
        self._relations.append((members, {**element_tags(element), **own}))

    def add_lanelet(self, element: Lanelet) -> None:
        name = f"lanelet {element.id!r}"
        for side, identifier in (("left", element.left_id), ("right", element.right_id)):
            if identifier not in self._way_of_element:
                raise FormatError(
                    f"{name}: its {side} bound {identifier!r} is no line of the map that Lanelet2 "
                    "holds; add it to the map."
                )
        if element.left_id == element.right_id:
            raise FormatError(f"{name}: {element.left_id!r} is its left and its right bound.")
        left, right = (self._points_of_element[i] for i in (element.left_id, element.right_id))
        said = (element.is_left_reversed, element.is_right_reversed)
        seen = are_reversed(left, right)
        if said != seen:
            raise FormatError(
                f"{name}: it says its bounds run (left, right) "
                f"{_directions(said)}, but as they lie a reader takes them as {_directions(seen)}; "
                "are left and right swapped?"
            )
        left, right = left[:: -1 if said[0] else 1], right[:: -1 if said[1] else 1]
        members = [
            (self._way_of_element[element.left_id], "left"),
            (self._way_of_element[element.right_id], "right"),
        ]
        center = shapely.get_coordinates(element.geometry, include_z=True)
        middle = centerline_between(left, right)
        if center.shape != middle.shape or np.abs(center - middle).max() > SAME_CENTERLINE_M:
            members.append((self._way(element, center, {"type": "virtual"}), "centerline"))
        reserved = [tag for tag in (*ELEMENT_TAGS, "type", "subtype") if tag in element.tags]
        if reserved:
            raise FormatError(
                f"{name}: the tag {reserved[0]!r} is written from the lanelet's own fields; "
                "remove it from tags."
            )
        tags = {"location": "urban", **element.tags, **element_tags(element)}
        tags |= {"type": "lanelet", "subtype": element.subtype}
        if element.subtype == "crosswalk":
            tags["hdmap_type"] = "lanelet"  # or it would be read as a crosswalk polygon
        self._relations.append((members, tags))
        ends = [
            self._ways[way][0][:: -1 if turn else 1]
            for (way, _), turn in zip(members, said, strict=False)
        ]
        self._gates[element.id] = (ends[0][0], ends[1][0]), (ends[0][-1], ends[1][-1])

    def compare_successors(self) -> None:
        """Successors are not written but follow from shared nodes: count where they differ."""
        starts: dict[tuple[int, int], list[str]] = {}
        for identifier, (start, _) in self._gates.items():
            starts.setdefault(start, []).append(identifier)
        for lanelet in self._map.of_type(Lanelet):
            readable = set(starts.get(self._gates[lanelet.id][1], ())) - {lanelet.id}
            self._lost["successor whose bounds do not meet"] += len(
                set(lanelet.successor_ids) - readable
            )
            self._lost["end of lanelets that meet without being successors"] += len(
                readable - set(lanelet.successor_ids)
            )

    def report(self) -> None:
        lost = +self._lost
        if lost:
            _log.warning(
                "Lanelet2 cannot hold everything in this map: %s.",
                ", ".join(f"{count} {kind}" for kind, count in sorted(lost.items())),
            )
        if self._num_near:
            _log.warning(
                "%d pairs of consecutive points lie nearer than %.2f m; Lanelet2's checks warn about them.",
                self._num_near,
                NEAR_POINTS_M,
            )

    def finish(self) -> OsmDocument:
        first_way = len(self._nodes) + 1
        first_relation = first_way + len(self._ways)
        nodes = (OsmNode(k, lat, lon, ele) for k, (lat, lon, ele) in enumerate(self._nodes, 1))
        ways = (
            OsmWay(k, tuple(n + 1 for n in way_nodes), tags)
            for k, (way_nodes, tags) in enumerate(self._ways, first_way)
        )
        relations = (
            OsmRelation(
                k, tuple(OsmMember("way", first_way + way, role) for way, role in members), tags
            )
            for k, (members, tags) in enumerate(self._relations, first_relation)
        )
        return OsmDocument(
            {n.id: n for n in nodes},
            {w.id: w for w in ways},
            {r.id: r for r in relations},
            dump_metadata(self._map),
            GENERATOR,
        )

    def _way(
        self,
        element: MapElement,
        points: NDArrayFloat,
        tags: dict[str, str],
        shares_ends: bool = False,
    ) -> int:
        positions = self._positions(element, points)
        _refuse_repeats(element, np.array(positions))
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        self._num_near += int((steps < NEAR_POINTS_M).sum())
        is_closed = positions[0] == positions[-1]
        nodes: list[int] = []
        for position in positions[:-1] if is_closed else positions:
            is_end = not nodes or len(nodes) == len(positions) - 1
            nodes.append(self._node(position, shares_ends and is_end))
        if is_closed:
            nodes.append(nodes[0])
        self._ways.append((nodes, tags))
        return len(self._ways) - 1

    def _node(self, position: tuple[float, float, float], is_shared: bool) -> int:
        if is_shared and position in self._shared:
            return self._shared[position]
        self._nodes.append(position)
        if is_shared:
            self._shared[position] = len(self._nodes) - 1
        return len(self._nodes) - 1

    def _positions(
        self, element: MapElement, points: NDArrayFloat
    ) -> list[tuple[float, float, float]]:
        try:
            geographic = self._map.frame.to_wgs84(points)
        except CRSMismatchError as error:
            raise FormatError(f"{element.element_type} {element.id!r}: {error}") from error
        return [
            (
                _decimal(lat, COORDINATE_DECIMALS),
                _decimal(lon, COORDINATE_DECIMALS),
                _decimal(ele, HEIGHT_DECIMALS),
            )
            for lon, lat, ele in geographic
        ]


def _refuse_repeats(element: MapElement, points: NDArrayFloat) -> None:
    repeated = np.flatnonzero((np.diff(points, axis=0) == 0.0).all(axis=1))
    if len(repeated):
        raise FormatError(
            f"{element.element_type} {element.id!r} has the same point twice in a row (vertices "
            f"{repeated[0]} and {repeated[0] + 1}, within 1 µm); remove repeated vertices first."
        )


def _decimal(value: float, decimals: int) -> float:
    """The number that a reader gets back from the file."""
    return float(f"{value:.{decimals}f}") + 0.0


def _directions(is_reversed: Sequence[bool]) -> str:
    return ", ".join("backward" if r else "forward" for r in is_reversed)
