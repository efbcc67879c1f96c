"""What pose refinement is told, and what it tells about each drive."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class RefineConfig(BaseModel):
    """How far the given poses are trusted, and how sweeps are registered.

    Attributes:
        noise_m, noise_deg: One sigma of each axis of the given poses, about their drift.
        noise_correlation_s: Time after which that noise has forgotten itself.
        drift_m, drift_deg: One sigma of the slow walk of the given poses, reached after
            100 m driven.
        between_drives_m, between_drives_deg: One sigma of what one drive's poses as a
            whole may be off another's.
        keyframe_distance_m: Sweeps this far apart make the map; all are registered to it.
        max_range_m: Points further from the ego origin are left out.
        thin_m: Each sweep is averaged over cells of this size.
        max_points: Of a thinned sweep.
        surface_size_m: Largest piece of surface taken as plane; it is halved
            `surface_levels` - 1 times where it is not plane.
        range_noise_m: One sigma of a point along the surface's normal.
        surface_noise_m: One sigma of what all points that one sweep has on one piece of
            surface are off together: no surface is plane, no points are independent.
        passes: How often the map is made anew from the poses found.
        min_information: A direction counts as held when registration knows it so many
            times better (in variance) than `noise_m` and `noise_deg`. Measured in ray-cast
            scenes: up to 1.5 where a scene holds nothing, 17 and more (16 rings, 360
            azimuths) or 50 and more (32 rings) in a street.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    noise_m: Positive = 0.02
    noise_deg: Positive = 0.05
    noise_correlation_s: Positive = 0.5
    drift_m: NotNegative = 0.1
    drift_deg: NotNegative = 0.02
    between_drives_m: Positive = 0.3
    between_drives_deg: Positive = 0.2
    keyframe_distance_m: Positive = 1.5
    max_range_m: Positive = 45.0
    thin_m: Positive = 0.25
    max_points: Annotated[int, Field(ge=100)] = 8000
    surface_size_m: Positive = 1.6
    surface_levels: Annotated[int, Field(ge=1, le=6)] = 3
    range_noise_m: Positive = 0.02
    surface_noise_m: Positive = 0.008
    passes: Annotated[int, Field(ge=1, le=20)] = 5
    min_information: Positive = 10.0


class RefineReport(BaseModel):
    """What refinement did to one drive.

    Attributes:
        num_sweeps: Sweeps with a pose.
        num_registered: Those that found enough surfaces in the map.
        num_keyframes: Those that made the map.
        correction_m, correction_deg: RMS of what was changed.
        found_noise_m, found_noise_deg: Noise of the given poses as registration saw it,
            where the scene holds them; what was assumed where it does not.
        is_smooth_position, is_smooth_attitude: Between sweeps a smooth motion was taken,
            and not the given poses with their correction.
        held: Share of the sweeps that the scene holds, by direction: ``along`` and
            ``across`` the vehicle, ``up``, ``roll``, ``pitch``, ``yaw``.
        reason: Why the poses, or which directions of them, were left alone, or None.
        seconds: Time spent.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    num_sweeps: int
    num_registered: int = 0
    num_keyframes: int = 0
    correction_m: float = 0.0
    correction_deg: float = 0.0
    found_noise_m: float | None = None
    found_noise_deg: float | None = None
    is_smooth_position: bool = False
    is_smooth_attitude: bool = False
    held: dict[str, float] = Field(default_factory=dict)
    reason: str | None = None
    seconds: float = 0.0
