"""Which Lanelet2 tags say what an element says, in both directions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from hdmap_tools.map_model.elements import (
    BoundaryKind,
    LaneMark,
    MapElement,
    MarkColor,
    MarkStyle,
    RoadBoundary,
    SidewalkArea,
    StopLine,
    VegetationArea,
    VirtualBoundary,
)

THICK_LINE_M: Final = 0.20
"""From this width a mark is ``line_thick``. Lanelet2 names both and gives no figure; roads have
narrow lines of 0.10 to 0.15 m and wide ones of 0.25 to 0.30 m (German RMS-1), so measured widths
of both kinds are told apart best between them. The exact width is the tag ``width``."""

_BOUNDARY_TAGS: Final = {
    BoundaryKind.KERB_HIGH: {"type": "curbstone", "subtype": "high"},
    BoundaryKind.KERB_LOW: {"type": "curbstone", "subtype": "low"},
    BoundaryKind.EDGE: {"type": "road_border"},
    BoundaryKind.UNKNOWN: {"type": "road_border", "hdmap_kind": "unknown"},
}
_BARRIERS: Final = ("guard_rail", "wall", "fence", "jersey_barrier")
AREA_SUBTYPES: Final[dict[type[MapElement], str]] = {
    SidewalkArea: "walkway",
    VegetationArea: "vegetation",
}
OUTLINE_TYPES: Final = ("", "virtual", "pedestrian_marking", "zebra_marking")
"""A line of these that only outlines a crossing or area is part of it, no element of its own."""
ELEMENT_TAGS: Final = (
    "hdmap_id",
    "hdmap_type",
    "confidence",
    "sigma_m",
    "num_observations",
    "plugin",
    "plugin_version",
)
"""Our tags for what Lanelet2 has no place for; absent means the default."""
LINE_TAGS: Final = (
    *ELEMENT_TAGS,
    "type",
    "subtype",
    "width",
    "color",
    "hdmap_kind",
    "hdmap_island",
)


def element_tags(element: MapElement) -> dict[str, str]:
    """Tags every element has, those with their default left out."""
    tags = {"hdmap_id": element.id}
    for name in ELEMENT_TAGS[2:]:
        value = getattr(element, name)
        if value != type(element).model_fields[name].default:
            tags[name] = value if isinstance(value, str) else repr(value)
    return tags


def line_tags(element: MapElement) -> dict[str, str] | None:
    """Tags of a line element, or None if Lanelet2 has no line for it."""
    own: dict[str, str]
    if isinstance(element, LaneMark):
        is_thick = element.is_thick
        if is_thick is None:
            is_thick = _is_thick_by_width(element.width_m)
        own = {"type": "line_thick" if is_thick else "line_thin"}
        if element.style is not MarkStyle.UNKNOWN:
            own["subtype"] = element.style.value
        if element.color is not MarkColor.UNKNOWN:
            own["color"] = element.color.value
    elif isinstance(element, RoadBoundary):
        own = dict(_BOUNDARY_TAGS[element.kind])
        if element.is_island:
            own["hdmap_island"] = "yes"
    elif isinstance(element, VirtualBoundary):
        own = {"type": "virtual"}
    elif isinstance(element, StopLine):
        own = {"type": "stop_line"}
    else:
        return None
    width_m = getattr(element, "width_m", None)
    if width_m is not None:
        own["width"] = repr(width_m)
    return {**element_tags(element), **own}


def line_fields(tags: Mapping[str, str]) -> tuple[type[MapElement], dict[str, Any], str] | None:
    """Element type, its own fields, and what was changed on the way (or ""); None if unknown."""
    kind, subtype = tags.get("type", ""), tags.get("subtype", "")
    if kind in ("line_thin", "line_thick", "pedestrian_marking", "bike_marking"):
        known = subtype in set(MarkStyle)
        color = tags.get("color", "")
        changed = f"{kind} {subtype}".strip() if not known and subtype else ""
        width_m, is_thick = _width(tags), None
        if kind.endswith("_marking"):
            changed = kind
        elif (kind == "line_thick") != _is_thick_by_width(width_m):
            is_thick = kind == "line_thick"
        return (
            LaneMark,
            {
                "style": subtype if known else MarkStyle.UNKNOWN,
                "color": color if color in set(MarkColor) else MarkColor.UNKNOWN,
                "width_m": width_m,
                "is_thick": is_thick,
            },
            changed,
        )
    if kind in ("curbstone", "road_border") or kind in _BARRIERS:
        boundary = BoundaryKind.UNKNOWN
        if kind == "curbstone" and subtype in ("high", "low"):
            boundary = BoundaryKind(f"kerb_{subtype}")
        elif kind == "road_border" and tags.get("hdmap_kind") != "unknown":
            boundary = BoundaryKind.EDGE
        fields = {"kind": boundary, "is_island": tags.get("hdmap_island") == "yes"}
        return RoadBoundary, fields, kind if kind in _BARRIERS else ""
    if kind == "virtual":
        return VirtualBoundary, {}, ""
    if kind == "stop_line":
        return StopLine, {"width_m": _width(tags)}, ""
    return None


def read_element_tags(tags: Mapping[str, str], fallback_id: str) -> dict[str, Any]:
    """Fields that every element has; values still to be checked by the model."""
    fields: dict[str, Any] = {name: tags[name] for name in ELEMENT_TAGS[2:] if name in tags}
    fields["id"] = tags.get("hdmap_id") or fallback_id
    return fields


def _width(tags: Mapping[str, str]) -> float | None:
    try:
        width_m = float(tags.get("width", "").removesuffix("m"))
    except ValueError:
        return None
    return width_m if 0.0 < width_m < float("inf") else None


def _is_thick_by_width(width_m: float | None) -> bool:
    return width_m is not None and width_m >= THICK_LINE_M
