"""The map drawn back into a camera image, for a person to hold against the photo."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt
from hdmap_tools.view.canvas import draw_lines
from hdmap_tools.view.palette import class_color, stroke_of

NEAR_PLANE_M: Final = 0.5
"""Lines are cut this far in front of the camera: nearer, a centimetre is many pixels."""

_LINE_STEP_M: Final = 0.25
"""Lines are bent by the lens, so they are projected in pieces of this length."""

_HEIGHT_ITERATIONS: Final = 4
_HEIGHT_TOLERANCE_M: Final = 0.3


def project_window_into_image(
    window: MapWindow | None,
    vector_map: VectorMap | None,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    image: NDArrayByte,
    *,
    opacity: float = 0.4,
    max_range_m: float = 40.0,
    line_width_px: float | None = None,
) -> NDArrayByte:
    """Draw a map into a camera image, as seen from a pose.

    Nothing hides the map: it is drawn through vehicles too.

    Args:
        window: Cells to paint in transparent colour, at their own heights; None for none.
        vector_map: Elements to draw; None for none.
        camera: Calibration for the image's size.
        city_SE3_ego: Pose of the vehicle when the image was taken.
        image: (height, width, 3) uint8 RGB; not changed.
        opacity: Of the paint, 0..1.
        max_range_m: Nothing further away than this is drawn.
        line_width_px: Of lines; None follows from the image's size.

    Returns:
        A new picture of the image's size.

    Raises:
        ShapeError: If the image is not of the camera's size.
    """
    image = np.asarray(image)
    if image.shape != (camera.height_px, camera.width_px, 3) or image.dtype != np.uint8:
        raise ShapeError(
            f"Camera {camera.name} is calibrated for ({camera.height_px}, {camera.width_px}, 3) uint8, found "
            f"{image.shape} {image.dtype}; use camera.scaled for a resampled image."
        )
    picture = image.copy()
    if window is not None:
        _paint_cells(picture, window, camera, city_SE3_ego, opacity, max_range_m)
    if vector_map is not None:
        width = line_width_px or max(camera.width_px / 400.0, 1.0)
        _draw_vectors(picture, vector_map, camera, city_SE3_ego, width, max_range_m)
    return picture


def _paint_cells(
    picture: NDArrayByte,
    window: MapWindow,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    opacity: float,
    max_range_m: float,
) -> None:
    """Blend the class colour of the ground cell that each pixel looks at."""
    if not window.is_known.any():
        return
    rows, cols = np.indices((camera.height_px, camera.width_px), dtype=np.float64)
    rays_city = camera.rays_ego(np.column_stack([cols.ravel(), rows.ravel()]))
    rays_city = rays_city @ city_SE3_ego.rotation.T
    eye = city_SE3_ego.transform_from(camera.ego_SE3_cam.translation[None])[0]
    pixels, cells = _ground_cells(window, eye, rays_city, max_range_m)
    best = np.nan_to_num(window.dataset["posterior"].values, nan=-1.0).argmax(axis=0)
    colors = np.array([class_color(c) for c in window.classes], dtype=np.float64)
    flat = picture.reshape(-1, 3)
    paint = colors[best.ravel()[cells]]
    flat[pixels] = np.round(flat[pixels] * (1 - opacity) + paint * opacity).astype(np.uint8)


def _ground_cells(
    window: MapWindow, eye: NDArrayFloat, rays: NDArrayFloat, max_range_m: float
) -> tuple[NDArrayInt, NDArrayInt]:
    """Which rays (N, 3) from the eye meet a known cell, and its flat index.

    The ground is a height for each cell: meet a level plane, look up the height there,
    meet the plane of that height, and so on; a ray whose height does not settle is dropped.
    """
    height = _height_everywhere(window)
    rows, cols = window.grid.shape
    highest = float(height.max())
    # Rays that pass the highest ground beyond the range meet all ground beyond it.
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (min(highest, eye[2]) - eye[2]) / rays[:, 2]
        reach = along * np.hypot(rays[:, 0], rays[:, 1])
    pixels = np.flatnonzero((rays[:, 2] < 0) & (reach <= max_range_m))
    rays = rays[pixels]
    slope = rays[:, :2] / rays[:, 2:]
    z = np.full(len(rays), float(np.median(height)))
    for _ in range(_HEIGHT_ITERATIONS):
        xy = eye[:2] + (z - eye[2])[:, None] * slope
        at = np.floor(np.clip(xy / window.grid.resolution_m, -1e9, 1e9)).astype(np.int64)
        at -= (window.grid.x_min, window.grid.y_min)
        inside = ((at >= 0) & (at < (cols, rows))).all(axis=1)
        cells = np.clip(at[:, 1], 0, rows - 1) * cols + np.clip(at[:, 0], 0, cols - 1)
        used, z = z, height.ravel()[cells]
        if np.abs(z - used).max(initial=0.0) < 1e-3:
            break
    hit = inside & (used < eye[2]) & (np.abs(z - used) < _HEIGHT_TOLERANCE_M)
    hit &= ((xy - eye[:2]) ** 2).sum(axis=1) <= max_range_m**2
    hit &= window.is_known.ravel()[cells]
    return pixels[hit], cells[hit]


def _height_everywhere(window: MapWindow) -> NDArrayFloat:
    """(y, x) ground height; cells without one take the nearest cell's; 0 when none has one."""
    from scipy.ndimage import distance_transform_edt

    height = np.asarray(window.layer("height"), dtype=np.float64)
    missing = ~np.isfinite(height)
    if missing.all():
        return np.zeros(height.shape)
    if not missing.any():
        return height
    row, col = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(height[row, col])


def _draw_vectors(
    picture: NDArrayByte,
    vector_map: VectorMap,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    width_px: float,
    max_range_m: float,
) -> None:
    ego_SE3_city = city_SE3_ego.inverse()
    for element in vector_map:
        stroke = stroke_of(element)
        geometry = element.geometry
        rings = (
            (geometry.exterior, *geometry.interiors)
            if element.geometry_type == "Polygon"
            else (geometry,)
        )
        lines = [
            line
            for ring in rings
            for line in project_line(
                ego_SE3_city.transform_from(shapely.get_coordinates(ring, include_z=True)),
                camera,
                max_range_m,
            )
        ]
        draw_lines(
            picture,
            lines,
            stroke.color,
            width_px * stroke.width_px / 2.5,
            casing_px=width_px * stroke.casing_px / 2.5,
        )


def project_line(
    points_ego: NDArrayFloat, camera: PinholeCamera, max_range_m: float = 40.0
) -> list[NDArrayFloat]:
    """Project a line (N, 3), ego frame, into the image, cut at the near plane and the range.

    Returns:
        Pieces (M, 2) in continuous pixels: the first pixel covers 0..1, so these are
        image coordinates plus one half. They may leave the image.
    """
    if len(points_ego) < 2:
        return []
    points = _densified(points_ego)
    cam_SE3_ego = camera.ego_SE3_cam.inverse()
    depth = cam_SE3_ego.transform_from(points)[:, 2] - NEAR_PLANE_M
    pieces: list[list[NDArrayFloat]] = [[]]
    for k, point in enumerate(points):
        if k and (depth[k] > 0) != (depth[k - 1] > 0):
            part = depth[k - 1] / (depth[k - 1] - depth[k])
            pieces[-1].append(points[k - 1] + part * (point - points[k - 1]))
            if depth[k] <= 0:
                pieces.append([])
        if depth[k] > 0:
            pieces[-1].append(point)
    result = []
    for piece in pieces:
        if len(piece) >= 2:
            result += _projected_runs(np.array(piece), camera, max_range_m)
    return result


def _densified(points: NDArrayFloat) -> NDArrayFloat:
    """The line with vertices at most _LINE_STEP_M apart; its own vertices stay."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    count = np.maximum(np.ceil(steps / _LINE_STEP_M).astype(np.int64), 1)
    knots = np.concatenate([[0], np.cumsum(count)])
    at = np.interp(np.arange(knots[-1] + 1), knots, np.arange(len(points)))
    whole = np.arange(len(points))
    return np.column_stack([np.interp(at, whole, points[:, k]) for k in range(points.shape[1])])


def _projected_runs(
    points: NDArrayFloat, camera: PinholeCamera, max_range_m: float
) -> list[NDArrayFloat]:
    """Runs of consecutive points that are within range and the lens model."""
    uv = camera.project(points).uv + 0.5
    in_model = _is_in_lens_model(points, camera)
    good = in_model & np.isfinite(uv).all(axis=1)
    eye = camera.ego_SE3_cam.translation[:2]
    good &= np.linalg.norm(points[:, :2] - eye, axis=1) <= max_range_m
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [uv[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]


def _is_in_lens_model(points: NDArrayFloat, camera: PinholeCamera) -> NDArrayBool:
    """Points whose pixel, taken back, looks at the point again; beyond the model it folds elsewhere."""
    if not camera.is_distorted:
        return np.ones(len(points), dtype=bool)
    projection = camera.project(points)
    rays = camera.rays_ego(np.nan_to_num(projection.uv))
    back = camera.ego_SE3_cam.translation + rays * projection.depth_m[:, None]
    return np.asarray(np.linalg.norm(back - points, axis=1) < 0.01 * projection.depth_m)
