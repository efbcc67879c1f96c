"""What a camera can see: points hidden behind nearer things are not labelled."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.ndimage import minimum_filter

from hdmap_tools.geometry.camera import PinholeCamera, Projection
from hdmap_tools.types import NDArrayBool

_CELL_PX: Final = 4
_NEAREST_M: Final = 2.0
"""Nearer returns come from the vehicle itself: roof, bonnet, the sensors' own mounts."""
_MARGIN_M: Final = 0.5
"""A point must lie this much behind an occluder; covers extent and timing of moving things."""


def is_unoccluded(
    projection: Projection,
    is_occluder: NDArrayBool,
    camera: PinholeCamera,
    *,
    gap_h_deg: float = 0.4,
    gap_v_deg: float = 1.4,
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
        gap_v_deg: Angle between neighbouring rings (1.33 degrees for 32 rings
            over 40 degrees, the coarsest lidar in wide use).

    Returns:
        (N,) bool; False for points that are not in the image.
    """
    visible = projection.is_valid.copy()
    blockers = projection.is_valid & is_occluder & (projection.depth_m > _NEAREST_M)
    if not blockers.any():
        return visible
    shape = (-(-camera.height_px // _CELL_PX), -(-camera.width_px // _CELL_PX))
    depth = np.full(shape, np.inf)
    cell = np.zeros((len(visible), 2), dtype=np.int64)
    cell[projection.is_valid] = np.floor((projection.uv[projection.is_valid] + 0.5) / _CELL_PX)
    np.minimum.at(depth, (cell[blockers, 1], cell[blockers, 0]), projection.depth_m[blockers])
    reach = (
        _odd(np.deg2rad(gap_v_deg) * camera.fy / _CELL_PX),
        _odd(np.deg2rad(gap_h_deg) * camera.fx / _CELL_PX),
    )
    depth = minimum_filter(depth, size=reach, mode="constant", cval=np.inf)
    behind = projection.depth_m > depth[cell[:, 1], cell[:, 0]] + _MARGIN_M
    return np.asarray(visible & ~(behind & ~is_occluder))


def _odd(cells: float) -> int:
    return 2 * int(np.ceil(cells / 2.0)) + 1
