"""How far away what a pixel shows would be on level ground, in bands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hdmap_tools.errors import ConfigError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.types import NDArrayByte, NDArrayFloat


def ground_range_m(camera: PinholeCamera, ground_height_m: float = 0.0) -> NDArrayFloat:
    """(height, width) distance over level ground from under the camera to what each pixel shows.

    Args:
        camera: The camera.
        ground_height_m: Height of the ground in the ego frame, metres: 0 where the ego
            origin lies on it, about -0.35 where it is the rear axle (Argoverse 2).

    Returns:
        Metres; infinite at and above the horizon, and where the lens shows nothing.
    """
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    rays = camera.rays_ego(np.column_stack([u.ravel(), v.ravel()]))
    drop_m = camera.ego_SE3_cam.translation[2] - ground_height_m
    falls = np.isfinite(rays).all(axis=1) & (rays[:, 2] < 0.0)
    slope = np.hypot(rays[:, 0], rays[:, 1]) / np.where(falls, -rays[:, 2], 1.0)
    range_m = np.where(falls & (drop_m > 0.0), slope * drop_m, np.inf)
    return np.asarray(range_m.reshape(camera.height_px, camera.width_px))


def band_image(range_m: NDArrayFloat, edges_m: Sequence[float]) -> NDArrayByte:
    """(height, width) number of the band that each pixel's distance is in; the last holds all beyond."""
    check_edges(edges_m)
    return (np.searchsorted(np.asarray(edges_m), range_m, side="right") - 1).astype(np.uint8)


def check_edges(edges_m: Sequence[float]) -> None:
    """Refuse edges that are not 0 and then increasing metres.

    Raises:
        ConfigError: With what was found.
    """
    edges = np.asarray(edges_m, dtype=np.float64)
    if (
        not 2 <= len(edges) <= 255
        or not np.isfinite(edges).all()
        or edges[0] != 0.0
        or (np.diff(edges) <= 0).any()
    ):
        raise ConfigError(
            f"Range bands must be at least two increasing distances in metres from 0 on, for example "
            f"0,10,20,40; found {','.join(f'{e:g}' for e in edges)}."
        )
