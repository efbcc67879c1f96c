"""Reading Lanelet2 maps, ours and anyone's."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from hdmap_tools.errors import FormatError
from hdmap_tools.formats.lanelet2_geometry import (
    are_reversed,
    assemble_rings,
    centerline_between,
    crosswalk_outline,
)
from hdmap_tools.formats.lanelet2_tags import (
    AREA_SUBTYPES,
    ELEMENT_TAGS,
    LINE_TAGS,
    OUTLINE_TYPES,
    line_fields,
    read_element_tags,
)
from hdmap_tools.formats.osm_document import OsmDocument, OsmRelation, OsmWay
from hdmap_tools.formats.osm_xml import read_osm
from hdmap_tools.formats.records import Skipped, element_from_fields, frame_around, parse_metadata
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import Crosswalk, Lanelet, MapElement, VirtualBoundary
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.types import NDArrayFloat

_log = logging.getLogger(__name__)

_AREA_TYPES: dict[str, type[MapElement]] = {
    **{subtype: element_type for element_type, subtype in AREA_SUBTYPES.items()},
    "crosswalk": Crosswalk,
}


def read_lanelet2(path: str | os.PathLike[str], frame: MapFrame | None = None) -> VectorMap:
    """Read a Lanelet2 map.

    What cannot be read is left out, logged and counted by kind in
    ``provenance["skipped"]`` with the first ids in ``provenance["skipped_ids"]``: broken
    references, invalid shapes, regulatory elements, signs, lights, symbols, other areas, tags
    without a field. ``provenance["read_as"]`` counts lines read as the nearest type we have.

    Args:
        path: An ``.osm`` file.
        frame: City frame of the result; by default the one in the file, or else one
            with its origin in the middle of the file.

    Returns:
        The map. Elements without our ``hdmap_id`` are called ``way-ID`` or ``relation-ID``.

    Raises:
        FormatError: If the file is damaged or hostile (`osm_xml.read_osm`).
    """
    document = read_osm(path)
    provenance: dict[str, Any] = {"source": {"format": "lanelet2", "generator": document.generator}}
    if document.metadata is not None:
        stored_frame, provenance = parse_metadata(document.metadata, str(path))
        frame = frame or stored_frame
    reader = _Reader(document, frame)
    reader.read()
    skipped, read_as = reader.skipped, +reader.read_as
    skipped.log(_log, str(path))
    if read_as:
        _log.info("%s: read %s.", path, ", ".join(f"{n} {k}" for k, n in sorted(read_as.items())))
    kept = {k: v for k, v in provenance.items() if k not in ("skipped", "skipped_ids", "read_as")}
    found = skipped.to_provenance() | (
        {"read_as": dict(sorted(read_as.items()))} if read_as else {}
    )
    return VectorMap(reader.frame, tuple(reader.elements), {**kept, **found})


class _Reader:
    def __init__(self, document: OsmDocument, frame: MapFrame | None) -> None:
        self.elements: list[MapElement] = []
        self.skipped = Skipped()
        self.read_as: Counter[str] = Counter()
        self._document = document
        geographic = np.array(
            [(n.lon, n.lat, n.ele) for n in document.nodes.values()], dtype=np.float64
        ).reshape(-1, 3)
        self.frame = frame or frame_around(geographic)
        points = self.frame.from_wgs84(geographic) if len(geographic) else geographic
        self._point = dict(zip(document.nodes, points, strict=True))
        self._ids: set[str] = set()
        self._element_of_way: dict[int, str] = {}

    def read(self) -> None:
        for _ in range(self._document.num_deleted):
            self.skipped.add("deleted", "-")
        lanelets, crossings, areas = self._sort_relations()
        bounds = {m.ref for r in lanelets for m in r.members if m.role in ("left", "right")}
        outlines = {m.ref for r in (*lanelets, *crossings, *areas) for m in r.members} - bounds
        for way in self._document.ways.values():
            self._read_way(way, way.id in bounds, way.id in outlines)
        self._count_nodes()
        self._read_lanelets(lanelets)
        for relation in crossings:
            self._read_crossing(relation)
        for relation in areas:
            self._read_area(relation)

    def _sort_relations(self) -> tuple[list[OsmRelation], list[OsmRelation], list[OsmRelation]]:
        lanelets: list[OsmRelation] = []
        crossings: list[OsmRelation] = []
        areas: list[OsmRelation] = []
        for relation in self._document.relations.values():
            kind, subtype = relation.tags.get("type", ""), relation.tags.get("subtype", "")
            if kind == "lanelet":
                is_crossing = subtype == "crosswalk" and "hdmap_type" not in relation.tags
                (crossings if is_crossing else lanelets).append(relation)
            elif kind == "multipolygon" and subtype in _AREA_TYPES:
                areas.append(relation)
            else:
                self.skipped.add(f"relation:{kind or 'untyped'}:{subtype}".rstrip(":"), relation.id)
        return lanelets, crossings, areas

    def _count_nodes(self) -> None:
        used = {ref for way in self._document.ways.values() for ref in way.node_ids}
        for node in self._document.nodes.values():
            if node.tags:
                self.skipped.add(f"node:{node.tags.get('type', 'tagged')}", node.id)
            elif node.id not in used:
                self.skipped.add("node:unused", node.id)

    def _read_way(self, way: OsmWay, is_bound: bool, is_outline: bool) -> None:
        kind = way.tags.get("type", "")
        if way.tags.get("area") in ("yes", "true", "1"):
            self._read_area_way(way)
            return
        if is_outline and kind in OUTLINE_TYPES and "hdmap_id" not in way.tags:
            return
        found = line_fields(way.tags)
        if found is None and is_bound:
            found = VirtualBoundary, {}, kind or "untyped way"
        if found is None:
            self.skipped.add(f"way:{kind or 'untyped'}", way.id)
            return
        points = self._points(way, "way")
        if points is None:
            return
        element_type, fields, changed = found
        element = self._add(element_type, fields, LineString(points), way, LINE_TAGS)
        if element is not None:
            self._element_of_way[way.id] = element.id
            if changed:
                self.read_as[f"{changed} as {element_type.element_type}"] += 1

    def _read_area_way(self, way: OsmWay) -> None:
        """A polygon: first point not repeated. Autoware repeats its crossings in this form."""
        kinds = (way.tags.get("type", ""), way.tags.get("subtype", ""))
        element_type = next((_AREA_TYPES[k] for k in kinds if k in _AREA_TYPES), None)
        points = self._points(way, "area") if element_type is not None else None
        if element_type is None:
            self.skipped.add(f"area:{kinds[0] or 'untyped'}", way.id)
        elif points is not None and len(points) < 3:
            self.skipped.add("area of less than three points", way.id)
        elif points is not None:
            self._add(element_type, {}, Polygon(points), way, (*LINE_TAGS, "area"))

    def _read_lanelets(self, lanelets: Iterable[OsmRelation]) -> None:
        found: list[tuple[OsmRelation, dict[str, Any], NDArrayFloat]] = []
        gates: dict[int, tuple[tuple[int, int], tuple[int, int]]] = {}
        for relation in lanelets:
            sides = self._sides(relation)
            if sides is None:
                continue
            (left_way, left, turn_left), (right_way, right, turn_right) = sides
            if left_way not in self._element_of_way or right_way not in self._element_of_way:
                self.skipped.add("lanelet with an unreadable bound", relation.id)
                continue
            fields = {
                "left_id": self._element_of_way[left_way],
                "right_id": self._element_of_way[right_way],
                "is_left_reversed": turn_left,
                "is_right_reversed": turn_right,
                "subtype": relation.tags.get("subtype", "road"),
                "tags": {
                    k: v
                    for k, v in relation.tags.items()
                    if k not in (*ELEMENT_TAGS, "type", "subtype")
                },
            }
            center = self._centerline(relation)
            found.append(
                (relation, fields, centerline_between(left, right) if center is None else center)
            )
            ends = [
                self._document.ways[w].node_ids[:: -1 if turned else 1]
                for w, turned in ((left_way, turn_left), (right_way, turn_right))
            ]
            gates[relation.id] = (ends[0][0], ends[1][0]), (ends[0][-1], ends[1][-1])
        starts: dict[tuple[int, int], list[str]] = {}
        made: list[tuple[int, Lanelet]] = []
        for relation, fields, center in found:
            lanelet = self._add(Lanelet, fields, LineString(center), relation, None)
            if isinstance(lanelet, Lanelet):
                self.elements.pop()
                starts.setdefault(gates[relation.id][0], []).append(lanelet.id)
                made.append((relation.id, lanelet))
        for identifier, lanelet in made:
            following = sorted(set(starts.get(gates[identifier][1], ())) - {lanelet.id})
            self.elements.append(lanelet.model_copy(update={"successor_ids": tuple(following)}))

    def _read_crossing(self, relation: OsmRelation) -> None:
        sides = self._sides(relation)
        if sides is not None:
            left, right = (points for _, points, _ in sides)
            # A corner that both sides share stands once in the outline.
            ring = crosswalk_outline(left, right)
            distinct = ring[np.any(ring != np.roll(ring, 1, axis=0), axis=1)]
            if len(distinct) < 3:
                self.skipped.add("crosswalk of less than three points", relation.id)
            else:
                known = (*LINE_TAGS, "location", "one_way", "participant:pedestrian")
                self._add(Crosswalk, {}, Polygon(distinct), relation, known)

    def _read_area(self, relation: OsmRelation) -> None:
        lines: dict[str, list[tuple[int, ...]]] = {"outer": [], "inner": []}
        for member in relation.members:
            if member.role not in lines:
                self.skipped.add(f"role {member.role or 'missing'} of an area", relation.id)
                continue
            way = self._document.ways.get(member.ref) if member.kind == "way" else None
            if way is None or len(way.node_ids) < 2 or not set(way.node_ids) <= self._point.keys():
                self.skipped.add("area with an unreadable outline", relation.id)
                return
            lines[member.role].append(way.node_ids)
        outer, inner = assemble_rings(lines["outer"]), assemble_rings(lines["inner"])
        if outer is None or inner is None or len(outer) != 1:
            self.skipped.add("area whose outline does not close once", relation.id)
        elif any(len(ring) < 3 for ring in (*outer, *inner)):
            self.skipped.add("area of less than three points", relation.id)
        else:
            polygon = Polygon(self._at(outer[0]), [self._at(ring) for ring in inner])
            element_type = _AREA_TYPES[relation.tags["subtype"]]
            self._add(element_type, {}, polygon, relation, (*LINE_TAGS, "location"))

    def _sides(self, relation: OsmRelation) -> list[tuple[int, NDArrayFloat, bool]] | None:
        """(way, points in the lanelet's direction, whether turned) of the left and right bound."""
        refs: dict[str, list[int]] = {"left": [], "right": []}
        for member in relation.members:
            if member.role in refs and member.kind == "way":
                refs[member.role].append(member.ref)
            elif member.role not in ("centerline", "regulatory_element"):
                self.skipped.add(f"role {member.role or 'missing'} of a lanelet", relation.id)
        if [len(ways) for ways in refs.values()] != [1, 1]:
            self.skipped.add("lanelet without one left and one right way", relation.id)
            return None
        ways = [self._document.ways.get(refs[side][0]) for side in ("left", "right")]
        points = [None if way is None else self._points(way, None) for way in ways]
        if points[0] is None or points[1] is None:
            self.skipped.add("lanelet with an unreadable bound", relation.id)
            return None
        turned = are_reversed(points[0], points[1])
        return [
            (refs[side][0], line[:: -1 if turn else 1], turn)
            for side, line, turn in zip(
                ("left", "right"), (points[0], points[1]), turned, strict=True
            )
        ]

    def _centerline(self, relation: OsmRelation) -> NDArrayFloat | None:
        refs = [m.ref for m in relation.members if m.role == "centerline" and m.kind == "way"]
        if not refs:
            return None
        way = self._document.ways.get(refs[0])
        points = None if way is None else self._points(way, None)
        if points is None:
            self.skipped.add("unreadable centerline of a lanelet", relation.id)
        return points

    def _points(self, way: OsmWay, count_as: str | None) -> NDArrayFloat | None:
        """(N, 3) of at least two points without repeats, or None, counted as that kind."""
        if not set(way.node_ids) <= self._point.keys():
            if count_as:
                self.skipped.add(f"{count_as} with missing nodes", way.id)
            return None
        ids = [n for k, n in enumerate(way.node_ids) if k == 0 or n != way.node_ids[k - 1]]
        if len(ids) < 2:
            if count_as:
                self.skipped.add(f"{count_as} of less than two points", way.id)
            return None
        return self._at(ids)

    def _at(self, node_ids: Sequence[int]) -> NDArrayFloat:
        return np.array([self._point[n] for n in node_ids])

    def _add(
        self,
        element_type: type[MapElement],
        own: Mapping[str, Any],
        geometry: BaseGeometry,
        primitive: OsmWay | OsmRelation,
        known_tags: Sequence[str] | None,
    ) -> MapElement | None:
        kind = "way" if isinstance(primitive, OsmWay) else "relation"
        fallback = f"{kind}-{primitive.id}"
        fields = {**read_element_tags(primitive.tags, fallback), **own}
        if fields["id"] in self._ids:  # an editor that splits a way copies its tags
            self.skipped.add("repeated hdmap_id", primitive.id)
            fields["id"] = f"{fields['id']}/{fallback}"
        try:
            element = element_from_fields(element_type, fields, geometry, f"{kind} {primitive.id}")
        except FormatError as error:
            _log.debug("skipped: %s", error)
            self.skipped.add(f"invalid {element_type.element_type}", primitive.id)
            return None
        self._ids.add(element.id)
        self.elements.append(element)
        for tag in primitive.tags if known_tags is not None else ():
            if tag not in (known_tags or ()):
                self.skipped.add(f"tag:{tag}", primitive.id)
        return element
