"""The true ego poses: a vehicle on four wheels, standing on the ground wherever the route leads it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d

from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.types import NDArrayFloat, NDArrayInt

HeightAt = Callable[[NDArrayFloat], NDArrayFloat]
"""Ground heights (N,) at city positions (N, 2), metres."""

AXLE_HEIGHT_M: Final = 0.33
"""Of the ego origin, the middle of the rear axle, above the ground: the radius of a wheel."""

_WHEELBASE_M: Final = 2.9
_TRACK_M: Final = 1.6
_SUSPENSION_S: Final = 0.15
"""Tyres and springs round off what the wheels meet; one sigma in time."""


def vehicle_trajectory(
    timestamps_ns: NDArrayInt, xy: NDArrayFloat, yaw_rad: NDArrayFloat, height_at: HeightAt
) -> Trajectory:
    """``city_SE3_ego`` of a vehicle that drives over the ground.

    Pitch comes from the heights under the axles, roll from those under left and right
    wheels.

    Args:
        timestamps_ns: (N,) int64, evenly spaced.
        xy: (N, 2) of the middle of the rear axle, city frame, metres.
        yaw_rad: (N,) heading, counter-clockwise from east.
        height_at: The ground.

    Returns:
        N poses; ego axes are x ahead, y left, z up, the origin on the rear axle.
    """
    ahead = np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    wheels = [
        height_at(xy + along * _WHEELBASE_M * ahead + side * _TRACK_M / 2 * left)
        for along in (0.0, 1.0)
        for side in (1.0, -1.0)
    ]
    rear_left, rear_right, front_left, front_right = (_sprung(z, timestamps_ns) for z in wheels)
    climb = (front_left + front_right - rear_left - rear_right) / (2 * _WHEELBASE_M)
    bank = (front_left + rear_left - front_right - rear_right) / (2 * _TRACK_M)
    x_axis = _unit(np.column_stack([ahead, climb]))
    # Left along the bank, made perpendicular to the way ahead.
    y_axis = np.column_stack([left, bank])
    y_axis = _unit(y_axis - (y_axis * x_axis).sum(axis=1, keepdims=True) * x_axis)
    z_axis = np.cross(x_axis, y_axis)
    ground = np.column_stack([xy, (rear_left + rear_right) / 2])
    rotations = np.stack([x_axis, y_axis, z_axis], axis=2)
    return Trajectory(timestamps_ns, rotations, ground + AXLE_HEIGHT_M * z_axis)


def _sprung(heights: NDArrayFloat, timestamps_ns: NDArrayInt) -> NDArrayFloat:
    if len(heights) < 2:
        return heights
    step_s = float(timestamps_ns[1] - timestamps_ns[0]) / 1e9
    smooth: NDArrayFloat = gaussian_filter1d(heights, _SUSPENSION_S / step_s, mode="nearest")
    return smooth


def _unit(vectors: NDArrayFloat) -> NDArrayFloat:
    normalized: NDArrayFloat = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return normalized
