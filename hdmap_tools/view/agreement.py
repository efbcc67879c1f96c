"""Where a map agrees with a reference, what it misses and what it makes up."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdmap_tools.compare.raster import GroupScore, RasterComparison, predicted_cells
from hdmap_tools.compare.reference import Reference, ReferenceGroup
from hdmap_tools.errors import ShapeError
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat
from hdmap_tools.view.canvas import (
    Viewport,
    draw_lines,
    draw_north_arrow,
    draw_scale_bar,
    paint_cells,
    write_png,
)
from hdmap_tools.view.overview import fitting_scale, known_bounds
from hdmap_tools.view.page import LegendEntry, TitledPicture, compose
from hdmap_tools.view.palette import (
    AGREEMENT,
    BOTH_NEGATIVE,
    FALSE_ALARM,
    MISS,
    NOT_OBSERVED,
    OUTSIDE,
    PATH,
    TRUTH_NOT_OBSERVED,
)


def agreement_colors(
    window: MapWindow, reference: Reference, group: ReferenceGroup, compared: NDArrayBool
) -> NDArrayByte:
    """(y, x, 3) RGB of one group: agreement, miss, false alarm, neither, or not compared."""
    predicted = predicted_cells(window, group)
    colors = np.empty((*window.grid.shape, 3), dtype=np.uint8)
    colors[:] = OUTSIDE
    colors[reference.is_covered] = NOT_OBSERVED
    colors[reference.is_covered & group.truth] = TRUTH_NOT_OBSERVED
    colors[compared] = BOTH_NEGATIVE
    colors[compared & predicted & group.truth] = AGREEMENT
    colors[compared & predicted & ~group.truth] = FALSE_ALARM
    colors[compared & ~predicted & group.truth] = MISS
    return colors


def agreement_picture(
    window: MapWindow,
    reference: Reference,
    comparison: RasterComparison,
    path: Path,
    *,
    compared: NDArrayBool | None = None,
    trajectory_xy: NDArrayFloat | None = None,
    bounds_m: tuple[float, float, float, float] | None = None,
    title: str = "",
    panel_px: int = 800,
    overwrite: bool = False,
) -> None:
    """Write a PNG, north up, with one map for each group of the reference.

    Args:
        window: The map.
        reference: What it was compared with.
        comparison: The figures, from `compare_raster` on these two.
        path: PNG to write.
        compared: (y, x) bool; only needed when the comparison was read from a file.
        trajectory_xy: (N, 2) or (N, 3) driven path, city metres.
        bounds_m: What to show, (x0, y0, x1, y1); None shows all cells with evidence.
        title: On top; None names the reference.
        panel_px: About the largest side of a map, pixels.
        overwrite: Replace an existing file.

    Raises:
        ShapeError: If the compared cells are not known or do not fit.
        OutputExistsError: If the file exists and overwrite is False.
    """
    cells = comparison.compared if compared is None else compared
    if cells is None or cells.shape != window.grid.shape:
        raise ShapeError(
            f"The compared cells must be bool {window.grid.shape}, found "
            f"{None if cells is None else cells.shape}; a comparison read from a file holds none: pass compared."
        )
    if reference.grid.shape != window.grid.shape:
        raise ShapeError(
            f"The reference is {reference.grid.shape} cells and the map {window.grid.shape}."
        )
    bounds = bounds_m or known_bounds([window])
    scale = fitting_scale(bounds, window.grid.resolution_m, panel_px)
    viewport = Viewport(bounds, scale)
    maps = []
    for group in reference.groups:
        picture = paint_cells(
            agreement_colors(window, reference, group, cells), window.grid, viewport, OUTSIDE
        )
        if trajectory_xy is not None and len(trajectory_xy):
            draw_lines(picture, [viewport.to_pixels(trajectory_xy)], PATH, 1.5, casing_px=1.0)
        draw_scale_bar(picture, scale)
        draw_north_arrow(picture)
        maps.append(
            TitledPicture(
                group.name.replace("_", " "), picture, _figures(comparison.groups[group.name])
            )
        )
    legend = [
        LegendEntry("agreement", AGREEMENT),
        LegendEntry("miss (only the reference)", MISS),
        LegendEntry("false alarm (only the map)", FALSE_ALARM),
        LegendEntry("neither", BOTH_NEGATIVE),
        LegendEntry("not observed, or out of range", NOT_OBSERVED),
        LegendEntry("reference there", TRUTH_NOT_OBSERVED),
    ]
    columns = 2 if len(maps) in (2, 4) else 3
    rows = [maps[i : i + columns] for i in range(0, len(maps), columns)]
    heading = (
        title or f"Compared with {comparison.reference}: {comparison.area_m2:.0f} square metres"
    )
    write_png(compose(rows, legend, title=heading), path, overwrite=overwrite)


def _figures(score: GroupScore) -> str:
    shown = {"IoU": score.iou, "precision": score.precision, "recall": score.recall}
    return "   ".join(f"{n} {'-' if v is None else f'{v:.3f}'}" for n, v in shown.items())
