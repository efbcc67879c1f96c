"""A line a vehicle can drive: bends without kinks, no tighter than it steers, inside its lanes."""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.geometry.polyline import arc_lengths, drop_repeats, resample
from hdmap_tools.types import NDArrayBool, NDArrayFloat

MIN_RADIUS_M: Final = 5.0
"""Of the rear axle of a passenger car at full lock."""
_SPREAD_M: Final = (2.0, 3.0, 4.5, 6.5)
_CLEAR_M: Final = 0.4


def smoothed(line: NDArrayFloat, half_width_m: NDArrayFloat, step_m: float) -> NDArrayFloat:
    """The line with continuous curvature, as near to itself as its bends allow.

    Least squares between distance to the line and the third derivative. It is repeated with
    a wider spread around bends below `MIN_RADIUS_M`, and with a narrower one where the
    result would come nearer than 0.4 m to the edge of its lane.

    Args:
        line: (N, 2) metres.
        half_width_m: (N,) room to either side.
        step_m: Between the vertices of the result.

    Returns:
        (K, 2) evenly spaced; both ends stay within millimetres.

    Source:
        P. H. C. Eilers, A perfect smoother, Analytical Chemistry 75 (2003), third order.
    """
    joined = drop_repeats(np.column_stack([line, half_width_m]), 1e-3)
    even = resample(joined, step_m)
    points, room_m = even[:, :2], np.maximum(even[:, 2] - _CLEAR_M, 0.05)
    if len(points) < 8:
        return np.asarray(points)
    spread_m = np.full(len(points), _SPREAD_M[0])
    result = _fit(points, spread_m, step_m)
    for wider in _SPREAD_M[1:]:
        tight = np.abs(curvature(result)) > 1.0 / MIN_RADIUS_M
        if not tight.any():
            break
        spread_m = np.where(_near(tight, 3.0 * wider, step_m), wider, spread_m)
        result = _fit(points, spread_m, step_m)
    for _ in range(6):
        outside = np.linalg.norm(result - points, axis=1) > room_m
        if not outside.any():
            break
        spread_m = np.where(_near(outside, 2.0, step_m), spread_m * 0.7, spread_m)
        result = _fit(points, spread_m, step_m)
    return resample(result, step_m)


def curvature(points: NDArrayFloat) -> NDArrayFloat:
    """Signed curvature (N,) of an evenly spaced line (N, 2), 1/m, positive to the left."""
    first = np.gradient(points, axis=0)
    second = np.gradient(first, axis=0)
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    bend = cross / np.maximum(np.hypot(first[:, 0], first[:, 1]) ** 3, 1e-12)
    bend[:2], bend[-2:] = bend[2 % len(bend)], bend[-3 % len(bend)]  # one-sided differences lie
    return np.asarray(bend)


def _fit(points: NDArrayFloat, spread_m: NDArrayFloat, step_m: float) -> NDArrayFloat:
    """Minimize |p - points|² + Σ (spread / step)⁶ |third difference|²; the ends are held."""
    from scipy.linalg import solveh_banded

    count = len(points)
    stiffness = (spread_m[1:-2] / step_m) ** 6
    weight = np.ones(count)
    weight[[0, -1]] = 1e8
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    upper = np.zeros((4, count))
    upper[3] = weight
    for i in range(4):
        for j in range(i, 4):
            upper[3 - (j - i), j : j + count - 3] += stencil[i] * stencil[j] * stiffness
    return np.asarray(solveh_banded(upper, weight[:, None] * points))


def _near(flags: NDArrayBool, reach_m: float, step_m: float) -> NDArrayBool:
    """Whether a flag is set within a distance along the line."""
    reach = round(reach_m / step_m)
    sums = np.cumsum(np.concatenate([[0], flags]))
    at = np.arange(len(flags))
    return np.asarray(
        sums[np.minimum(at + reach + 1, len(flags))] > sums[np.maximum(at - reach, 0)]
    )


def between(left: NDArrayFloat, right: NDArrayFloat) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Middle (N, 2) of two bounds of a lane, about 0.5 m apart, and half its width (N,).

    Points of the bounds are paired by their share of the length.
    """
    count = max(round(max(arc_lengths(left)[-1], arc_lengths(right)[-1]) / 0.5), 1) + 1
    at = np.linspace(0.0, 1.0, count)
    sides = []
    for bound in (left, right):
        share = arc_lengths(bound)
        share = share / max(float(share[-1]), 1e-12)
        sides.append(np.column_stack([np.interp(at, share, bound[:, k]) for k in range(2)]))
    return (sides[0] + sides[1]) / 2.0, np.linalg.norm(sides[0] - sides[1], axis=1) / 2.0
