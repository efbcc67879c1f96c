"""Colours of all pictures, as (R, G, B).

The hues are those of Okabe and Ito, "Color Universal Design" (2008), which stay apart
under the common kinds of colour blindness, lightened where they fill areas.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

from hdmap_tools.labels.label_set import MapClass
from hdmap_tools.map_model.elements import (
    Centerline,
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    MarkStyle,
    RoadBoundary,
    SidewalkArea,
    StopLine,
    VegetationArea,
    VirtualBoundary,
)

RGB: TypeAlias = tuple[int, int, int]

PAPER: Final[RGB] = (255, 255, 255)
PAGE: Final[RGB] = (243, 244, 246)
INK: Final[RGB] = (32, 36, 42)
FAINT_INK: Final[RGB] = (110, 116, 124)
PATH: Final[RGB] = (20, 20, 20)

CLASS_COLORS: Final[dict[str, RGB]] = {
    MapClass.ROAD: (150, 156, 184),
    MapClass.CROSSWALK: (204, 121, 167),
    MapClass.LANE_MARK: (240, 216, 40),
    MapClass.VEGETATION: (120, 190, 150),
    MapClass.SIDEWALK: (150, 205, 240),
}
OTHER_CLASS: Final[RGB] = (222, 184, 135)
"""A class beyond the paper's five."""

AGREEMENT: Final[RGB] = (86, 180, 233)
MISS: Final[RGB] = (213, 94, 0)
FALSE_ALARM: Final[RGB] = (110, 30, 115)
BOTH_NEGATIVE: Final[RGB] = (222, 224, 227)
NOT_OBSERVED: Final[RGB] = (255, 255, 255)
TRUTH_NOT_OBSERVED: Final[RGB] = (250, 232, 212)
OUTSIDE: Final[RGB] = (247, 247, 248)


@dataclass(frozen=True)
class Stroke:
    """How an element is drawn.

    Attributes:
        name: In legends.
        color: Of the line or outline.
        width_px: Of the line, pixels.
        dash_px: (on, off) pixels, or None for an unbroken line.
        fill: Share of the colour inside a polygon, 0..1.
        casing_px: White margin on both sides.
        opacity: Of the line, on maps.
    """

    name: str
    color: RGB
    width_px: float
    dash_px: tuple[float, float] | None = None
    fill: float = 0.0
    casing_px: float = 0.8
    opacity: float = 1.0


# Lane marks are thin, bare, unbroken and let the paint through, their style in the colour: a person
# wants to hold them against the paint, which is often no wider than a pixel or two.
_MARKS: Final[dict[MarkStyle, Stroke]] = {
    MarkStyle.SOLID: Stroke("lane mark, solid", (214, 40, 0), 1.25, casing_px=0.0, opacity=0.6),
    MarkStyle.DASHED: Stroke("lane mark, dashed", (0, 70, 255), 1.25, casing_px=0.0, opacity=0.6),
    MarkStyle.UNKNOWN: Stroke(
        "lane mark, style unknown", (96, 56, 0), 1.25, casing_px=0.0, opacity=0.6
    ),
}
_DOUBLE_MARK: Final = Stroke("lane mark, double", (150, 0, 60), 2.0, casing_px=0.0, opacity=0.6)
_OTHERS: Final[dict[type[MapElement], Stroke]] = {
    Crosswalk: Stroke("crosswalk", (130, 20, 90), 2.0, fill=0.12),
    RoadBoundary: Stroke("road boundary", (30, 30, 34), 2.0),
    VirtualBoundary: Stroke("virtual boundary", (130, 130, 136), 1.0, (4.0, 4.0)),
    StopLine: Stroke("stop line", (190, 0, 0), 4.0),
    SidewalkArea: Stroke("sidewalk area", (40, 120, 180), 1.5),
    VegetationArea: Stroke("vegetation area", (0, 110, 70), 1.5),
    Centerline: Stroke("centerline", (130, 130, 136), 1.0, (6.0, 4.0)),
    Lanelet: Stroke("lanelet", (0, 140, 110), 1.2, (10.0, 3.0)),
}


def stroke_of(element: MapElement) -> Stroke:
    """How an element is drawn."""
    if isinstance(element, LaneMark):
        return _MARKS.get(element.style, _DOUBLE_MARK)
    for kind, stroke in _OTHERS.items():
        if isinstance(element, kind):
            return stroke
    return Stroke(element.element_type.replace("_", " "), FAINT_INK, 1.5)


def class_color(name: str) -> RGB:
    """Colour of a class of the map."""
    return CLASS_COLORS.get(name, OTHER_CLASS)
