"""Where in the picture the chessboard's corners were, and how well each view fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely

from hdmap_tools.calibration.intrinsics import (
    COVERAGE_CELLS,
    Intrinsics,
    View,
    coverage_counts,
)
from hdmap_tools.types import NDArrayByte
from hdmap_tools.view.canvas import fill, fitting_text, put_text
from hdmap_tools.view.page import LegendEntry, TitledPicture, compose
from hdmap_tools.view.palette import AGREEMENT, FAINT_INK, INK, MISS, PAPER, RGB

_WIDTH_PX: Final = 640
_FULL_COUNT: Final = 30
"""Corners in a cell from which on its colour does not change."""
_CELL: Final[RGB] = (150, 190, 235)
_EMPTY: Final[RGB] = (252, 226, 214)
_ROW_PX: Final = 22
_LABEL_PX: Final = 190
_BAR_PX: Final = 300
_DOT_PX: Final = 2.0


def coverage_picture(found: Intrinsics, views: Sequence[View]) -> NDArrayByte:
    """A page (h, w, 3) uint8 RGB: corners in the frame of the picture, and error bars of the views."""
    camera = found.camera
    title = f"{camera.name}: {len(views)} views, {found.rms_px:.3f} px RMS" + (
        "" if found.held_out_rms_px is None else f", {found.held_out_rms_px:.3f} px held out"
    )
    columns, rows = COVERAGE_CELLS
    panels = [
        TitledPicture(
            "corners in the picture",
            _corners_panel(found, views),
            f"{found.coverage:.0%} of {columns}x{rows} cells hold corners",
        ),
        TitledPicture("RMS error of each view", _views_panel(found), "pixels"),
    ]
    legend = [
        LegendEntry("no corner in the cell", _EMPTY),
        LegendEntry(f"{_FULL_COUNT} corners or more", _CELL),
        LegendEntry("fitted", AGREEMENT),
        LegendEntry("held out", MISS),
    ]
    return compose([panels], legend, title=title)


def _corners_panel(found: Intrinsics, views: Sequence[View]) -> NDArrayByte:
    width, height = found.camera.width_px, found.camera.height_px
    scale = _WIDTH_PX / width
    shape = (max(round(height * scale), 1), _WIDTH_PX)
    counts = coverage_counts(views, (width, height))
    share = np.minimum(counts / _FULL_COUNT, 1.0)[..., None]
    colors = PAPER + (np.array(_CELL) - PAPER) * share
    colors = np.where(counts[..., None] == 0, _EMPTY, colors)
    rows = np.arange(shape[0]) * counts.shape[0] // shape[0]
    columns = np.arange(shape[1]) * counts.shape[1] // shape[1]
    panel = np.round(colors).astype(np.uint8)[rows][:, columns]
    uv = (np.concatenate([view.uv for view in views]) + 0.5) * scale
    dots = shapely.union_all(shapely.buffer(shapely.points(uv), _DOT_PX, quad_segs=3))
    fill(panel, dots, INK)
    return np.ascontiguousarray(panel)


def _views_panel(found: Intrinsics) -> NDArrayByte:
    height = max(len(found.views) * _ROW_PX + 12, 60)
    panel = np.empty((height, _LABEL_PX + _BAR_PX + 70, 3), dtype=np.uint8)
    panel[:] = PAPER
    largest = max(max(view.rms_px, view.held_out_rms_px or 0.0) for view in found.views)
    per_px = _BAR_PX / max(largest, 1e-9)
    for k, view in enumerate(found.views):  # a view a line of text
        top = 8 + k * _ROW_PX
        name = fitting_text(view.name.rsplit("/", 1)[-1], _LABEL_PX - 12, 0.4)
        put_text(panel, name, (_LABEL_PX - 6, top + 12), size=0.4, anchor="right")
        bar = shapely.box(_LABEL_PX, top, _LABEL_PX + view.rms_px * per_px, top + 7)
        fill(panel, bar, AGREEMENT)
        if view.held_out_rms_px is not None:
            end = _LABEL_PX + view.held_out_rms_px * per_px
            fill(panel, shapely.box(_LABEL_PX, top + 8, end, top + 14), MISS)
        at = _LABEL_PX + max(view.rms_px, view.held_out_rms_px or 0.0) * per_px + 6
        put_text(panel, f"{view.rms_px:.3f}", (at, top + 11), size=0.38, color=FAINT_INK)
    return panel
