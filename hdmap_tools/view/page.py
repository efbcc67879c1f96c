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
    """Put rows of pictures, each row centred, over a legend on one page.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    rows = [row for row in rows if row]
    widths = [sum(p.picture.shape[1] for p in row) + _MARGIN_PX * (len(row) + 1) for row in rows]
    width = max([min_width_px, *widths])
    heights = [max(p.picture.shape[0] for p in row) + _CAPTION_PX + _MARGIN_PX for row in rows]
    lines = _legend_lines(legend, width - 2 * _MARGIN_PX)
    top = _MARGIN_PX + (_TITLE_PX if title else 0)
    height = top + sum(heights) + len(lines) * _LEGEND_ROW_PX + (_MARGIN_PX if lines else 0)
    page = np.empty((height, width, 3), dtype=np.uint8)
    page[:] = PAGE
    if title:
        text = fitting_text(title, width - 2 * _MARGIN_PX, 0.75, bold=True)
        put_text(page, text, (_MARGIN_PX, _MARGIN_PX + 16), size=0.75, bold=True)
    for row, row_width, row_height in zip(rows, widths, heights, strict=True):
        left = (width - row_width) // 2 + _MARGIN_PX
        for item in row:
            _place(page, item, left, top)
            left += item.picture.shape[1] + _MARGIN_PX
        top += row_height
    for line in lines:
        left = _MARGIN_PX
        for entry, entry_width in line:
            _draw_entry(page, entry, left, top)
            left += entry_width
        top += _LEGEND_ROW_PX
    return page


def _place(page: NDArrayByte, item: TitledPicture, left: int, top: int) -> None:
    height, width = item.picture.shape[:2]
    title = fitting_text(item.title, width, 0.55, bold=True)
    put_text(page, title, (left, top + 18), size=0.55, bold=True)
    used = text_width(title, 0.55, bold=True) + 14
    if item.note and width - used > 60:
        note = fitting_text(item.note, width - used, 0.45)
        put_text(page, note, (left + used, top + 18), size=0.45, color=FAINT_INK)
    top += _CAPTION_PX
    page[top - 1 : top + height + 1, left - 1 : left + width + 1] = (190, 194, 200)
    page[top : top + height, left : left + width] = item.picture


def _legend_lines(legend: Sequence[LegendEntry], width: int) -> list[list[tuple[LegendEntry, int]]]:
    lines: list[list[tuple[LegendEntry, int]]] = []
    used = width + 1
    for entry in legend:
        needed = 34 + text_width(entry.name, 0.45) + 20
        if used + needed > width:
            lines.append([])
            used = 0
        lines[-1].append((entry, needed))
        used += needed
    return lines


def _draw_entry(page: NDArrayByte, entry: LegendEntry, left: int, top: int) -> None:
    middle = top + 9.0
    if entry.kind == "area":
        fill(page, shapely.box(left, middle - 7, left + 26, middle + 7), FAINT_INK)
        fill(page, shapely.box(left + 1, middle - 6, left + 25, middle + 6), entry.color)
    else:
        fill(page, shapely.box(left, middle - 7, left + 26, middle + 7), PAPER)
        line = np.array([(left + 1.0, middle), (left + 25.0, middle)])
        draw_lines(page, [line], entry.color, entry.width_px, dash_px=entry.dash_px)
        if entry.kind == "arrow":
            tip = [(left + 24, middle), (left + 12, middle - 6), (left + 12, middle + 6)]
            fill(page, shapely.Polygon(tip), entry.color)
    put_text(page, entry.name, (left + 34, middle + 5), size=0.45, color=INK)
