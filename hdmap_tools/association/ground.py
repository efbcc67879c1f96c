"""The ground under a sweep: which points lie on it, and how high it is elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from hdmap_tools.association.visibility import ring_gap_deg
from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_SECTORS: Final = 72
_RING_M: Final = 1.0
_MAX_SLOPE: Final = 0.15
"""Steeper than any public road; what climbs faster is not ground."""
_STEP_M: Final = 0.12
"""Allowed beside the slope between two rings: roughness, kerbs and range noise."""
_NEAREST_M: Final = 1.0
"""What is nearer is the vehicle."""
_SAMPLE_M: Final = 0.1
"""Above the low height of its cell, up to which a return is ground seen there."""
_SEED_RANGE_M: Final = 12.0
_SEED_HEIGHT_M: Final = 1.0
"""The ground near the vehicle is within this of its origin, which is at the wheels' height."""
_REACH_M: Final = 4.0
"""Ground is not guessed further than this from ground that was seen."""


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """Ground heights found in one sweep, interpolated between them.

    Attributes:
        samples: (N, 3) metres, the sweep's frame: ground seen in one sector and ring.
    """

    samples: NDArrayFloat

    @cached_property
    def _bins(self) -> tuple[Any, ...]:
        from hdmap_tools.association.ground_kernels import sorted_into_bins

        bins: tuple[Any, ...] = sorted_into_bins(self.samples)
        return bins

    def height_at(self, xy: NDArrayFloat) -> NDArrayFloat:
        """Height (N,) at positions (N, 2), metres; NaN further than 4 m from ground seen."""
        if len(self.samples) == 0 or len(xy) == 0:
            return np.full(len(xy), np.nan)
        from hdmap_tools.association.ground_kernels import heights_between

        xy = np.ascontiguousarray(xy, dtype=np.float64)
        height: NDArrayFloat = heights_between(xy, *self._bins, _REACH_M)
        return height

    def is_near(self, points: NDArrayFloat, tolerance_m: float) -> NDArrayBool:
        """Which points (N, 3), metres, lie within a tolerance of the ground; where it is unknown, none.

        The height is looked up every half metre and interpolated between.
        """
        if len(self.samples) == 0 or len(points) == 0:
            return np.zeros(len(points), dtype=bool)
        from hdmap_tools.association.ground_kernels import near_surface

        points = np.ascontiguousarray(points, dtype=np.float64)
        near: NDArrayBool = near_surface(points, *self._bins, _REACH_M, tolerance_m)
        return near

    def plane(self, max_range_m: float = 15.0) -> tuple[float, float, float] | None:
        """(a, b, c) of ``z = a x + b y + c`` through the ground within a range; None without any."""
        near = self.samples[np.linalg.norm(self.samples[:, :2], axis=1) <= max_range_m]
        if len(near) < 3:
            return None
        design = np.column_stack([near[:, :2], np.ones(len(near))])
        weight = np.ones(len(near))
        solution = np.zeros(3)
        for _ in range(10):  # iteratively reweighted: pavements lie above the road
            solution = np.linalg.lstsq(design * weight[:, None], near[:, 2] * weight, rcond=None)[0]
            residual = np.abs(near[:, 2] - design @ solution)
            weight = np.sqrt(1.0 / np.maximum(residual, 0.02))
        return float(solution[0]), float(solution[1]), float(solution[2])


@dataclass(frozen=True, eq=False)
class GroundedSweep:
    """A sweep with its ground, made once and used for every image near it in time.

    Attributes:
        sweep: Points in the ego frame at the sweep's time.
        city_SE3_ego: Ego pose at that time.
        points_city: (N, 3) the same points, city frame.
        surface: The ground, ego frame at that time.
        ring_gap_deg: Angle between neighbouring rings.
        is_ground: (N,) bool: points on the ground.
    """

    sweep: Sweep
    city_SE3_ego: SE3
    points_city: NDArrayFloat
    surface: GroundSurface
    is_ground: NDArrayBool
    ring_gap_deg: float

    @classmethod
    def from_sweep(
        cls, sweep: Sweep, city_SE3_ego: SE3, max_range_m: float, tolerance_m: float
    ) -> GroundedSweep:
        """Find the ground of a sweep, up to some way beyond the range that will be used."""
        surface = estimate_ground(sweep.points_ego, max_range_m + 20.0)
        return cls(
            sweep,
            city_SE3_ego,
            city_SE3_ego.transform_from(sweep.points_ego),
            surface,
            surface.is_near(sweep.points_ego, tolerance_m),
            ring_gap_deg(sweep.points_ego, sweep.ring),
        )


def estimate_ground(points: NDArrayFloat, max_range_m: float = 60.0) -> GroundSurface:
    """Find the ground by walking outwards from the vehicle, sector by sector.

    In each of 72 sectors the lowest points of rings 1 m wide are followed from
    the vehicle outwards; a ring whose lowest points jump by more than a road's
    slope allows is not ground, and the walk goes on behind it.

    Args:
        points: (N, 3) metres, in a frame with z up and its origin on the vehicle
            near the ground (the ego frame).
        max_range_m: How far to look.

    Source:
        Himmelsbach, Hundelshausen, Wuensche, Fast segmentation of 3D point clouds
        for ground vehicles, 2010, for the sectors; the walk is ours.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ShapeError(f"Points must be (N, 3), found {points.shape}.")
    from hdmap_tools.association.ground_kernels import low_heights, mean_samples, polar_cells

    num_rings = int(max_range_m / _RING_M) + 1
    cell = polar_cells(points, max_range_m, _NEAREST_M, _RING_M, _SECTORS, num_rings)
    low = low_heights(cell, points[:, 2], _SECTORS * num_rings).reshape(_SECTORS, num_rings)
    if np.isnan(low).all():
        return GroundSurface(np.zeros((0, 3)))
    seed_cells = low[:, : int(_SEED_RANGE_M / _RING_M)]
    seeds = seed_cells[np.isfinite(seed_cells) & (np.abs(seed_cells) < _SEED_HEIGHT_M)]
    height = np.full(_SECTORS, float(np.median(seeds)) if len(seeds) else 0.0)
    slope = np.zeros(_SECTORS)
    walked = np.zeros(_SECTORS)
    accepted = np.zeros_like(low, dtype=bool)
    for r in range(num_rings):
        walked += _RING_M
        step = low[:, r] - (height + slope * walked)
        # The first ring starts at the vehicle: allow the seed's own scatter.
        allowed = _STEP_M + _MAX_SLOPE * np.minimum(walked, 5.0) * 0.5
        ok = np.isfinite(step) & (np.abs(step) <= allowed)
        new_slope = np.clip(slope + 0.3 * step / walked, -_MAX_SLOPE, _MAX_SLOPE)
        slope = np.where(ok, new_slope, slope)
        height = np.where(ok, low[:, r], height)
        walked = np.where(ok, 0.0, walked)
        accepted[:, r] = ok
    ceiling = np.where(accepted, low + _SAMPLE_M, -np.inf)
    return GroundSurface(mean_samples(points, cell, ceiling.ravel()))
