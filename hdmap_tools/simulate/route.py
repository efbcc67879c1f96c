"""A route along connected lanes, and the true motion of a vehicle that follows it."""

from __future__ import annotations

from dataclasses import dataclass

from hdmap_tools.types import NDArrayFloat


@dataclass(frozen=True, eq=False)
class Route:
    """Where the vehicle drives.

    Attributes:
        xy: (N, 2) float64 metres, city frame: its rear axle, smooth, evenly spaced at `step_m`.
        step_m: Between neighbouring points.
        lane_ids: Lanes in the order they are driven; a lane may come again.
    """

    xy: NDArrayFloat
    step_m: float
    lane_ids: tuple[str, ...]
