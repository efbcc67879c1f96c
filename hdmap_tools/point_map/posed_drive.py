"""Sweeps of a drive at their poses: which have one, and where their returns lie in the city."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from hdmap_tools.association.ground import estimate_ground
from hdmap_tools.config import PointsConfig
from hdmap_tools.errors import PointMapError
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.drive import Drive, Sweep, SweepRef
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

_LOG = logging.getLogger(__name__)

_PATH_STEP_M: Final = 0.25


@dataclass(frozen=True, eq=False)
class PosedDrive:
    """A drive with the poses that its sweeps are put at.

    Attributes:
        drive: Where the sweeps come from.
        trajectory: ``city_SE3_ego``: the drive's own, or refined.
        is_refined: Which of the two.
    """

    drive: Drive
    trajectory: Trajectory
    is_refined: bool = False

    @classmethod
    def as_given(cls, drive: Drive) -> PosedDrive:
        """With the drive's own poses."""
        return cls(drive, drive.trajectory)

    def usable_sweeps(self, max_pose_gap_s: float) -> NDArrayInt:
        """Numbers (N,) of the drive's sweeps that have a pose; how many have none is said.

        Raises:
            PointMapError: If there is none.
        """
        drive = self.drive
        times = np.array([ref.timestamp_ns for ref in drive.sweeps], dtype=np.int64)
        usable = np.flatnonzero(self.trajectory.covers(times, max_pose_gap_s))
        if len(usable) == 0:
            first, last = self.trajectory.timestamps_ns[[0, -1]]
            raise PointMapError(
                f"Drive {drive.name} has no lidar sweep with a pose: {len(drive.sweeps)} sweeps, poses from "
                f"{first} to {last} ns with gaps of at most {max_pose_gap_s} s allowed. A point map needs lidar."
            )
        if len(usable) < len(drive.sweeps):
            _LOG.warning(
                "%s: %d of %d sweeps left out: no ego pose.",
                drive.name,
                len(drive.sweeps) - len(usable),
                len(drive.sweeps),
            )
        return usable

    @cached_property
    def path(self) -> cKDTree:
        """Positions along the driven path, about a quarter of a metre apart, x and y in metres."""
        path = self.trajectory.translations[:, :2]
        walked = np.cumsum(np.linalg.norm(np.diff(path, axis=0, prepend=path[:1]), axis=1))
        return cKDTree(path[np.unique(np.floor(walked / _PATH_STEP_M), return_index=True)[1]])


@dataclass(frozen=True, eq=False)
class SweepInCity:
    """One sweep at its pose: returns within range, and which are ground.

    Attributes:
        sweep: Only returns within range.
        city_SE3_ego: Pose.
        points_city: (N, 3) metres.
        range_m: (N,) from the ego origin in x-y.
        is_ground: (N,).
    """

    sweep: Sweep
    city_SE3_ego: SE3
    points_city: NDArrayFloat
    range_m: NDArrayFloat
    is_ground: NDArrayBool

    @property
    def distance_m(self) -> NDArrayFloat:
        """(N,) from the ego origin in space."""
        return np.hypot(self.range_m, self.sweep.points_ego[:, 2])


def sweep_in_city(posed: PosedDrive, ref: SweepRef, config: PointsConfig) -> SweepInCity:
    """Read one sweep and put it where it was seen."""
    from hdmap_tools.point_map.sweep_kernels import placed_within

    whole = posed.drive.read_sweep(ref)
    city_SE3_ego = posed.trajectory.interpolate(whole.timestamp_ns, np.inf)
    near, points_ego, points_city, range_m = placed_within(
        whole.points_ego,
        city_SE3_ego.rotation,
        city_SE3_ego.translation,
        config.min_range_m,
        config.max_range_m,
    )
    sweep = Sweep(whole.timestamp_ns, points_ego, whole.intensity[near], whole.ring[near])
    surface = estimate_ground(points_ego, config.max_range_m)
    is_ground = surface.is_near(points_ego, config.ground_tolerance_m)
    return SweepInCity(sweep, city_SE3_ego, points_city, range_m, is_ground)
