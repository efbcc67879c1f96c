"""An OSM XML document as values: what Lanelet2 maps are made of, and the rules they keep."""

from __future__ import annotations

import math
import re
from collections.abc import Container
from dataclasses import dataclass, field
from typing import Final
from xml.sax.saxutils import quoteattr

from hdmap_tools.errors import FormatError

MAX_ID: Final = 2**63 - 1
COORDINATE_DECIMALS: Final = 11
"""Of latitude and longitude: 1 µm."""
HEIGHT_DECIMALS: Final = 6
GENERATOR: Final = "hdmap_tools"

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class OsmNode:
    """A point: latitude and longitude in degrees, height (tag ``ele``) in metres."""

    id: int
    lat: float
    lon: float
    ele: float = 0.0
    tags: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class OsmWay:
    """A line: ids of its nodes in order."""

    id: int
    node_ids: tuple[int, ...]
    tags: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class OsmMember:
    """A member of a relation: ``kind`` is node, way or relation."""

    kind: str
    ref: int
    role: str


@dataclass(frozen=True)
class OsmRelation:
    """A lanelet, area or regulatory element."""

    id: int
    members: tuple[OsmMember, ...]
    tags: dict[str, str] = field(default_factory=dict)


@dataclass
class OsmDocument:
    """Nodes, ways and relations by id, in the order of the file.

    Attributes:
        metadata: Our own line about frame and provenance, if the file has one.
        generator: Which program wrote it.
        num_deleted: Primitives marked ``action="delete"``, which are left out.
    """

    nodes: dict[int, OsmNode] = field(default_factory=dict)
    ways: dict[int, OsmWay] = field(default_factory=dict)
    relations: dict[int, OsmRelation] = field(default_factory=dict)
    metadata: str | None = None
    generator: str = ""
    num_deleted: int = 0


def to_xml(document: OsmDocument) -> str:
    """The document as OSM XML 0.6: nodes, then ways, then relations.

    Raises:
        FormatError: If a text holds a character that XML cannot.
    """
    lines = [
        "<?xml version='1.0' encoding='UTF-8'?>",
        f'<osm version="0.6" generator={_quoted(document.generator)} upload="false">',
    ]
    if document.metadata is not None:
        lines.append(f"  <hdmap_tools metadata={_quoted(document.metadata)}/>")
    for node in document.nodes.values():
        position = (
            f'lat="{plain(node.lat, COORDINATE_DECIMALS)}" '
            f'lon="{plain(node.lon, COORDINATE_DECIMALS)}"'
        )
        height = {"ele": plain(node.ele, HEIGHT_DECIMALS)}
        lines += _primitive("node", node.id, position, [], {**height, **node.tags})
    for way in document.ways.values():
        refs = [f'    <nd ref="{ref}"/>' for ref in way.node_ids]
        lines += _primitive("way", way.id, "", refs, way.tags)
    for relation in document.relations.values():
        members = [
            f'    <member type="{m.kind}" ref="{m.ref}" role={_quoted(m.role)}/>'
            for m in relation.members
        ]
        lines += _primitive("relation", relation.id, "", members, relation.tags)
    return "\n".join([*lines, "</osm>", ""])


def plain(value: float, decimals: int) -> str:
    """A number without exponent, trailing zeros or negative zero."""
    text = f"{value:.{decimals}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return "0" if text == "-0" else text


def require_valid_lanelet2(document: OsmDocument) -> None:
    """Raise `FormatError` unless the document keeps the rules of a Lanelet2 file.

    Ids positive and unique in the whole file, positions finite and in range, references
    resolved, ways of two or more nodes without repeats in a row, lines typed, lanelets with
    one left and one right way that share no node (but one where the lane begins or ends in a
    point), lanelets and areas with their tags.

    Source:
        Lanelet2, lanelet2_maps and lanelet2_io documentation and OsmFile.cpp.
    """
    seen: set[int] = set()
    primitives: list[OsmNode | OsmWay | OsmRelation] = [
        *document.nodes.values(),
        *document.ways.values(),
        *document.relations.values(),
    ]
    for primitive in primitives:
        name = _name(primitive)
        if not 0 < primitive.id <= MAX_ID or primitive.id in seen:
            raise FormatError(f"{name}: its id is not positive, unique and below 2^63.")
        seen.add(primitive.id)
    for node in document.nodes.values():
        in_range = -90.0 <= node.lat <= 90.0 and -180.0 <= node.lon <= 180.0
        if not (in_range and math.isfinite(node.ele)):
            raise FormatError(
                f"{_name(node)}: position {node.lat}, {node.lon}, {node.ele} is not latitude, "
                "longitude and finite height."
            )
    for way in document.ways.values():
        _check_way(way, document)
    for relation in document.relations.values():
        _check_relation(relation, document)


def _check_way(way: OsmWay, document: OsmDocument) -> None:
    name = _name(way)
    missing = [ref for ref in way.node_ids if ref not in document.nodes]
    if missing:
        raise FormatError(f"{name}: node {missing[0]} does not exist.")
    if len(way.node_ids) < 2:
        raise FormatError(f"{name}: a line needs two points, found {len(way.node_ids)}.")
    for a, b in zip(way.node_ids, way.node_ids[1:], strict=False):
        first, second = document.nodes[a], document.nodes[b]
        if a == b or (first.lat, first.lon, first.ele) == (second.lat, second.lon, second.ele):
            raise FormatError(
                f"{name}: two points in a row are the same (latitude {first.lat}, longitude "
                f"{first.lon}); remove repeated vertices first."
            )
    if not way.tags.get("type"):
        raise FormatError(f"{name}: the tag 'type' is missing.")


def _check_relation(relation: OsmRelation, document: OsmDocument) -> None:
    name = _name(relation)
    known: dict[str, Container[int]] = {
        "node": document.nodes,
        "way": document.ways,
        "relation": document.relations,
    }
    for member in relation.members:
        if member.ref not in known.get(member.kind, ()):
            raise FormatError(f"{name}: its member {member.kind} {member.ref} does not exist.")
    kind = relation.tags.get("type")
    roles = [member.role for member in relation.members]
    if kind == "lanelet":
        needed: tuple[str, ...] = ("subtype", "location")
        if roles.count("left") != 1 or roles.count("right") != 1:
            raise FormatError(f"{name}: expected one left and one right way, found roles {roles}.")
        unknown = set(roles) - {"left", "right", "centerline", "regulatory_element"}
        if unknown:
            raise FormatError(f"{name}: a lanelet has no role {sorted(unknown)[0]!r}.")
        bounds = {
            m.role: document.ways[m.ref].node_ids for m in relation.members if m.kind == "way"
        }
        left, right = bounds["left"], bounds["right"]
        shared = set(left) & set(right)
        # A lane that begins or ends in a point is against the written rule, but the library
        # takes it and its own example map has four of them.
        if shared - ({left[0], left[-1]} & {right[0], right[-1]}) or len(shared) > 1:
            raise FormatError(
                f"{name}: its left and right bound share the point node {min(shared)}; "
                "Lanelet2 wants them apart."
            )
    elif kind == "multipolygon":
        needed = ("subtype",)
        if "outer" not in roles or set(roles) - {"outer", "inner", "regulatory_element"}:
            raise FormatError(f"{name}: expected outer and inner ways, found roles {roles}.")
    elif kind == "regulatory_element":
        needed = ("subtype",)
    else:
        raise FormatError(f"{name}: type {kind!r} is none that Lanelet2 knows.")
    for tag in needed:
        if not relation.tags.get(tag):
            raise FormatError(f"{name}: the tag {tag!r} is missing.")


def _name(primitive: OsmNode | OsmWay | OsmRelation) -> str:
    kind = type(primitive).__name__.removeprefix("Osm").lower()
    ours = primitive.tags.get("hdmap_id")
    return f"{kind} {primitive.id}" + (f" (element {ours!r})" if ours else "")


def _primitive(
    kind: str, identifier: int, position: str, children: list[str], tags: dict[str, str]
) -> list[str]:
    start = f'  <{kind} id="{identifier}" visible="true" version="1"'
    body = children + [f"    <tag k={_quoted(k)} v={_quoted(v)}/>" for k, v in sorted(tags.items())]
    start += f" {position}" if position else ""
    return [f"{start}/>"] if not body else [f"{start}>", *body, f"  </{kind}>"]


def _quoted(text: str) -> str:
    found = _NOT_XML.search(text)
    if found:
        raise FormatError(
            f"{text[:60]!r} holds the character {found.group()!r}, which XML cannot; rename it."
        )
    return quoteattr(text)
