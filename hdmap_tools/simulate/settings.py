"""What a simulated drive is like; everything follows from these and the seed."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class Weather(StrEnum):
    """Light and air."""

    CLEAR = "clear"
    OVERCAST = "overcast"
    HAZE = "haze"
    WET = "wet"
    DUSK = "dusk"


class Difficulty(StrEnum):
    """Wear of paint, traffic, parked vehicles, patches, dirt on the lens, image noise."""

    EASY = "easy"
    DEFAULT = "default"
    HARD = "hard"


class CameraRig(StrEnum):
    """Cameras: one ahead, three ahead, six around."""

    FRONT = "front"
    FRONT3 = "front3"
    RING6 = "ring6"


class LidarPreset(StrEnum):
    """Ring geometries; ``none``: a vehicle without a lidar, for pictures alone."""

    NONE = "none"
    VLP16 = "vlp16"
    RINGS32 = "rings32"
    RINGS64 = "rings64"


class PoseErrors(BaseModel):
    """How the poses that are written differ from the true ones; all zero by default.

    Attributes:
        noise_m, noise_deg: One sigma of each axis, correlated over `correlation_s`.
        drift_m, drift_deg: One sigma of a slow walk on top, reached after 100 m driven.
        correlation_s: Time after which the noise has forgotten itself.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    noise_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    noise_deg: Annotated[float, Field(ge=0, le=90)] = 0.0
    drift_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    drift_deg: Annotated[float, Field(ge=0, le=90)] = 0.0
    correlation_s: Annotated[float, Field(gt=0)] = 0.5


class SimulationSettings(BaseModel):
    """One simulated drive.

    Attributes:
        seed: Everything random follows from it.
        world_seed: What stays the same between drives of one place follows from this one instead:
            ground, wear, buildings, trees, signs; None takes the seed. Traffic, parked
            vehicles, light and noise, and the choice of a route, follow from the seed.
        length_m: Of the route; the drive ends early where the lanes do.
        start: Lane id, or ``X,Y`` in the city frame; None is a seeded choice.
        weather, difficulty: What it looks like.
        camera_rig, lidar: The sensors.
        camera_height_m: Of all cameras, over the ground.
        image_width_px, image_height_px: Of each camera.
        camera_hz, lidar_hz: Rates.
        speed_mps: On straight roads; curves are taken slower.
        pose_errors: Of the poses that are written; `truth/` keeps the true ones.
        calibration_error_m, calibration_error_deg: One sigma of each axis of each mount
            that is written.
        true_map: Whether the class raster and the vector map of what was seen are written;
            who wants images and their labels alone saves a fifth of the time.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    world_seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    length_m: Annotated[float, Field(ge=10, le=1e6)] = 300.0
    start: str | None = None
    weather: Weather = Weather.CLEAR
    difficulty: Difficulty = Difficulty.DEFAULT
    camera_rig: CameraRig = CameraRig.FRONT
    camera_height_m: Annotated[float, Field(ge=0.5, le=4.0)] = 1.55
    lidar: LidarPreset = LidarPreset.RINGS32
    image_width_px: Annotated[int, Field(ge=64, le=4096)] = 960
    image_height_px: Annotated[int, Field(ge=64, le=4096)] = 600
    camera_hz: Annotated[float, Field(gt=0, le=60)] = 5.0
    lidar_hz: Annotated[float, Field(gt=0, le=20)] = 10.0
    speed_mps: Annotated[float, Field(ge=0.5, le=40)] = 8.0
    pose_errors: PoseErrors = PoseErrors()
    calibration_error_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    calibration_error_deg: Annotated[float, Field(ge=0, le=90)] = 0.0
    true_map: bool = True

    @property
    def place_seed(self) -> int:
        """What the place follows from."""
        return self.seed if self.world_seed is None else self.world_seed
