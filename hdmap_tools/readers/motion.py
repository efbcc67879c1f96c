"""Ego-motion compensation: bring points seen at many times to one time.

A lidar turns for about 0.1 s while the vehicle moves. Whether a data set has
already undone that motion is a question about the data set; the answer for each
layout stands, with its measurement, in that layout's reader.
"""

from __future__ import annotations

import numpy as np

from hdmap_tools.errors import PoseError, ShapeError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.types import NDArrayFloat, NDArrayInt


def compensate_ego_motion(
    points_sensor_time: NDArrayFloat,
    offsets_ns: NDArrayInt,
    reference_ns: int,
    trajectory: Trajectory,
    max_gap_s: float = 0.5,
) -> NDArrayFloat:
    """Take points from the ego frame at their own time to the ego frame at one time.

    Args:
        points_sensor_time: (N, 3) metres; row i in the ego frame at
            ``reference_ns + offsets_ns[i]``.
        offsets_ns: (N,) integer nanoseconds after reference_ns, may be negative.
        reference_ns: Time of the ego frame wanted.
        trajectory: ``city_SE3_ego`` over time.
        max_gap_s: Longest gap between poses that is interpolated over.

    Returns:
        (N, 3) metres, ego frame at reference_ns.

    Raises:
        PoseError: If the trajectory does not cover all the times.
        ShapeError: If the offsets do not match the points.
    """
    rotations, translations = _ego_ref_SE3_ego_at(
        points_sensor_time, offsets_ns, reference_ns, trajectory, max_gap_s
    )
    return np.asarray(np.einsum("nij,nj->ni", rotations, points_sensor_time) + translations)


def undo_ego_motion_compensation(
    points_reference_time: NDArrayFloat,
    offsets_ns: NDArrayInt,
    reference_ns: int,
    trajectory: Trajectory,
    max_gap_s: float = 0.5,
) -> NDArrayFloat:
    """The exact inverse of `compensate_ego_motion`: what the turning lidar saw.

    Args:
        points_reference_time: (N, 3) metres, ego frame at reference_ns.
        offsets_ns: (N,) integer nanoseconds after reference_ns.
        reference_ns: Time of the ego frame given.
        trajectory: ``city_SE3_ego`` over time.
        max_gap_s: Longest gap between poses that is interpolated over.

    Returns:
        (N, 3) metres; row i in the ego frame at ``reference_ns + offsets_ns[i]``.

    Raises:
        PoseError: If the trajectory does not cover all the times.
        ShapeError: If the offsets do not match the points.
    """
    rotations, translations = _ego_ref_SE3_ego_at(
        points_reference_time, offsets_ns, reference_ns, trajectory, max_gap_s
    )
    return np.asarray(np.einsum("nji,nj->ni", rotations, points_reference_time - translations))


def _ego_ref_SE3_ego_at(
    points: NDArrayFloat,
    offsets_ns: NDArrayInt,
    reference_ns: int,
    trajectory: Trajectory,
    max_gap_s: float,
) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Rotations (N, 3, 3) and translations (N, 3), metres, one a point."""
    offsets_ns = np.asarray(offsets_ns)
    if points.ndim != 2 or points.shape[1] != 3 or offsets_ns.shape != (len(points),):
        raise ShapeError(
            f"Motion compensation needs points (N, 3) and offsets (N,), found {points.shape} and "
            f"{offsets_ns.shape}."
        )
    # Points of one firing share a time: interpolate once for each.
    offsets, row = np.unique(offsets_ns.astype(np.int64), return_inverse=True)
    times = np.append(offsets + reference_ns, reference_ns)
    covered = trajectory.covers(times, max_gap_s)
    if not covered.all():
        outside = times[~covered]
        raise PoseError(
            f"No ego pose at {len(outside)} of {len(times)} times between {outside.min()} and "
            f"{outside.max()} ns, needed to compensate the sweep at {reference_ns} ns; poses run "
            f"from {trajectory.timestamps_ns[0]} to {trajectory.timestamps_ns[-1]} ns with gaps of "
            f"at most {max_gap_s} s allowed."
        )
    rotations, translations = trajectory.interpolate_many(times)
    # Differences first: city coordinates are kilometres, the motion is centimetres.
    ref_R_city = rotations[-1].T
    relative_R = ref_R_city @ rotations[:-1]
    relative_t = (translations[:-1] - translations[-1]) @ ref_R_city.T
    return relative_R[row], relative_t[row]
