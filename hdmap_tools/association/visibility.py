"""What a camera can see: points hidden behind nearer things are not labelled."""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.geometry.camera import PinholeCamera, Projection
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat

CELL_PX: Final = 4
"""Edge of the depth buffer's cells."""
NEAREST_M: Final = 2.0
"""Nearer returns come from the vehicle itself: roof, bonnet, the sensors' own mounts."""
_LIDAR_HEIGHT_M: Final = 1.8
_WIDEST_RING_GAP_DEG: Final = 2.1
MARGIN_M: Final = 0.5
"""A point must lie this much behind an occluder; covers extent and timing of moving things."""


def is_unoccluded(
    projection: Projection,
    is_occluder: NDArrayBool,
    camera: PinholeCamera,
    *,
    gap_h_deg: float = 0.4,
    gap_v_deg: float = 2.1,
) -> NDArrayBool:
    """Which projected points nothing nearer hides, by a depth buffer of the occluders.

    Only points that stand out of the ground hide others: in a grazing view,
    neighbouring ground returns differ in depth by metres and would hide each
    other. Each occluder covers the angle to its neighbours in the sweep.

    Args:
        projection: Of all points of the sweep.
        is_occluder: (N,) which of them can hide others: those above the ground.
        camera: The camera projected into.
        gap_h_deg: Angle between neighbouring returns of one ring.
        gap_v_deg: Angle between neighbouring rings, see `ring_gap_deg`.

    Returns:
        (N,) bool; False for points that are not in the image.
    """
    visible = projection.is_valid.copy()
    blockers = projection.is_valid & is_occluder & (projection.depth_m > NEAREST_M)
    if not blockers.any():
        return visible
    depth = np.full(depth_shape(camera), np.inf)
    cell = np.zeros((len(visible), 2), dtype=np.int64)
    cell[projection.is_valid] = np.floor((projection.uv[projection.is_valid] + 0.5) / CELL_PX)
    np.minimum.at(depth, (cell[blockers, 1], cell[blockers, 0]), projection.depth_m[blockers])
    depth = widened(depth, camera, gap_h_deg, gap_v_deg)
    behind = projection.depth_m > depth[cell[:, 1], cell[:, 0]] + MARGIN_M
    return np.asarray(visible & ~(behind & ~is_occluder))


def depth_shape(camera: PinholeCamera) -> tuple[int, int]:
    """Rows and columns of a camera's depth buffer in cells of `CELL_PX`."""
    return -(-camera.height_px // CELL_PX), -(-camera.width_px // CELL_PX)


def widened(
    depth: NDArrayAny, camera: PinholeCamera, gap_h_deg: float, gap_v_deg: float
) -> NDArrayAny:
    """A depth buffer in cells of `CELL_PX` in which each occluder covers the gaps around it."""
    # A whole gap up and down, not half of one: below the lowest ring that meets a thing,
    # its foot reaches down to the next, which may have met the ground before it.
    reach = (
        _odd(2.0 * np.deg2rad(gap_v_deg) * camera.fy / CELL_PX),
        _odd(np.deg2rad(gap_h_deg) * camera.fx / CELL_PX),
    )
    import cv2

    # OpenCV's takes a fifth of the time of scipy's; beyond the border lies nothing.
    kernel = np.ones(reach, dtype=np.uint8)
    return np.asarray(cv2.erode(depth, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf))


def ring_gap_deg(points_ego: NDArrayFloat, ring: NDArrayByte) -> float:
    """Angle between neighbouring rings of a sweep, with a margin, degrees; 2.1 when unknown.

    Rings that are dense in the middle are coarse at the ends: the wide end counts.
    2 degrees is the spacing of 16 rings over 30 degrees, the coarsest in wide use.

    Args:
        points_ego: (N, 3) of the sweep, metres; the lidar is taken to be 1.8 m up.
        ring: (N,) laser number; all equal when unknown.
    """
    rings = np.unique(ring)
    if len(rings) < 4:
        return _WIDEST_RING_GAP_DEG
    distance = np.linalg.norm(points_ego[:, :2], axis=1)
    far = distance > 5.0
    elevation = np.rad2deg(
        np.arctan2(points_ego[far, 2] - _LIDAR_HEIGHT_M, np.maximum(distance[far], 1e-6))
    )
    # By ring, sorted once: bytes sort in one pass.
    order = np.argsort(ring[far], kind="stable")
    parts = np.split(elevation[order], np.cumsum(np.bincount(ring[far], minlength=256))[:-1])
    medians = [float(np.median(part)) for part in parts if len(part)]
    if len(medians) < 4:
        return _WIDEST_RING_GAP_DEG
    gaps = np.diff(np.sort(medians))
    return float(np.clip(1.1 * np.percentile(gaps, 90), 0.3, _WIDEST_RING_GAP_DEG))


def _odd(cells: float) -> int:
    return 2 * int(np.ceil(cells / 2.0)) + 1
