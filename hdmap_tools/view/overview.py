"""The picture a person looks at first: the map's classes, the vectors on them, the drive's path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import shapely

from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayByte, NDArrayFloat
from hdmap_tools.view.canvas import (
    Viewport,
    draw_lines,
    draw_north_arrow,
    draw_scale_bar,
    fill,
    paint_cells,
    write_png,
)
from hdmap_tools.view.page import LegendEntry, TitledPicture, compose
from hdmap_tools.view.palette import PAPER, PATH, class_color, stroke_of

PANEL_PX: Final = 900
"""About the size of a map: two side by side make a page of at most 2400 pixels."""

_MAPS_A_ROW: Final = 2
_MARGIN_M: Final = 2.0
_LARGER_AT_MOST: Final = 1.3
_PALEST: Final = 0.4
"""Share of a class's colour left in a cell that knows nothing more than the prior."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One map in an overview.

    Attributes:
        title: Above it, for example ``sparse``.
        window: Its cells.
        vector_map: Drawn over them, in the window's frame.
        note: Beside the title.
    """

    title: str
    window: MapWindow
    vector_map: VectorMap | None = None
    note: str = ""

    def __post_init__(self) -> None:
        if self.vector_map is not None:
            self.window.frame.require_same(self.vector_map.frame)


@dataclass(frozen=True, eq=False)
class CameraPicture:
    """A camera image for an overview, (height, width, 3) uint8 **RGB**."""

    title: str
    image: NDArrayByte


def class_colors(window: MapWindow) -> NDArrayByte:
    """(y, x, 3) RGB of the most probable class, paler where it is less sure; white where unknown."""
    posterior = window.dataset["posterior"].values
    known = np.isfinite(posterior).all(axis=0)
    filled = np.nan_to_num(posterior, nan=0.0)
    table = np.array([class_color(c) for c in window.classes], dtype=np.float64)
    chance = 1.0 / len(window.classes)
    sure = np.clip((filled.max(axis=0) - chance) / (1.0 - chance), 0.0, 1.0)
    share = (_PALEST + (1.0 - _PALEST) * sure)[..., None]
    colors = table[filled.argmax(axis=0)] * share + np.array(PAPER) * (1.0 - share)
    colors[~known] = PAPER
    return np.asarray(np.round(colors), dtype=np.uint8)


def render_panel(
    panel: Panel,
    bounds_m: tuple[float, float, float, float],
    pixels_per_metre: float,
    *,
    trajectory_xy: NDArrayFloat | None = None,
    city_SE3_ego: SE3 | None = None,
) -> NDArrayByte:
    """Draw one map, north up.

    Args:
        panel: What to draw.
        bounds_m: (x0, y0, x1, y1), city metres.
        pixels_per_metre: Scale.
        trajectory_xy: (N, 2) or (N, 3) driven path, city metres.
        city_SE3_ego: Where to put the arrow of the vehicle.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    viewport = Viewport(bounds_m, pixels_per_metre)
    picture = paint_cells(class_colors(panel.window), panel.window.grid, viewport, PAPER)
    if panel.vector_map is not None:
        draw_elements(picture, panel.vector_map, viewport)
    if trajectory_xy is not None and len(trajectory_xy):
        path = viewport.to_pixels(np.asarray(trajectory_xy, dtype=np.float64))
        path = path[np.isfinite(path).all(axis=1)]
        draw_lines(picture, [path], PATH, 1.5, casing_px=1.0)
    if city_SE3_ego is not None:
        _draw_ego(picture, city_SE3_ego, viewport)
    draw_scale_bar(picture, pixels_per_metre)
    draw_north_arrow(picture)
    return picture


def draw_elements(picture: NDArrayByte, vector_map: VectorMap, viewport: Viewport) -> None:
    """Draw map elements into a north-up picture, in place; areas first, then lines."""
    for element in sorted(vector_map, key=_drawing_order):
        stroke = stroke_of(element)
        lines = [viewport.to_pixels(c) for c in _coordinates(element)]
        if element.geometry_type == "Polygon" and stroke.fill > 0:
            fill(picture, shapely.Polygon(lines[0], lines[1:]), stroke.color, stroke.fill)
        draw_lines(
            picture,
            lines,
            stroke.color,
            stroke.width_px,
            dash_px=stroke.dash_px,
            casing_px=stroke.casing_px,
            opacity=stroke.opacity,
        )


def overview_picture(
    path: Path,
    panels: Sequence[Panel],
    *,
    images: Sequence[CameraPicture] = (),
    trajectory_xy: NDArrayFloat | None = None,
    city_SE3_ego: SE3 | None = None,
    bounds_m: tuple[float, float, float, float] | None = None,
    title: str = "",
    panel_px: int = PANEL_PX,
    image_height_px: int | None = None,
    overwrite: bool = False,
) -> None:
    """Write one page: camera images above, maps two a row below, legend at the foot.

    All maps are drawn over the same ground at the same scale.

    Args:
        path: PNG to write.
        panels: At least one map.
        images: Camera images, for a person to hold against the maps.
        trajectory_xy: (N, 2) or (N, 3) driven path, city metres.
        city_SE3_ego: Where to put the arrow of the vehicle.
        bounds_m: What to show; None shows all cells with evidence.
        title: On top.
        panel_px: About the largest side of a map, pixels.
        image_height_px: Height of the images, pixels; None makes them as wide as the maps.
        overwrite: Replace an existing file.

    Raises:
        ShapeError: If there is no panel, or an image is not RGB uint8.
        CRSMismatchError: If the maps are in different frames.
        OutputExistsError: If the file exists and overwrite is False.
    """
    page = overview_page(
        panels,
        images=images,
        trajectory_xy=trajectory_xy,
        city_SE3_ego=city_SE3_ego,
        bounds_m=bounds_m,
        title=title,
        panel_px=panel_px,
        image_height_px=image_height_px,
    )
    write_png(page, path, overwrite=overwrite)


def overview_page(
    panels: Sequence[Panel],
    *,
    images: Sequence[CameraPicture] = (),
    trajectory_xy: NDArrayFloat | None = None,
    city_SE3_ego: SE3 | None = None,
    bounds_m: tuple[float, float, float, float] | None = None,
    title: str = "",
    panel_px: int = PANEL_PX,
    image_height_px: int | None = None,
) -> NDArrayByte:
    """The page of `overview_picture` as (height, width, 3) uint8 RGB."""
    if not panels:
        raise ShapeError("An overview needs at least one map, found none.")
    for panel in panels[1:]:
        panels[0].window.frame.require_same(panel.window.frame)
    bounds = bounds_m or known_bounds([panel.window for panel in panels])
    scale = fitting_scale(bounds, panels[0].window.grid.resolution_m, panel_px)
    maps = [
        TitledPicture(
            panel.title,
            render_panel(
                panel, bounds, scale, trajectory_xy=trajectory_xy, city_SE3_ego=city_SE3_ego
            ),
            panel.note,
        )
        for panel in panels
    ]
    map_width_px = sum(m.picture.shape[1] for m in maps[:_MAPS_A_ROW])
    height_px = image_height_px or _image_height(images, map_width_px)
    photos = [TitledPicture(i.title, _resized(i, height_px)) for i in images]
    legend = map_legend(panels, has_path=trajectory_xy is not None or city_SE3_ego is not None)
    rows = [maps[i : i + _MAPS_A_ROW] for i in range(0, len(maps), _MAPS_A_ROW)]
    return compose([photos, *rows], legend, title=title)


def known_bounds(windows: Sequence[MapWindow]) -> tuple[float, float, float, float]:
    """Bounds (x0, y0, x1, y1) of all cells with evidence and a margin; of the grids when there are none."""
    boxes = []
    for window in windows:
        rows, cols = np.nonzero(window.is_known)
        if len(rows):
            r, grid = window.grid.resolution_m, window.grid
            boxes.append(
                (
                    (grid.x_min + cols.min()) * r - _MARGIN_M,
                    (grid.y_min + rows.min()) * r - _MARGIN_M,
                    (grid.x_min + cols.max() + 1) * r + _MARGIN_M,
                    (grid.y_min + rows.max() + 1) * r + _MARGIN_M,
                )
            )
    if not boxes:
        boxes = [w.grid.bounds_m for w in windows if min(w.grid.shape) > 0] or [
            (0.0, 0.0, 10.0, 10.0)
        ]
    low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
    return float(low[0]), float(low[1]), float(high[2]), float(high[3])


def fitting_scale(
    bounds_m: tuple[float, float, float, float], resolution_m: float, about_px: int
) -> float:
    """Pixels per metre that about fit about_px: a whole number of pixels a cell, unless cells are smaller.

    A whole number may make the picture larger than asked, by `_LARGER_AT_MOST`.
    """
    x0, y0, x1, y1 = bounds_m
    largest = about_px / max(x1 - x0, y1 - y0)
    cell_px = largest * resolution_m
    whole = np.ceil(cell_px) if np.ceil(cell_px) <= cell_px * _LARGER_AT_MOST else np.floor(cell_px)
    return float(whole / resolution_m if whole >= 1 else largest)


def map_legend(panels: Sequence[Panel], has_path: bool) -> list[LegendEntry]:
    """Entries for the classes and elements that the panels show."""
    classes = list(dict.fromkeys(c for panel in panels for c in panel.window.classes))
    entries = [LegendEntry(c.replace("_", " "), class_color(c)) for c in classes]
    entries.append(LegendEntry("unknown", PAPER))
    strokes = dict.fromkeys(
        stroke_of(e) for panel in panels for e in sorted(panel.vector_map or (), key=_drawing_order)
    )
    entries += [LegendEntry(s.name, s.color, "line", s.dash_px, s.width_px) for s in strokes]
    if has_path:
        entries.append(LegendEntry("vehicle and its path", PATH, "arrow"))
    return entries


def _draw_ego(picture: NDArrayByte, city_SE3_ego: SE3, viewport: Viewport) -> None:
    """A triangle that points where the vehicle points, 4 m long but at least 16 pixels."""
    length_m = max(4.0, 16.0 / viewport.pixels_per_metre)
    shape = np.array([[0.6, 0.0], [-0.4, 0.3], [-0.2, 0.0], [-0.4, -0.3]]) * length_m
    corners = city_SE3_ego.transform_from(np.column_stack([shape, np.zeros(4)]))
    arrow = shapely.Polygon(viewport.to_pixels(corners))
    fill(picture, shapely.buffer(arrow, 1.5), PAPER)
    fill(picture, arrow, PATH)


def _drawing_order(element: MapElement) -> tuple[bool, str, str]:
    return element.geometry_type != "Polygon", stroke_of(element).name, element.id


def _coordinates(element: MapElement) -> list[NDArrayFloat]:
    geometry = element.geometry
    if element.geometry_type == "Polygon":
        return [shapely.get_coordinates(r) for r in (geometry.exterior, *geometry.interiors)]
    return [shapely.get_coordinates(geometry)]


def _image_height(images: Sequence[CameraPicture], width_px: int) -> int:
    """Height at which all images side by side are so wide, within reason."""
    proportion = sum(
        np.shape(i.image)[1] / np.shape(i.image)[0] for i in images if np.size(i.image)
    )
    return int(np.clip(width_px / max(proportion, 0.1), 240, 720))


def _resized(camera: CameraPicture, height_px: int) -> NDArrayByte:
    import cv2

    image = np.asarray(camera.image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise ShapeError(
            f"Image {camera.title!r} must be (height, width, 3) uint8 RGB, found {image.shape} {image.dtype}."
        )
    width_px = max(round(image.shape[1] * height_px / image.shape[0]), 1)
    shrinks = height_px < image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(
        cv2.resize(image, (width_px, height_px), interpolation=method), dtype=np.uint8
    )
