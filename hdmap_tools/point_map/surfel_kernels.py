"""Compiled loops over the points and surfaces of pose refinement; imported lazily."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numba import njit

from hdmap_tools.types import NDArrayFloat, NDArrayInt

NDArrayInt32: TypeAlias = npt.NDArray[np.int32]

Moments = tuple[NDArrayInt, NDArrayFloat, NDArrayFloat]
Observed = tuple[NDArrayInt, NDArrayInt, NDArrayFloat, NDArrayFloat]


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def pooled_moments(
    points: NDArrayFloat,
    weights: NDArrayFloat,
    sweeps: NDArrayInt,
    visits: NDArrayInt,
    order: NDArrayInt,
    starts: NDArrayInt,
) -> Moments:
    """Number of sweeps, mean and covariance of each voxel's points.

    The covariance is taken about the mean of each visit: two visits whose poses
    disagree would otherwise make a thick wall of a thin one.
    """
    count = len(starts) - 1
    total = np.zeros(count)
    num_sweeps = np.zeros(count, np.int64)
    mean = np.zeros((count, 3))
    covariance = np.zeros((count, 3, 3))
    for v in range(count):
        a = starts[v]
        while a < starts[v + 1]:
            b = a
            weight = 0.0
            centre = np.zeros(3)
            last = -1
            while b < starts[v + 1] and visits[sweeps[order[b]]] == visits[sweeps[order[a]]]:
                i = order[b]
                weight += weights[i]
                for k in range(3):
                    centre[k] += weights[i] * points[i, k]
                if sweeps[i] != last:
                    num_sweeps[v] += 1
                    last = sweeps[i]
                b += 1
            for k in range(3):
                mean[v, k] += centre[k]
                centre[k] /= weight
            total[v] += weight
            for at in range(a, b):
                i = order[at]
                for k in range(3):
                    dk = weights[i] * (points[i, k] - centre[k])
                    for m in range(k + 1):
                        covariance[v, k, m] += dk * (points[i, m] - centre[m])
            a = b
        for k in range(3):
            mean[v, k] /= total[v]
            for m in range(k + 1):
                covariance[v, k, m] /= total[v]
                covariance[v, m, k] = covariance[v, k, m]
    return num_sweeps, mean, covariance


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def observe(
    points: NDArrayFloat,
    weights: NDArrayFloat,
    sweeps: NDArrayInt,
    order: NDArrayInt,
    firsts: NDArrayInt,
    lasts: NDArrayInt,
) -> Observed:
    """One observation for each sweep that saw a surface: its mean point there.

    Args:
        points: (M, 3).
        weights: (M,).
        sweeps: (M,), not decreasing.
        order: Points by voxel, sweeps in order within it.
        firsts: (V,) where each surface's points begin in `order`.
        lasts: (V,) where they end.

    Returns:
        Surface (O,), sweep (O,), weight (O,) and mean point (O, 3) of each observation.
    """
    num = 0
    for v in range(len(firsts)):
        last = -1
        for at in range(firsts[v], lasts[v]):
            if sweeps[order[at]] != last:
                num += 1
                last = sweeps[order[at]]
    surface = np.empty(num, np.int64)
    sweep = np.empty(num, np.int64)
    weight = np.zeros(num)
    mean = np.zeros((num, 3))
    o = -1
    for v in range(len(firsts)):
        last = -1
        for at in range(firsts[v], lasts[v]):
            i = order[at]
            if sweeps[i] != last:
                o += 1
                last = sweeps[i]
                surface[o] = v
                sweep[o] = last
            weight[o] += weights[i]
            for k in range(3):
                mean[o, k] += weights[i] * points[i, k]
    for o in range(num):
        for k in range(3):
            mean[o, k] /= weight[o]
    return surface, sweep, weight, mean


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def weigh(
    starts: NDArrayInt,
    residuals: NDArrayFloat,
    information: NDArrayFloat,
    robust_m: float,
) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Robust weights (O,) of observations, and each surface's offset (V,) along its normal.

    Geman-McClure, about the surface's weighted mean: what is off by several times
    `robust_m` (something moved, another surface) has no say.
    """
    weights = information.copy()
    offsets = np.zeros(len(starts) - 1)
    for v in range(len(starts) - 1):
        for _ in range(4):
            top = 0.0
            bottom = 1e-30
            for o in range(starts[v], starts[v + 1]):
                top += weights[o] * residuals[o]
                bottom += weights[o]
            centre = top / bottom
            for o in range(starts[v], starts[v + 1]):
                share = (residuals[o] - centre) / robust_m
                weights[o] = information[o] / (1.0 + share * share) ** 2
        top = 0.0
        bottom = 1e-30
        for o in range(starts[v], starts[v + 1]):
            top += weights[o] * residuals[o]
            bottom += weights[o]
        offsets[v] = top / bottom
    return weights, offsets


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def informations(
    starts: NDArrayInt,
    sweep: NDArrayInt,
    surface: NDArrayInt,
    arms: NDArrayFloat,
    weights: NDArrayFloat,
    normals: NDArrayFloat,
    tilts: NDArrayFloat,
    num_sweeps: int,
    is_fixed: bool,
) -> NDArrayFloat:
    """What each sweep knows of its pose (S, 6, 6) from the surfaces that others saw too.

    A normal estimated from noisy points is tilted at random, and its square is
    counted as knowledge of a direction that holds nothing; the expected part of it
    is taken off.

    Args:
        starts: (V + 1,) observations of each surface; ignored when `is_fixed`.
        sweep: (O,).
        surface: (O,).
        arms: (O, 3) from the vehicle to the point, city axes.
        weights: (O,) one over variance.
        normals: (V, 3).
        tilts: (V, 2, 3) tangents scaled by the sigma of the normal's tilt.
        num_sweeps: S.
        is_fixed: The surfaces are known: a sweep's own part is not taken off.
    """
    result = np.zeros((num_sweeps, 6, 6))
    row = np.empty(6)
    for v in range(1 if is_fixed else len(starts) - 1):
        first = 0 if is_fixed else starts[v]
        last = len(sweep) if is_fixed else starts[v + 1]
        total = 1e-30
        for o in range(first, last):
            total += weights[o]
        for o in range(first, last):
            w = weights[o]
            if not is_fixed:
                w -= w * w / total
            for part in range(3):
                sign = w
                if part == 0:
                    n = normals[surface[o]]
                else:
                    n = tilts[surface[o], part - 1]
                    sign = -w
                row[:3] = n
                row[3] = arms[o, 1] * n[2] - arms[o, 2] * n[1]
                row[4] = arms[o, 2] * n[0] - arms[o, 0] * n[2]
                row[5] = arms[o, 0] * n[1] - arms[o, 1] * n[0]
                for k in range(6):
                    for m in range(6):
                        result[sweep[o], k, m] += sign * row[k] * row[m]
    return result


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def mark_pairs(starts: NDArrayInt, sweep: NDArrayInt, num_sweeps: int) -> NDArrayInt32:
    """Which sweeps (S, S) share a surface: the number of their block, or -1; upper half."""
    pairs = np.full((num_sweeps, num_sweeps), -1, np.int32)
    for v in range(len(starts) - 1):
        for a in range(starts[v], starts[v + 1]):
            for b in range(a, starts[v + 1]):
                pairs[sweep[a], sweep[b]] = 0
    num = 0
    for i in range(num_sweeps):
        for j in range(i, num_sweeps):
            if pairs[i, j] == 0 or i == j:
                pairs[i, j] = num
                num += 1
    return pairs


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def assemble(
    starts: NDArrayInt,
    sweep: NDArrayInt,
    jacobians: NDArrayFloat,
    weights: NDArrayFloat,
    residuals: NDArrayFloat,
    pairs: NDArrayInt32,
    num_blocks: int,
) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Normal equations of all sweeps, each surface's offset eliminated.

    Args:
        starts: (V + 1,) observations of each surface.
        sweep: (O,), ascending in each.
        jacobians: (O, 6).
        weights: (O,).
        residuals: (O,) metres, about the surface's offset.
        pairs: From `mark_pairs`.
        num_blocks: Of them.

    Returns:
        Blocks (B, 6, 6) of the upper half, and gradient (S, 6).
    """
    blocks = np.zeros((num_blocks, 6, 6))
    gradient = np.zeros((len(pairs), 6))
    for v in range(len(starts) - 1):
        total = 1e-30
        for o in range(starts[v], starts[v + 1]):
            total += weights[o]
        for a in range(starts[v], starts[v + 1]):
            i = sweep[a]
            own = weights[a]
            block = pairs[i, i]
            for k in range(6):
                gradient[i, k] += own * residuals[a] * jacobians[a, k]
                for m in range(6):
                    blocks[block, k, m] += own * jacobians[a, k] * jacobians[a, m]
            for b in range(a, starts[v + 1]):
                block = pairs[i, sweep[b]]
                share = own * weights[b] / total
                for k in range(6):
                    left = share * jacobians[a, k]
                    for m in range(6):
                        blocks[block, k, m] -= left * jacobians[b, m]
    return blocks, gradient
