"""A street with known truth: a rolling ground, a box on it, a camera and a lidar that see them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat

Field = Callable[[NDArrayFloat, NDArrayFloat], NDArrayAny]
"""A value at city positions x, y (arrays of one shape), metres."""

# Camera axes (x right, y down, z ahead) in a frame with x ahead, y left, z up.
LOOKING_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera(
    height_m: float = 1.5,
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> PinholeCamera:
    """A front camera of 640 x 400 pixels, 1.7 m ahead of the ego origin."""
    mount = SE3(LOOKING_AHEAD, np.array([1.7, 0.1, height_m]))
    return PinholeCamera("FRONT", 640, 400, 470.0, 476.0, 314.3, 187.7, mount, distortion)


@dataclass(frozen=True)
class Street:
    """Ground z = height(x, y) with labels label(x, y) in the city frame; an optional box.

    Attributes:
        height: City ground height, metres; steps of less than a ray's tolerance.
        label: City ground label.
        box: (x0, y0, x1, y1, top) of a box that stands on the ground, label 0.
    """

    height: Field
    label: Field
    box: tuple[float, float, float, float, float] | None = None

    def cast(
        self, origin: NDArrayFloat, rays: NDArrayFloat, max_t: float = 120.0
    ) -> tuple[NDArrayFloat, NDArrayBool]:
        """Nearest hit along rays (N, 3): parameter t, and whether it is the box; inf without one."""
        t = np.zeros(len(rays))
        # The ground is a gentle height field (slopes below 0.2): march, then settle.
        closing = -rays[:, 2] + 0.2 * np.linalg.norm(rays[:, :2], axis=1)
        down = closing > 1e-3
        for _ in range(80):
            p = origin + t[:, None] * rays
            above = p[:, 2] - self.height(p[:, 0], p[:, 1])
            t = np.where(down, np.clip(t + above / np.where(down, closing, 1.0), 0.0, max_t), max_t)
        p = origin + t[:, None] * rays
        hit = np.abs(p[:, 2] - self.height(p[:, 0], p[:, 1])) < 1e-3
        t = np.where(hit & (t > 0) & (t < max_t), t, np.inf)
        is_box = np.zeros(len(rays), dtype=bool)
        if self.box is not None:
            x0, y0, x1, y1, top = self.box
            low, high = np.array([x0, y0, -50.0]), np.array([x1, y1, top])
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = (low - origin) / rays, (high - origin) / rays
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            box_t = np.where((near <= far) & (near > 0), near, np.inf)
            is_box = box_t < t
            t = np.minimum(t, box_t)
        return t, is_box

    def label_image(self, cam: PinholeCamera, city_SE3_ego: SE3) -> NDArrayByte:
        """The true label (height, width) of each pixel; 0 for the box and the sky."""
        v, u = np.mgrid[0 : cam.height_px, 0 : cam.width_px]
        rays = cam.rays_ego(np.column_stack([u.ravel(), v.ravel()])) @ city_SE3_ego.rotation.T
        eye = city_SE3_ego.transform_from(cam.ego_SE3_cam.translation[None])[0]
        t, is_box = self.cast(eye, rays)
        p = eye + np.where(np.isfinite(t), t, 0.0)[:, None] * rays
        labels = np.where(np.isfinite(t) & ~is_box, self.label(p[:, 0], p[:, 1]), 0)
        return labels.reshape(cam.height_px, cam.width_px).astype(np.uint8)

    def sweep(self, city_SE3_ego: SE3, rings: int = 32, lidar_height_m: float = 1.9) -> Sweep:
        """A noise-free sweep of a still vehicle; paint (label 3) has intensity 90, the rest 20."""
        elevation = np.deg2rad(np.linspace(-30.0, 10.0, rings))
        azimuth = np.deg2rad(np.arange(0.0, 360.0, 0.33))
        e, a = (g.ravel() for g in np.meshgrid(elevation, azimuth, indexing="ij"))
        rays_ego = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        eye_ego = np.array([0.9, 0.0, lidar_height_m])
        rays = rays_ego @ city_SE3_ego.rotation.T
        t, is_box = self.cast(city_SE3_ego.transform_from(eye_ego[None])[0], rays)
        hit = np.isfinite(t)
        points = eye_ego + t[hit, None] * rays_ego[hit]
        ring = np.repeat(np.arange(rings), len(azimuth))[hit]
        points_city = city_SE3_ego.transform_from(points)
        is_paint = (self.label(points_city[:, 0], points_city[:, 1]) == 3) & ~is_box[hit]
        intensity = np.where(is_paint, 90, 20).astype(np.uint8)
        return Sweep(0, points, intensity, ring.astype(np.uint8))


def flat(x: NDArrayFloat, y: NDArrayFloat) -> NDArrayFloat:
    """Level ground at height 0."""
    return np.zeros(np.broadcast(x, y).shape)


def slope(x: NDArrayFloat, y: NDArrayFloat) -> NDArrayFloat:
    """Climbs 4 % ahead after 5 m, with a 2 % crown."""
    return np.asarray(0.04 * np.maximum(x - 5.0, 0.0) - 0.02 * np.abs(y))


def stripes(x: NDArrayFloat, y: NDArrayFloat) -> NDArrayAny:
    """Road (1) with marks (3) 0.5 m wide along the road every 3 m, background (0) beyond 6 m."""
    labels = np.where(np.abs(np.mod(y + 0.25, 3.0)) < 0.5, 3, 1)
    return np.where(np.abs(y) > 6.0, 0, labels)


def distance_to_edge(y: NDArrayFloat) -> NDArrayFloat:
    """How far a position is from the nearest edge of a label of `stripes`, metres."""
    edges = np.concatenate([np.arange(-6, 7, 3) - 0.25, np.arange(-6, 7, 3) + 0.25, [-6.0, 6.0]])
    return np.asarray(np.abs(np.asarray(y)[:, None] - edges).min(axis=1))
