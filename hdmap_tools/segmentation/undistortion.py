"""Networks see straight lines straight; label images stay those of the image as recorded.

Points are projected through the lens model into the recorded image (`PinholeCamera`), so
its pixels are what labels must belong to. A network that learned from ordinary
pictures is shown the rectified one instead, and each recorded pixel takes the label
of the rectified pixel that looks the same way.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import IGNORE_ID
from hdmap_tools.types import NDArrayByte, NDArrayFloat

MAX_MARGIN: Final = 0.25
"""The rectified picture goes beyond the recorded one by so much of its size on each side at
most: towards the rim of a wide lens it grows without bound, and shows ever less."""

_STEP_PX: Final = 8


class Rectification:
    """A distorted camera's way to the picture without distortion, and back.

    The rectified picture has the scale of the recorded one in its middle and is as
    large as it takes to show all of it, up to `MAX_MARGIN`.

    Args:
        camera: The camera.

    Attributes:
        camera: The same without distortion; its image is the rectified picture.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        width, height = camera.width_px, camera.height_px
        uv = _rectified_places(camera)
        known = np.asarray(np.isfinite(uv).all(axis=1))
        margin = np.array([width, height]) * MAX_MARGIN
        # Without a pixel that has a direction the picture is as large as recorded, and unknown.
        low = np.floor(np.min(uv[known], axis=0, initial=np.inf))
        high = np.ceil(np.max(uv[known], axis=0, initial=-np.inf))
        low = np.maximum(np.where(np.isfinite(low), low, 0), -margin.round())
        end = np.array([width - 1, height - 1])
        high = np.minimum(np.where(np.isfinite(high), high, end), end + margin.round())
        size = (high - low + 1).astype(int)
        self.camera = PinholeCamera(
            camera.name,
            int(size[0]),
            int(size[1]),
            camera.fx,
            camera.fy,
            camera.cx - float(low[0]),
            camera.cy - float(low[1]),
            camera.ego_SE3_cam,
        )
        self._source = _source_map(camera, self.camera)
        nearest = np.floor(np.where(known[:, None], uv, -1e6) - low + 0.5).astype(np.int64)
        inside = ((nearest >= 0) & (nearest < size)).all(axis=1)
        self._nearest = np.where(inside, nearest[:, 1] * size[0] + nearest[:, 0], 0)
        self._outside = ~inside
        self._shape = (height, width)

    def rectify(self, rgb: NDArrayByte, border: tuple[int, int, int] = (0, 0, 0)) -> NDArrayByte:
        """The rectified picture (h, w, 3) uint8 of a recorded image (height, width, 3) uint8.

        Args:
            rgb: The image.
            border: Colour where the recorded image does not reach.
        """
        import cv2

        rectified = cv2.remap(
            rgb,
            self._source,
            None,  # type: ignore[call-overload]
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=border,
        )
        return np.asarray(rectified, dtype=np.uint8)

    def to_recorded(self, labels: NDArrayByte) -> NDArrayByte:
        """The recorded image's labels (height, width) uint8 from those of the rectified picture.

        `IGNORE_ID` where the rectified picture does not reach.
        """
        recorded: NDArrayByte = labels.reshape(-1)[self._nearest]
        recorded[self._outside] = IGNORE_ID
        return recorded.reshape(self._shape)


def _rectified_places(camera: PinholeCamera) -> NDArrayFloat:
    """(height * width, 2): where each recorded pixel would be without distortion; NaN: nowhere.

    Solved for every eighth pixel and interpolated, which takes a fiftieth of the time and
    is off by some hundredths of a pixel.
    """
    width, height = camera.width_px, camera.height_px
    u = np.linspace(0, width - 1, -(-(width - 1) // _STEP_PX) + 1)
    v = np.linspace(0, height - 1, -(-(height - 1) // _STEP_PX) + 1)
    coarse = np.stack(np.meshgrid(u, v), axis=-1)
    # Rays have length one along the optical axis, so their x and y are the pixel's own.
    xy = camera.rays_ego(coarse.reshape(-1, 2)) @ camera.ego_SE3_cam.rotation
    places = xy[:, :2] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    fine = _interpolated(places.reshape(coarse.shape), height, 0)
    return _interpolated(fine, width, 1).reshape(-1, 2)


def _interpolated(values: NDArrayFloat, length: int, axis: int) -> NDArrayFloat:
    """Values on a grid from the first to the last of so many places along an axis, at each of them."""
    count = values.shape[axis]
    at = np.linspace(0, count - 1, length)
    low = np.minimum(at.astype(int), max(count - 2, 0))
    share = np.expand_dims(at - low, [a for a in range(values.ndim) if a != axis])
    first = values.take(low, axis)
    return np.asarray(first + share * (values.take(np.minimum(low + 1, count - 1), axis) - first))


def _source_map(recorded: PinholeCamera, rectified: PinholeCamera) -> NDArrayFloat:
    """(h, w, 2) float32: where in the recorded image each rectified pixel comes from."""
    u, v = np.meshgrid(np.arange(rectified.width_px), np.arange(rectified.height_px))
    x = (u.ravel() - rectified.cx) / rectified.fx
    y = (v.ravel() - rectified.cy) / rectified.fy
    directions = np.column_stack([x, y, np.ones(len(x))])

    uv = recorded.project(recorded.ego_SE3_cam.transform_from(directions)).uv
    # Pixels that the lens model reaches from nowhere lie far outside: they get the border.
    shape = (rectified.height_px, rectified.width_px, 2)
    return np.where(np.isfinite(uv), uv, -1e4).reshape(shape).astype(np.float32)
