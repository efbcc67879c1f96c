"""Lidar points drawn into a picture, for a person to see whether the calibration is right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.errors import ConfigError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.types import NDArrayByte, NDArrayFloat, NDArrayInt
from hdmap_tools.view.canvas import put_text
from hdmap_tools.view.palette import INK, PAPER

_BAR_PX: Final = 40
_TICKS: Final = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)


@dataclass(frozen=True, eq=False)
class Overlay:
    """A picture with points on it.

    Attributes:
        picture: (h + legend, w, 3) uint8 RGB.
        num_drawn: Points that lie in the picture.
        num_points: Points given.
    """

    picture: NDArrayByte
    num_drawn: int
    num_points: int


def overlay_points(
    rgb: NDArrayByte,
    camera: PinholeCamera,
    points_ego: NDArrayFloat,
    *,
    max_range_m: float = 60.0,
    radius_px: int | None = None,
) -> Overlay:
    """Draw points in the colour of their distance from the camera, near ones on top.

    Nothing is hidden by what stands before it: the lidar sees over things that the camera
    does not, and points behind them show through.

    Args:
        rgb: (h, w, 3) uint8 of the camera's size; not changed.
        camera: Its calibration.
        points_ego: (N, 3) metres, ego frame when the picture was taken.
        max_range_m: Points further from the camera are left out, and the end of the colours.
        radius_px: Of a point; None follows from the picture's size.

    Raises:
        ShapeError: If the picture is not of the camera's size.
        ConfigError: If max_range_m is not positive.
    """
    if not (np.isfinite(max_range_m) and max_range_m > 0):
        raise ConfigError(f"max_range_m is {max_range_m}; expected a positive number of metres.")
    if rgb.shape != (camera.height_px, camera.width_px, 3) or rgb.dtype != np.uint8:
        raise ShapeError(
            f"Camera {camera.name} is calibrated for ({camera.height_px}, {camera.width_px}, 3) uint8, found "
            f"{rgb.shape} {rgb.dtype}."
        )
    seen = camera.project(points_ego)
    range_m = np.linalg.norm(points_ego - camera.ego_SE3_cam.translation, axis=1)
    is_drawn = seen.is_valid & (range_m <= max_range_m)
    order = np.argsort(-range_m[is_drawn], kind="stable")
    pixels = np.rint(seen.uv[is_drawn][order]).astype(np.int64)
    colors = _range_colors(_share(range_m[is_drawn][order], max_range_m))
    radius = max(round(camera.width_px / 640), 1) if radius_px is None else radius_px
    picture = rgb.copy()
    _stamp(picture, pixels, colors, radius)
    legend = _legend(camera.width_px, max_range_m)
    return Overlay(np.vstack([picture, legend]), int(is_drawn.sum()), len(points_ego))


def _stamp(picture: NDArrayByte, pixels: NDArrayInt, colors: NDArrayByte, radius: int) -> None:
    """Square dots; of several in one place the last one stays."""
    height, width = picture.shape[:2]
    side = np.arange(-radius, radius + 1)
    du, dv = (offsets.ravel() for offsets in np.meshgrid(side, side))
    # Dots one after the other, so that a later dot lies whole on an earlier one.
    u = (pixels[:, :1] + du).ravel()
    v = (pixels[:, 1:] + dv).ravel()
    is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    flat, of_dot = (v * width + u)[is_inside], np.repeat(np.arange(len(pixels)), len(du))[is_inside]
    # Numpy does not promise which of repeated indices wins: keep the last of each.
    places, last = np.unique(flat[::-1], return_index=True)
    picture.reshape(-1, 3)[places] = colors[of_dot[::-1][last]]


def _share(range_m: NDArrayFloat, max_range_m: float) -> NDArrayFloat:
    """Along the colours: the root, because most points are near."""
    return np.asarray(np.sqrt(np.clip(range_m / max_range_m, 0.0, 1.0)))


def _range_colors(share: NDArrayFloat) -> NDArrayByte:
    """(N, 3) uint8 RGB of shares 0..1 of the range: red is near, blue is far."""
    import cv2

    level = np.clip(np.round((1.0 - share) * 255), 0, 255).astype(np.uint8)
    if not len(level):
        return np.empty((0, 3), dtype=np.uint8)
    bgr = np.asarray(cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_TURBO))
    return np.ascontiguousarray(bgr.reshape(-1, 3)[:, ::-1])


def _legend(width_px: int, max_range_m: float) -> NDArrayByte:
    scale = float(np.clip(width_px / 900, 0.6, 2.0))
    height = round(_BAR_PX * scale)
    legend = np.empty((height, width_px, 3), dtype=np.uint8)
    legend[:] = PAPER
    margin = round(30 * scale)
    bar = legend[round(4 * scale) : round(16 * scale), margin : width_px - margin]
    if bar.shape[1] < 2:
        return legend
    bar[:] = _range_colors(np.linspace(0, 1, bar.shape[1]))[None]
    for share in _TICKS:
        at = margin + float(_share(np.array(share), 1.0)) * (bar.shape[1] - 1)
        text = f"{share * max_range_m:.3g} m"
        put_text(
            legend, text, (at, height - 6 * scale), size=0.45 * scale, color=INK, anchor="middle"
        )
    return legend
