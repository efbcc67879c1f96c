"""The camera image, the local map and the global map of one place, side by side.

As in the figure of Paz et al. 2020: the local map stands with the vehicle's nose up, the
global one with north up, turned and cropped to nothing but the same place.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import shapely

from hdmap_tools.geometry.se3 import SE3
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
from hdmap_tools.view.overview import CameraPicture, Panel, class_colors, fitting_scale, map_legend
from hdmap_tools.view.page import LegendEntry, TitledPicture, compose
from hdmap_tools.view.palette import FAINT_INK, INK, PAPER, PATH

PANEL_PX: Final = 620

_VEHICLE_M: Final = (-1.0, -0.95, 3.8, 0.95)
"""(x0, y0, x1, y1) of a car around its rear axle: 4.8 m long, 1.9 m wide."""

_MARGIN_M: Final = 4.0


def local_and_global_picture(
    path: Path,
    image: CameraPicture | None,
    local: MapWindow,
    city_SE3_local: SE3,
    whole: MapWindow,
    city_SE3_ego: SE3,
    *,
    trajectory_xy: NDArrayFloat | None = None,
    title: str = "",
    panel_px: int = PANEL_PX,
    overwrite: bool = False,
) -> None:
    """Write one page: the camera image above, the local and the global map below.

    Args:
        path: PNG to write.
        image: What the camera saw there; None leaves it out.
        local: The local map's window, x ahead and y left.
        city_SE3_local: Where its frame is.
        whole: A window of the global map that holds the place; what lies outside is blank.
        city_SE3_ego: Where the vehicle is.
        trajectory_xy: (N, 2) or (N, 3) driven path, city metres.
        title: On top.
        panel_px: About the height of the maps, pixels.
        overwrite: Replace an existing file.

    Raises:
        ShapeError: If a pose or an image is not usable.
        OutputExistsError: If the file exists and overwrite is False.
    """
    ego_in_local = city_SE3_local.inverse() @ city_SE3_ego
    scale = fitting_scale(_turned(local.grid.bounds_m), local.grid.resolution_m, panel_px)
    corners = city_SE3_local.transform_from(_with_height(_corners(local.grid.bounds_m)))
    low, high = corners[:, :2].min(axis=0) - _MARGIN_M, corners[:, :2].max(axis=0) + _MARGIN_M
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    maps = [
        TitledPicture("local map", local_panel(local, ego_in_local, scale), "vehicle's nose up"),
        TitledPicture(
            "global map",
            global_panel(whole, bounds, scale, corners, city_SE3_ego, trajectory_xy),
            "north up; the frame is the local map's",
        ),
    ]
    legend = map_legend([Panel("", local), Panel("", whole)], has_path=False)
    legend += [
        LegendEntry("vehicle", PATH),
        LegendEntry("local map's edge", INK, "line", (7.0, 4.0)),
    ]
    photos = []
    if image is not None:
        width_px = sum(m.picture.shape[1] for m in maps)
        photos = [TitledPicture(image.title, _of_width(image.image, width_px))]
    write_png(compose([photos, maps], legend, title=title), path, overwrite=overwrite)


def local_panel(local: MapWindow, local_SE3_ego: SE3, pixels_per_metre: float) -> NDArrayByte:
    """The local map (height, width, 3) with x up and y to the left, and the vehicle on it."""
    x0, y0, x1, y1 = local.grid.bounds_m
    # Turned by a quarter: seen with x up, what was up (y) points left.
    viewport = Viewport((x0, y0, x1, y1), pixels_per_metre)
    upright = paint_cells(class_colors(local), local.grid, viewport, PAPER)
    picture = np.ascontiguousarray(np.rot90(upright))

    def to_pixels(xy_local: NDArrayFloat) -> NDArrayFloat:
        xy = np.asarray(xy_local, dtype=np.float64)
        return np.column_stack([(y1 - xy[:, 1]), (x1 - xy[:, 0])]) * pixels_per_metre

    outline = local_SE3_ego.transform_from(_with_height(_corners(_VEHICLE_M)))
    _draw_vehicle(picture, to_pixels(outline), to_pixels(_nose(local_SE3_ego)))
    draw_scale_bar(picture, pixels_per_metre)
    return picture


def global_panel(
    whole: MapWindow,
    bounds_m: tuple[float, float, float, float],
    pixels_per_metre: float,
    local_corners: NDArrayFloat,
    city_SE3_ego: SE3,
    trajectory_xy: NDArrayFloat | None = None,
) -> NDArrayByte:
    """A part of the global map (height, width, 3), north up, with vehicle and the local map's edge.

    Args:
        whole: The global map.
        bounds_m: (x0, y0, x1, y1) to show, city metres.
        pixels_per_metre: Scale.
        local_corners: (4, 3) corners of the local map, city frame.
        city_SE3_ego: Where the vehicle is.
        trajectory_xy: (N, 2) or (N, 3) driven path, city metres.
    """
    viewport = Viewport(bounds_m, pixels_per_metre)
    picture = paint_cells(class_colors(whole), whole.grid, viewport, PAPER)
    if trajectory_xy is not None and len(trajectory_xy):
        draw_lines(picture, [viewport.to_pixels(trajectory_xy)], FAINT_INK, 1.5, casing_px=1.0)
    edge = viewport.to_pixels(np.vstack([local_corners, local_corners[:1]]))
    draw_lines(picture, [edge], INK, 1.5, dash_px=(7.0, 4.0))
    outline = city_SE3_ego.transform_from(_with_height(_corners(_VEHICLE_M)))
    _draw_vehicle(picture, viewport.to_pixels(outline), viewport.to_pixels(_nose(city_SE3_ego)))
    draw_scale_bar(picture, pixels_per_metre)
    draw_north_arrow(picture)
    return picture


def _draw_vehicle(picture: NDArrayByte, outline: NDArrayFloat, nose: NDArrayFloat) -> None:
    """A box as large as a car, with a light wedge that points where it points."""
    body = shapely.Polygon(outline)
    fill(picture, shapely.buffer(body, 1.5, join_style="mitre"), PAPER)
    fill(picture, body, PATH, 0.85)
    fill(picture, shapely.Polygon(nose), PAPER)


def _nose(dst_SE3_ego: SE3) -> NDArrayFloat:
    """(3, 3) corners of a wedge in the front of the vehicle."""
    wedge = np.array([[3.4, 0.0], [1.9, 0.6], [1.9, -0.6]])
    return dst_SE3_ego.transform_from(_with_height(wedge))


def _corners(bounds_m: tuple[float, float, float, float]) -> NDArrayFloat:
    x0, y0, x1, y1 = bounds_m
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _with_height(xy: NDArrayFloat) -> NDArrayFloat:
    return np.column_stack([xy, np.zeros(len(xy))])


def _turned(bounds_m: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = bounds_m
    return y0, x0, y1, x1


def _of_width(image: NDArrayByte, width_px: int) -> NDArrayByte:
    """The image (height, width, 3), no wider than the maps below it and no taller than them."""
    import cv2

    height, width = image.shape[:2]
    scale = min(width_px / width, PANEL_PX / height)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=method), dtype=np.uint8)
