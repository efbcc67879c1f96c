"""A route along connected lanes, and the true motion of a vehicle that follows it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely

from hdmap_tools.errors import WorldError
from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.simulate.route_search import RoadGraph, find_lanes
from hdmap_tools.simulate.smooth_line import between, smoothed
from hdmap_tools.simulate.world_map import WorldMap
from hdmap_tools.types import NDArrayFloat

logger = logging.getLogger(__name__)

STEP_M: Final = 0.25
MIN_LENGTH_M: Final = 10.0
MAX_LATERAL_MPS2: Final = 2.0
MAX_ALONG_MPS2: Final = 1.5
_MAX_START_DISTANCE_M: Final = 10.0
_MAX_CHANGE_M: Final = 45.0
_EASE_M: Final = 4.0
"""Over which the acceleration changes; before and after a bend the speed is lower by as much."""


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

    @property
    def length_m(self) -> float:
        """Along the line."""
        return (len(self.xy) - 1) * self.step_m


def plan_route(world: WorldMap, length_m: float, start: str | None, seed: int) -> Route:
    """Plan a drive along connected road lanes; it ends early, with a warning, where they do.

    At forks it takes lanes not driven yet from which it can go on; where a lane ends it
    changes to a neighbour across a dashed line. Loops are driven again where nothing else
    is left.

    Args:
        world: Where to drive.
        length_m: Of the drive.
        start: A lane's id (from its begin), or ``X,Y`` in metres of the city frame (from
            the nearest lane's nearest point); None chooses, by the seed, among the starts
            of the longest drives.
        seed: Of the choices.

    Returns:
        The route; along it the middle of the lanes, smoothed.

    Raises:
        WorldError: If the world has no road lanes, the start is none of them or more than
            10 m from all, or the drive would be shorter than 10 m.
    """
    graph = RoadGraph.of_world(world)
    if not graph.length_m:
        raise WorldError(
            f"The map {world.name} has no lanes for vehicles; expected at least one to drive on."
        )
    rng = np.random.default_rng(seed)
    skipped_m = 0.0
    if start is None:
        starts = sorted(graph.length_m)
    else:
        lane_id, skipped_m = _start_lane(world, graph, start)
        starts = [lane_id]
    # Some more than wanted: smoothing cuts bends.
    enough_m = skipped_m + 1.03 * length_m + 5.0
    lane_ids = find_lanes(graph, enough_m, starts, rng)
    line, half_width_m, begins_m = _joined(world, graph, lane_ids)
    along = arc_lengths(line)
    kept = (along >= skipped_m) & (along <= enough_m)
    found_m = float(min(along[-1], enough_m) - skipped_m)
    if found_m < MIN_LENGTH_M or kept.sum() < 2:
        raise WorldError(
            f"The longest drive found in {world.name}"
            + (f" from {start}" if start is not None else "")
            + f" is {max(found_m, 0.0):.1f} m; expected at least {MIN_LENGTH_M:g} m of connected "
            "lanes. Choose another start, or check that the lanes of the map share end points."
        )
    xy = smoothed(line[kept], half_width_m[kept], STEP_M)
    driven = arc_lengths(xy)
    count = int(min(length_m, float(driven[-1])) / STEP_M + 1e-9) + 1
    at = np.arange(count) * STEP_M
    xy = np.column_stack([np.interp(at, driven, xy[:, k]) for k in range(2)])
    end_m = skipped_m + found_m * min(at[-1] / float(driven[-1]), 1.0)
    lane_ids = [k for k, begin_m in zip(lane_ids, begins_m, strict=True) if begin_m < end_m]
    route = Route(xy, STEP_M, tuple(lane_ids))
    if route.length_m < length_m - STEP_M:
        logger.warning(
            "The drive through %s is %.0f m long instead of %.0f m: its lanes end there.",
            world.name,
            route.length_m,
            length_m,
        )
    return route


def _start_lane(world: WorldMap, graph: RoadGraph, start: str) -> tuple[str, float]:
    """The lane to start on, and how far along it."""
    if start in graph.length_m:
        return start, 0.0
    if start in world.lanes:
        raise WorldError(
            f"The start {start} is a lane for {world.lanes[start].kind}s in {world.name}; "
            "expected one for vehicles."
        )
    try:
        x, y = (float(text) for text in start.split(","))
    except ValueError:
        x = y = float("nan")
    if not np.isfinite([x, y]).all():
        few = ", ".join(sorted(graph.length_m)[:3])
        raise WorldError(
            f"The start {start[:60]!r} is no lane of {world.name}; expected one of its "
            f"{len(graph.length_m)} road lanes (such as {few}), or X,Y in metres."
        )
    point = shapely.Point(x, y)
    middles = {
        k: shapely.LineString(between(world.lanes[k].left, world.lanes[k].right)[0])
        for k in graph.length_m
    }
    nearest = min(middles, key=lambda k: (middles[k].distance(point), k))
    distance_m = middles[nearest].distance(point)
    if distance_m > _MAX_START_DISTANCE_M:
        raise WorldError(
            f"The start {x:g},{y:g} is {distance_m:.1f} m from the nearest road lane of "
            f"{world.name} ({nearest}); expected at most {_MAX_START_DISTANCE_M:g} m."
        )
    return nearest, float(middles[nearest].project(point))


def _joined(
    world: WorldMap, graph: RoadGraph, lane_ids: Sequence[str]
) -> tuple[NDArrayFloat, NDArrayFloat, list[float]]:
    """Middle of the lanes (N, 2) in driving order, half their width (N,), where each begins.

    A lane that is changed to begins where the change does.
    """
    lines: list[NDArrayFloat] = []
    widths: list[NDArrayFloat] = []
    begins_m: list[float] = []
    driven_m, k = 0.0, 0
    while k < len(lane_ids):
        here = world.lanes[lane_ids[k]]
        middle, half_width = between(here.left, here.right)
        following = lane_ids[k + 1] if k + 1 < len(lane_ids) else None
        if lines:
            driven_m += float(np.hypot(*(middle[0] - lines[-1][-1])))
        begins_m.append(driven_m)
        is_change = following in graph.changes[here.id] and following not in here.successors
        if following is not None and is_change:
            other = world.lanes[following]
            middle, half_width = _changing(middle, half_width, *between(other.left, other.right))
            begins_m.append(driven_m)
            k += 1
        lines.append(middle)
        widths.append(half_width)
        driven_m += float(arc_lengths(middle)[-1])
        k += 1
    return np.concatenate(lines), np.concatenate(widths), begins_m


def _changing(
    middle: NDArrayFloat,
    half_width: NDArrayFloat,
    other: NDArrayFloat,
    other_half_width: NDArrayFloat,
) -> tuple[NDArrayFloat, NDArrayFloat]:
    """From one lane's middle to its neighbour's, at most 45 m long, in the middle of both."""
    count = max(len(middle), len(other))
    share = np.linspace(0.0, 1.0, count)

    def at_shares(values: NDArrayFloat) -> NDArrayFloat:
        given = np.linspace(0.0, 1.0, len(values))
        return np.column_stack([np.interp(share, given, column) for column in values.T])

    a = at_shares(np.column_stack([middle, half_width]))
    b = at_shares(np.column_stack([other, other_half_width]))
    span = min(_MAX_CHANGE_M / max(float(arc_lengths(middle)[-1]), 1e-9), 0.9)
    t = np.clip((share - (1.0 - span) / 2.0) / span, 0.0, 1.0)
    blend = (t**3 * (10.0 - 15.0 * t + 6.0 * t**2))[:, None]
    mixed = (1.0 - blend) * a + blend * b
    return mixed[:, :2], mixed[:, 2]


def motion_along(
    route: Route, speed_mps: float, rate_hz: float
) -> tuple[NDArrayFloat, NDArrayFloat]:
    """When the vehicle is where: at most `speed_mps`, slower in bends, smoothly.

    Lateral acceleration stays below 2 m/s², that along the route below 1.5 m/s², changing in
    steps of less than 0.2 m/s². The drive begins and ends at the speed the road there allows.

    Args:
        route: What it follows.
        speed_mps: On straight roads.
        rate_hz: Of the result.

    Returns:
        times_s (K,) from 0 in steps of 1 / rate_hz, and arc_m (K,) metres along the route,
        rising, the last within one step of its end.
    """
    if not (np.isfinite([speed_mps, rate_hz]).all() and speed_mps > 0 and rate_hz > 0):
        raise WorldError(
            f"Speed and rate must be positive, found {speed_mps:g} m/s and {rate_hz:g} Hz."
        )
    step = route.step_m
    squared = np.minimum(speed_mps**2, MAX_LATERAL_MPS2 / np.maximum(_bend(route), 1e-9))
    # v² changes by at most 2·a·ds; lower envelope of cones of that slope, forward then back.
    ramp = 2.0 * MAX_ALONG_MPS2 * step * np.arange(len(squared))
    squared = np.minimum.accumulate(squared - ramp) + ramp
    squared = (np.minimum.accumulate((squared - ramp[::-1])[::-1]) + ramp)[::-1]
    # Lowest within a reach, then the mean over it: neither steeper nor above what it was.
    squared = _mean_of_lowest(squared, reach=max(round(_EASE_M / step), 1))
    speed = np.sqrt(squared)
    taken_s = 2.0 * step / (speed[:-1] + speed[1:])
    at_s = np.concatenate([[0.0], np.cumsum(taken_s)])
    times_s = np.arange(int(at_s[-1] * rate_hz + 1e-9) + 1) / rate_hz
    k = np.clip(np.searchsorted(at_s, times_s, side="right") - 1, 0, len(taken_s) - 1)
    late_s = times_s - at_s[k]
    gain = (speed[k + 1] - speed[k]) / taken_s[k]
    arc_m = k * step + speed[k] * late_s + 0.5 * gain * late_s**2
    return times_s, np.minimum(arc_m, route.length_m)


def _mean_of_lowest(values: NDArrayFloat, reach: int) -> NDArrayFloat:
    window = 2 * reach + 1
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, reach, mode="edge"), window)
    lowest = around.min(axis=1)
    hann = np.hanning(window + 2)[1:-1]
    padded = np.pad(lowest, reach, mode="edge")
    return np.asarray(np.convolve(padded, hann / hann.sum(), mode="valid"))


def places_along(route: Route, arc_m: NDArrayFloat) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Position (K, 2), city frame, and yaw (K,), radians, unwrapped, at arc lengths (K,).

    The rear axle follows the line, so the yaw is the direction of its tangent.
    """
    spline = _spline(route)
    tangent = spline(arc_m, 1)
    return spline(arc_m), np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def _bend(route: Route) -> NDArrayFloat:
    """Largest curvature (N,), 1/m, of the driven curve about each of its points."""
    spline = _spline(route)
    at = np.linspace(0.0, route.length_m, 4 * (len(route.xy) - 1) + 1)
    first, second = spline(at, 1), spline(at, 2)
    cross = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    bend = cross / np.hypot(first[:, 0], first[:, 1]) ** 3
    around = np.lib.stride_tricks.sliding_window_view(np.pad(bend, 4, mode="edge"), 9)
    return np.asarray(around.max(axis=1)[::4])


def _spline(route: Route) -> Any:
    """The curve through the route's points that the vehicle drives, by arc length."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(np.arange(len(route.xy)) * route.step_m, route.xy)
