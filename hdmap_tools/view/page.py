"""Laying out pictures on one page: title, rows of pictures with their titles, legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import shapely

from hdmap_tools.types import NDArrayByte
from hdmap_tools.view.canvas import draw_lines, fill, fitting_text, put_text, text_width
from hdmap_tools.view.palette import FAINT_INK, INK, PAGE, PAPER, RGB

_MARGIN_PX: Final = 18
_TITLE_PX: Final = 34
_CAPTION_PX: Final = 28
_LEGEND_ROW_PX: Final = 24
_PLAIN_WIDTH_PX: Final = 1400


@dataclass(frozen=True, eq=False)
class TitledPicture:
    """A picture with a line above it and, in fainter ink, one beside that.

    Attributes:
        title: In bold.
        picture: (height, width, 3) uint8 RGB.
        note: Figures and the like.
    """

    title: str
    picture: NDArrayByte
    note: str = ""


@dataclass(frozen=True)
class LegendEntry:
    """One line of a legend: a filled box, a line, or a line with a triangle."""

    name: str
    color: RGB
    kind: Literal["area", "line", "arrow"] = "area"
    dash_px: tuple[float, float] | None = None
    width_px: float = 2.5


def compose(
    rows: Sequence[Sequence[TitledPicture]],
    legend: Sequence[LegendEntry] = (),
    *,
    title: str = "",
    min_width_px: int = 640,
) -> NDArrayByte:
    """Put rows of pictures, each row centred, over a legend on one page; wide pages have larger text.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    rows = [row for row in rows if row]
    widths = [sum(p.picture.shape[1] for p in row) + _MARGIN_PX * (len(row) + 1) for row in rows]
    width = max([min_width_px, *widths])
    text = text_scale(width)
    caption_px = round(_CAPTION_PX * text)
    heights = [max(p.picture.shape[0] for p in row) + caption_px + _MARGIN_PX for row in rows]
    lines = _legend_lines(legend, width - 2 * _MARGIN_PX, text)
    top = _MARGIN_PX + (round(_TITLE_PX * text) if title else 0)
    legend_px = round(len(lines) * _LEGEND_ROW_PX * text)
    height = top + sum(heights) + legend_px + (_MARGIN_PX if lines else 0)
    page = np.empty((height, width, 3), dtype=np.uint8)
    page[:] = PAGE
    if title:
        size = 0.75 * text
        fitting = fitting_text(title, width - 2 * _MARGIN_PX, size, bold=True)
        put_text(page, fitting, (_MARGIN_PX, _MARGIN_PX + 16 * text), size=size, bold=True)
    for row, row_width, row_height in zip(rows, widths, heights, strict=True):
        left = (width - row_width) // 2 + _MARGIN_PX
        for item in row:
            _place(page, item, left, top, text)
            left += item.picture.shape[1] + _MARGIN_PX
        top += row_height
    for line in lines:
        left = _MARGIN_PX
        for entry, entry_width in line:
            _draw_entry(page, entry, left, top, text)
            left += entry_width
        top += round(_LEGEND_ROW_PX * text)
    return page


def text_scale(width_px: int) -> float:
    """How much larger text must be to be read when a page so wide is shown on a screen."""
    return float(np.clip(width_px / _PLAIN_WIDTH_PX, 1.0, 2.0))


def _place(page: NDArrayByte, item: TitledPicture, left: int, top: int, text: float) -> None:
    height, width = item.picture.shape[:2]
    base = top + 18 * text
    title = fitting_text(item.title, width, 0.55 * text, bold=True)
    put_text(page, title, (left, base), size=0.55 * text, bold=True)
    used = text_width(title, 0.55 * text, bold=True) + round(14 * text)
    if item.note and width - used > 60:
        note = fitting_text(item.note, width - used, 0.45 * text)
        put_text(page, note, (left + used, base), size=0.45 * text, color=FAINT_INK)
    top += round(_CAPTION_PX * text)
    page[top - 1 : top + height + 1, left - 1 : left + width + 1] = (190, 194, 200)
    page[top : top + height, left : left + width] = item.picture


def _legend_lines(
    legend: Sequence[LegendEntry], width: int, text: float
) -> list[list[tuple[LegendEntry, int]]]:
    lines: list[list[tuple[LegendEntry, int]]] = []
    used = width + 1
    for entry in legend:
        needed = round(54 * text) + text_width(entry.name, 0.45 * text)
        if used + needed > width:
            lines.append([])
            used = 0
        lines[-1].append((entry, needed))
        used += needed
    return lines


def _draw_entry(page: NDArrayByte, entry: LegendEntry, left: int, top: int, text: float) -> None:
    middle = top + 9.0 * text
    right, half = left + 26 * text, 7 * text
    if entry.kind == "area":
        fill(page, shapely.box(left, middle - half, right, middle + half), FAINT_INK)
        inner = shapely.box(left + 1, middle - half + 1, right - 1, middle + half - 1)
        fill(page, inner, entry.color)
    else:
        fill(page, shapely.box(left, middle - half, right, middle + half), PAPER)
        line = np.array([(left + 1.0, middle), (right - 1.0, middle)])
        width_px = entry.width_px * text
        draw_lines(page, [line], entry.color, width_px, dash_px=entry.dash_px)
        if entry.kind == "arrow":
            tip = np.array([(24, 0), (12, -6), (12, 6)]) * text + (left, middle)
            fill(page, shapely.Polygon(tip), entry.color)
    at = (left + 34 * text, middle + 5 * text)
    put_text(page, entry.name, at, size=0.45 * text, color=INK)
