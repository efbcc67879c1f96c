"""What stood around the vehicle just then: returns of the sweep near an image that are not ground.

Vehicles that move hide ground and are not in the point map. The ground itself is in it, so a
return stands if it is not at the map's ground height; a sweep's own ground need not be found.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from hdmap_tools.association.visibility import MARGIN_M, ring_gap_deg
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.point_map.ground_window import GroundHeights
from hdmap_tools.point_map.point_map import PointMap
from hdmap_tools.readers.drive import Drive, SweepRef
from hdmap_tools.types import NDArrayFloat

_SWEEPS_FOR_GAP: Final = 5
_SWEEPS_KEPT: Final = 2
_BESIDE_M: Final = 1.0
"""Returns so far outside the clip are looked at too: each covers the angle to its neighbours."""


class LiveReturns:
    """The sweeps of a drive, and what stood in them by the ground of a point map.

    Args:
        drive: Where the sweeps come from.
        points: The map.
        config: Clip and tolerance.
        max_pose_gap_s: Of the drive's poses.
    """

    def __init__(
        self, drive: Drive, points: PointMap, config: AssociationConfig, max_pose_gap_s: float
    ) -> None:
        self._drive, self._config, self._ground = drive, config, GroundHeights(points)
        self._max_pose_gap_s = max_pose_gap_s
        # Several cameras share a sweep.
        self._read = lru_cache(maxsize=_SWEEPS_KEPT)(drive.read_sweep)
        self._pose = lru_cache(maxsize=_SWEEPS_KEPT)(drive.trajectory.interpolate)
        self._gaps_deg: dict[str, float] = {}

    def ring_gap_deg(self, sensor: str) -> float:
        """Angle between the rings of a lidar, degrees: the middle of some sweeps through the drive.

        Of the whole drive, so that a build that goes on finds the same.
        """
        if sensor not in self._gaps_deg:
            refs = [ref for ref in self._drive.sweeps if ref.sensor == sensor]
            some = [self._read(ref) for ref in refs[:: -(-len(refs) // _SWEEPS_FOR_GAP)]]
            gaps = [ring_gap_deg(sweep.points_ego, sweep.ring) for sweep in some]
            self._gaps_deg[sensor] = float(np.median(gaps))
        return self._gaps_deg[sensor]

    def standing_city(
        self, ref: SweepRef, camera: PinholeCamera, city_SE3_ego: SE3
    ) -> NDArrayFloat:
        """Returns (M, 3), city metres, that are not ground and may hide some of the clip.

        Args:
            ref: The sweep.
            camera: That looks.
            city_SE3_ego: Ego pose at the image's own time.
        """
        from hdmap_tools.association.ground_kernels import returns_off_ground

        config, sweep = self._config, self._read(ref)
        city_SE3_sweep = self._pose(sweep.timestamp_ns, self._max_pose_gap_s)
        clip = clip_of(config, camera)
        corners = np.array([[x, y, 0.0] for x in clip[:2] for y in clip[2:]])
        corners = city_SE3_ego.transform_from(corners)[:, :2]
        heights, first_cell = self._ground.window(corners.min(axis=0), corners.max(axis=0))
        ego_SE3_sweep = city_SE3_ego.inverse() @ city_SE3_sweep
        found: NDArrayFloat = returns_off_ground(
            sweep.points_ego,
            (city_SE3_sweep.rotation, city_SE3_sweep.translation),
            (ego_SE3_sweep.rotation, ego_SE3_sweep.translation),
            clip,
            heights,
            first_cell,
            self._ground.cell_m,
            config.ground_tolerance_m,
        )
        return found


def clip_of(config: AssociationConfig, camera: PinholeCamera) -> tuple[float, float, float, float]:
    """(x0, x1, y0, y1), metres in the ego frame, outside of which nothing hides ground of the clip."""
    x, y = camera.ego_SE3_cam.translation[:2]
    across = config.clip_across_m
    return (
        min(0.0, float(x)) - _BESIDE_M,
        max(config.clip_ahead_m, float(x)) + MARGIN_M,
        min(-across, float(y)) - _BESIDE_M,
        max(across, float(y)) + _BESIDE_M,
    )
