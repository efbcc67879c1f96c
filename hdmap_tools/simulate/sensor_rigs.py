"""The sensors of simulated vehicles: where cameras and lidar sit, and what they are.

The ego frame is Argoverse 2's: its origin is the centre of the rear axle, x ahead, y left,
z up, so that level ground lies at z = -0.33 m (`GROUND_Z_EGO_M`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.simulate.settings import CameraRig, LidarPreset
from hdmap_tools.types import NDArrayFloat

GROUND_Z_EGO_M: Final = -0.33
"""Height of level ground in the ego frame: the radius of the loaded rear wheel, as in
Argoverse 2's calibrations."""

LIDAR_HEIGHT_M: Final = 1.9
"""Over the ground."""

# name: x and y of the mount (m, ego), heading (degrees, counter-clockwise)
_MOUNTS: Final[dict[str, tuple[float, float, float]]] = {
    "ring_front_center": (1.4, 0.0, 0.0),
    "ring_front_left": (1.3, 0.25, 60.0),
    "ring_front_right": (1.3, -0.25, -60.0),
    "ring_side_left": (0.9, 0.3, 120.0),
    "ring_side_right": (0.9, -0.3, -120.0),
    # Six cameras of 70 degrees see all around when 60 apart; the one behind takes the name
    # of one of Argoverse 2's two.
    "ring_rear_left": (0.5, 0.0, 180.0),
}
_RIGS: Final[dict[CameraRig, tuple[str, ...]]] = {
    CameraRig.FRONT: ("ring_front_center",),
    CameraRig.FRONT3: ("ring_front_center", "ring_front_left", "ring_front_right"),
    CameraRig.RING6: (
        "ring_front_center",
        "ring_front_left",
        "ring_front_right",
        "ring_side_left",
        "ring_side_right",
        "ring_rear_left",
    ),
}
_FIELD_OF_VIEW_DEG: Final = 70.0
_PITCH_DEG: Final = 2.0
"""Downwards: a little less sky."""


def cameras_of(
    rig: CameraRig, width_px: int = 960, height_px: int = 600, height_m: float = 1.55
) -> list[PinholeCamera]:
    """The cameras of a rig; names are Argoverse 2's, images are rectified, pixels square.

    Args:
        rig: Which cameras.
        width_px: Of each image; its horizontal field of view is 70 degrees.
        height_px: Of each image.
        height_m: Of each camera over the ground.
    """
    return [_camera(name, width_px, height_px, height_m) for name in _RIGS[rig]]


def _camera(name: str, width_px: int, height_px: int, height_m: float) -> PinholeCamera:
    x, y, heading_deg = _MOUNTS[name]
    focal_px = width_px / 2 / np.tan(np.radians(_FIELD_OF_VIEW_DEG / 2))
    # Camera axes (right, down, ahead) of a camera that looks along the ego's x.
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pitch = np.radians(_PITCH_DEG)
    down = np.array(
        [
            [np.cos(pitch), 0.0, np.sin(pitch)],
            [0.0, 1.0, 0.0],
            [-np.sin(pitch), 0.0, np.cos(pitch)],
        ]
    )
    rotation = SE3.from_yaw(np.radians(heading_deg)).rotation @ down @ level
    return PinholeCamera(
        name=name,
        width_px=width_px,
        height_px=height_px,
        fx=focal_px,
        fy=focal_px,
        cx=(width_px - 1) / 2,
        cy=(height_px - 1) / 2,
        ego_SE3_cam=SE3(rotation, np.array([x, y, height_m + GROUND_Z_EGO_M])),
    )


@dataclass(frozen=True, eq=False)
class LidarModel:
    """A spinning lidar.

    Attributes:
        name: Sensor name.
        elevations_deg: (R,) of the lasers, the topmost first; the laser number is the index.
        num_azimuths: Firings of all lasers in one turn.
        rate_hz: Turns a second.
        ego_SE3_lidar: Mount.
        max_range_m: Of a surface of reflectivity 0.8 in dry air.
        min_range_m: Nearer returns are not given.
        range_sigma_m: One sigma of the range.
        ring_gains: (R,) factor of each laser's intensity; no two lasers of a unit are alike.
    """

    name: str
    elevations_deg: NDArrayFloat
    num_azimuths: int
    rate_hz: float
    ego_SE3_lidar: SE3
    max_range_m: float
    ring_gains: NDArrayFloat
    min_range_m: float = 1.0
    range_sigma_m: float = 0.015

    @property
    def num_rings(self) -> int:
        """Number of lasers."""
        return len(self.elevations_deg)

    @property
    def turn_ns(self) -> int:
        """Time of one turn."""
        return round(1e9 / self.rate_hz)


# elevation of the first and the last laser (degrees), lasers, azimuths, range (m)
_LIDARS: Final[dict[LidarPreset, tuple[float, float, int, int, float]]] = {
    LidarPreset.VLP16: (15.0, -15.0, 16, 1800, 100.0),
    LidarPreset.RINGS32: (10.67, -30.67, 32, 2000, 100.0),
    LidarPreset.RINGS64: (2.0, -24.8, 64, 2048, 120.0),
}


def lidar_of(preset: LidarPreset, rate_hz: float = 10.0, seed: int = 0) -> LidarModel:
    """A lidar of one of three classes, over the middle of the roof.

    Args:
        preset: ``vlp16``: 16 rings 2 degrees apart. ``rings32``: +10.67 to -30.67 degrees, 1.33
            apart. ``rings64``: +2 to -24.8 degrees.
        rate_hz: Turns a second.
        seed: Of this unit: the gains of its lasers, within 10 % of one.

    Source:
        Data sheets of Velodyne's VLP-16, HDL-32E and HDL-64E: elevations, ranges, accuracy.
    """
    top_deg, bottom_deg, num_rings, num_azimuths, max_range_m = _LIDARS[preset]
    rng = np.random.default_rng([seed, 0x11DA])
    return LidarModel(
        name=preset.value,
        elevations_deg=np.linspace(top_deg, bottom_deg, num_rings),
        num_azimuths=num_azimuths,
        rate_hz=rate_hz,
        ego_SE3_lidar=SE3(np.eye(3), np.array([0.9, 0.0, LIDAR_HEIGHT_M + GROUND_Z_EGO_M])),
        max_range_m=max_range_m,
        ring_gains=rng.uniform(0.9, 1.1, num_rings),
    )
