"""What the tags of Lanelet2 lines and areas are on the ground, with the sizes of paint.

Lanelet2 says thin or thick and dashed or solid and no sizes. These are taken:

    thin    0.12 m    dashed 3 m, gap 6 m    (lane lines of built-up areas)
    thick   0.25 m    dashed 3 m, gap 3 m    (edges of lanes that join or leave)
    bicycle 0.25 m    dashed 0.5 m, gap 0.25 m (crossings of cycle paths)

Source:
    Germany's rules for road markings, RMS part 1 (FGSV 330/1): narrow line 0.12 m and wide
    line 0.25 m on roads that are no motorways; lane line in built-up areas dash to gap
    1:2 with a dash of 3 m. A tag ``width`` (metres) is taken where a map has one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from hdmap_tools.formats.osm_document import OsmDocument, OsmRelation
from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.simulate.world_map import LineKind, Paint

THIN_M: Final = 0.12
THICK_M: Final = 0.25
AREA_KINDS: Final = {
    "building": "building",
    "vegetation": "vegetation",
    "walkway": "sidewalk",
    "sidewalk": "sidewalk",
    "traffic_island": "island",
    "keepout": "island",
    "parking": "drivable",
    "freespace": "drivable",
    "exit": "drivable",
}
"""Kinds of `WorldMap.areas` by the subtype of a Lanelet2 area."""

_KINDS: Final = {
    "road_border": LineKind.EDGE,
    "fence": LineKind.FENCE,
    "wall": LineKind.WALL,
    "jersey_barrier": LineKind.WALL,
    "guard_rail": LineKind.GUARD_RAIL,
    "virtual": LineKind.VIRTUAL,
}
_SPEED = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*(km/?h|kmh|mph|m/?s|mps)?\s*", re.IGNORECASE)
_UNITS_MPS: Final = {"k": 1 / 3.6, "mp": 0.44704, "m": 1.0}


def line_of(tags: Mapping[str, str]) -> tuple[LineKind | None, Paint | None]:
    """What a line with these tags is on the ground; (None, None) if it is nothing there."""
    kind, subtype = tags.get("type", ""), tags.get("subtype", "")
    if kind in ("line_thin", "line_thick"):
        is_thick = kind == "line_thick"
        style = MarkStyle(subtype) if subtype in set(MarkStyle) else MarkStyle.SOLID
        style = MarkStyle.SOLID if style is MarkStyle.UNKNOWN else style
        return LineKind.PAINT, Paint(
            style=style,
            color=_color(tags),
            width_m=_width(tags, THICK_M if is_thick else THIN_M),
            gap_m=3.0 if is_thick else 6.0,
        )
    if kind == "bike_marking":
        return LineKind.PAINT, Paint(
            MarkStyle.DASHED, _color(tags), _width(tags, THICK_M), dash_m=0.5, gap_m=0.25
        )
    if kind == "zig-zag":
        return LineKind.PAINT, Paint(MarkStyle.SOLID, _color(tags), _width(tags, THIN_M))
    if kind == "curbstone":
        return (LineKind.KERB_LOW if subtype == "low" else LineKind.KERB_HIGH), None
    return _KINDS.get(kind), None


def speed_limit_mps(relation: OsmRelation, document: OsmDocument) -> float | None:
    """The limit a lanelet's own tag or its speed limit element gives, metres per second."""
    texts = [relation.tags.get("speed_limit", "")]
    for member in relation.members:
        rule = document.relations.get(member.ref) if member.kind == "relation" else None
        if rule is not None and rule.tags.get("subtype") == "speed_limit":
            texts.append(rule.tags.get("sign_type", ""))
    for text in texts:
        match = _SPEED.fullmatch(text)
        if match:
            unit = (match[2] or "km/h").lower()
            scale = next(v for k, v in _UNITS_MPS.items() if unit.startswith(k))
            return float(match[1]) * scale
    return None


def _color(tags: Mapping[str, str]) -> MarkColor:
    color = tags.get("color", "")
    return MarkColor(color) if color in ("white", "yellow", "blue") else MarkColor.WHITE


def _width(tags: Mapping[str, str], default_m: float) -> float:
    try:
        width_m = float(tags.get("width", "").removesuffix("m"))
    except ValueError:
        return default_m
    return width_m if 0.05 <= width_m <= 1.0 else default_m
