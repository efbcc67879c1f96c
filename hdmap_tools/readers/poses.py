"""Make a trajectory from a table of poses, and say what is wrong with the table."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import PoseError, ShapeError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.types import NDArrayFloat, NDArrayInt

_SAME_PLACE_M: Final = 0.001
"""Two poses at one time further apart than this contradict each other."""


def trajectory_from_table(
    timestamps_ns: NDArrayInt,
    wxyz: NDArrayFloat,
    xyz_m: NDArrayFloat,
    path: Path,
    warnings: list[str],
) -> Trajectory:
    """``city_SE3_ego`` from the rows of a table, in any order.

    Args:
        timestamps_ns: (N,) integer nanoseconds.
        wxyz: (N, 4) quaternions, scalar first.
        xyz_m: (N, 3) metres, city frame.
        path: The table, for messages.
        warnings: Receives a line if poses at one time contradict each other.

    Raises:
        PoseError: If there is no pose, or one is not finite or has no direction.
    """
    times = np.asarray(timestamps_ns, dtype=np.int64)
    if wxyz.shape != (len(times), 4) or xyz_m.shape != (len(times), 3):
        raise PoseError(
            f"Poses in {path} are unusable: expected quaternions (N, 4) and translations (N, 3) for "
            f"{len(times)} times, found {wxyz.shape} and {xyz_m.shape}."
        )
    # Before rows at one time are thinned: a broken row must not hide behind a good one.
    if not np.isfinite(xyz_m).all():
        row = int(np.flatnonzero(~np.isfinite(xyz_m).all(axis=1))[0])
        raise PoseError(
            f"Poses in {path} are unusable: row {row} has a NaN or infinite translation "
            f"{xyz_m[row].tolist()}; remove it."
        )
    try:
        trajectory = Trajectory.from_quaternions(times, wxyz, xyz_m)
    except (PoseError, ShapeError) as error:
        raise PoseError(f"Poses in {path} are unusable: {error}") from error
    kept = trajectory.translations[np.searchsorted(trajectory.timestamps_ns, times)]
    apart_m = np.linalg.norm(xyz_m - kept, axis=1)
    if contradicting := int((apart_m > _SAME_PLACE_M).sum()):
        warnings.append(
            f"{contradicting} poses in {path.name} lie up to {apart_m.max():.3f} m from another one "
            "at the same time; the first of each was kept"
        )
    return trajectory
