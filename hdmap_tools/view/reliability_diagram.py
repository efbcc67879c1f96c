"""Confidence against accuracy, as a picture: what was claimed beside what was true."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import shapely

from hdmap_tools.compare.reliability import ReliabilityBin, ReliabilityCurve, ReliabilityReport
from hdmap_tools.types import NDArrayByte
from hdmap_tools.view.canvas import draw_lines, fill, put_text, write_png
from hdmap_tools.view.page import LegendEntry, TitledPicture, compose
from hdmap_tools.view.palette import AGREEMENT, FAINT_INK, INK, MISS, PAPER, RGB

_SIDE_PX: Final = 420
_LEFT_PX: Final = 58
_FOOT_PX: Final = 52
_COUNTS_PX: Final = 90
_GRID: Final[RGB] = (228, 230, 234)


def reliability_picture(report: ReliabilityReport, path: Path, *, overwrite: bool = False) -> None:
    """Write a PNG with the diagram before and after the temperature, side by side.

    Raises:
        OutputExistsError: If the file exists and overwrite is False.
    """
    panels = [
        TitledPicture(f"{name} (T = {temperature:.3g})", reliability_panel(curve), _figures(curve))
        for name, temperature, curve in (
            ("as read", report.temperature_before, report.before),
            ("fitted", report.temperature, report.after),
        )
    ]
    legend = [
        LegendEntry("share that is right", AGREEMENT),
        LegendEntry("gap to what was claimed", MISS),
        LegendEntry("share of cells", FAINT_INK),
    ]
    title = f"Reliability against {report.truth}: {report.before.num_cells} held-out cells"
    write_png(compose([panels], legend, title=title), path, overwrite=overwrite)


def reliability_panel(curve: ReliabilityCurve) -> NDArrayByte:
    """One diagram (height, width, 3): bars of accuracy over confidence, and where the cells are below."""
    height = _SIDE_PX + _COUNTS_PX + _FOOT_PX + 24
    picture = np.empty((height, _LEFT_PX + _SIDE_PX + 16, 3), dtype=np.uint8)
    picture[:] = PAPER
    top, base = 12, 12 + _SIDE_PX
    foot = base + 12 + _COUNTS_PX
    for tenth in range(0, 11, 2):
        at = tenth / 10 * _SIDE_PX
        _line(picture, (_LEFT_PX, base - at), (_LEFT_PX + _SIDE_PX, base - at), _GRID)
        _line(picture, (_LEFT_PX + at, top), (_LEFT_PX + at, foot), _GRID)
        label = f"{tenth / 10:.1f}"
        put_text(picture, label, (_LEFT_PX - 6, base - at + 4), size=0.4, anchor="right")
        put_text(picture, label, (_LEFT_PX + at, foot + 16), size=0.4, anchor="middle")
    put_text(picture, "right", (6, top + 14), size=0.4, color=FAINT_INK)
    put_text(picture, "cells", (6, foot - 4), size=0.4, color=FAINT_INK)
    middle = _LEFT_PX + _SIDE_PX / 2
    put_text(
        picture,
        "probability claimed",
        (middle, foot + 36),
        size=0.45,
        color=FAINT_INK,
        anchor="middle",
    )
    most = max(b.count for b in curve.bins) / curve.num_cells
    for one in curve.bins:
        _draw_bin(picture, one, base, foot, one.count / curve.num_cells / most)
    _line(picture, (_LEFT_PX, base), (_LEFT_PX + _SIDE_PX, top), INK, dash_px=(5.0, 4.0))
    _line(picture, (_LEFT_PX, base), (_LEFT_PX + _SIDE_PX, base), INK)
    _line(picture, (_LEFT_PX, foot), (_LEFT_PX + _SIDE_PX, foot), INK)
    put_text(
        picture, f"{most:.0%}", (_LEFT_PX - 6, foot - _COUNTS_PX + 10), size=0.4, anchor="right"
    )
    return picture


def _draw_bin(
    picture: NDArrayByte, one: ReliabilityBin, base: int, foot: int, share_of_most: float
) -> None:
    """A bar of what is right, the gap to what was claimed, and below how many cells it stands for."""
    middle = _LEFT_PX + one.confidence * _SIDE_PX
    half = _SIDE_PX / 40
    left, right = max(middle - half, _LEFT_PX), min(middle + half, _LEFT_PX + _SIDE_PX)
    right_y, claimed_y = base - one.accuracy * _SIDE_PX, base - one.confidence * _SIDE_PX
    fill(picture, shapely.box(left, right_y, right, base), AGREEMENT)
    if abs(right_y - claimed_y) > 0.5:
        low, high = sorted((right_y, claimed_y))
        fill(picture, shapely.box(left, low, right, high), MISS, 0.45)
    fill(picture, shapely.box(left, right_y - 1.5, right, right_y + 1.5), INK)
    tall = max(share_of_most * _COUNTS_PX, 1.0)
    fill(picture, shapely.box(left, foot - tall, right, foot), FAINT_INK)


def _line(
    picture: NDArrayByte,
    start: tuple[float, float],
    end: tuple[float, float],
    color: RGB,
    dash_px: tuple[float, float] | None = None,
) -> None:
    draw_lines(picture, [np.array([start, end], dtype=np.float64)], color, 1.0, dash_px=dash_px)


def _figures(curve: ReliabilityCurve) -> str:
    return f"ECE {curve.ece:.3f}   NLL {curve.nll:.3f}   Brier {curve.brier:.3f}   right {curve.accuracy:.3f}"
