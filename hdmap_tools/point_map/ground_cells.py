"""The ground of a tile: heights smoothed over little more than a hand, and how rough it is.

A height error of 2 cm moves a label by 19 cm at 15 m, and so does smoothing across a
kerb: ground points are put onto the plane through their neighbours within 7.5 cm,
further only where those are few, and neighbours on another level do not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayFloat, NDArrayInt

_REACHES_MM: Final = (75.0, 150.0, 300.0)
_ENOUGH_WEIGHT: Final = 12.0
"""Returns near the vehicle that make a height good to a few millimetres."""
_LEVEL_MM: Final = 60.0
"""Ground further above or below than this is another level: a kerb is 80 to 150 mm high."""
_AT_ONCE: Final = 16
_BIN_MM: Final = 75
"""As the first reach, at which most points stop looking: of those in the nine bins around
a point a third are within it."""


@dataclass(frozen=True, eq=False)
class SmoothGround:
    """Heights of ground points on their local surface, and the ground by cell.

    Attributes:
        height_mm: (N,) float64 of each ground point.
        cells: (M,) cells with ground, ascending.
        cell_height_mm, roughness_mm: (M,) float64; height at the cell's mean ground position.
        cell_points: (M,) ground points in it.
    """

    height_mm: NDArrayFloat
    cells: NDArrayInt
    cell_height_mm: NDArrayFloat
    roughness_mm: NDArrayFloat
    cell_points: NDArrayInt


def smooth_ground(
    points_mm: NDArrayFloat, weight: NDArrayFloat, cell: NDArrayInt, num_cells: int
) -> SmoothGround:
    """Smooth the heights of a tile's ground points.

    Args:
        points_mm: (N, 3) float64 from the tile's corner.
        weight: (N,) of each height: returns behind it, less for those from afar.
        cell: (N,) cell of each.
        num_cells: Cells of the tile.
    """
    if len(points_mm) == 0:
        none, no_cell = np.zeros(0), np.zeros(0, np.int64)
        return SmoothGround(none, no_cell, none, none, no_cell)
    binned = _in_bins(points_mm, weight)
    height, residual = _on_local_planes(*binned, np.array(_REACHES_MM))
    number, mean, scatter = _by_cell(cell, weight, height, residual, num_cells)
    seen = np.flatnonzero(number)
    return SmoothGround(height, seen, mean[seen], scatter[seen], number[seen])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _in_bins(
    points: NDArrayFloat, weight: NDArrayFloat
) -> tuple[NDArrayInt, NDArrayFloat, NDArrayInt, int]:
    """Points (N, 3), millimetres, sorted by square bins.

    Returns:
        Rows (N,) by bin; x, y, z and weight (4, N) in that order; where each bin, row by row,
        begins (bins + 1,); and how many bins there are in a row.
    """
    count = len(points)
    bins = np.empty((count, 2), dtype=np.int64)
    low, high = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64)
    for i in range(count):
        for axis in range(2):
            at = np.int64(np.floor(points[i, axis] / _BIN_MM))
            bins[i, axis] = at
            low[axis] = at if i == 0 else min(at, low[axis])
            high[axis] = at if i == 0 else max(at, high[axis])
    columns = high[0] - low[0] + 1
    starts = np.zeros((high[1] - low[1] + 1) * columns + 1, dtype=np.int64)
    for i in range(count):
        starts[(bins[i, 1] - low[1]) * columns + bins[i, 0] - low[0] + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    next_of = starts.copy()
    order, ordered = np.empty(count, dtype=np.int64), np.empty((4, count))
    for i in range(count):
        of_bin = (bins[i, 1] - low[1]) * columns + bins[i, 0] - low[0]
        at = next_of[of_bin]
        next_of[of_bin] += 1
        order[at] = i
        ordered[0, at], ordered[1, at] = points[i, 0], points[i, 1]
        ordered[2, at], ordered[3, at] = points[i, 2], weight[i]
    return order, ordered, starts, columns


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _on_local_planes(
    order: NDArrayInt,
    ordered: NDArrayFloat,
    starts: NDArrayInt,
    columns: int,
    reaches: NDArrayFloat,
) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Height (N,) of each point on the plane through its neighbours, and its own distance from it."""
    count = len(order)
    rows = (len(starts) - 1) // columns
    x, y, z, weight = ordered[0], ordered[1], ordered[2], ordered[3]
    before = np.zeros(count + 1)
    for i in range(count):
        before[i + 1] = before[i] + weight[i]
    height, residual, is_done = np.empty(count), np.empty(count), np.zeros(count, dtype=np.bool_)
    near_x, near_y = np.empty(count + _AT_ONCE), np.empty(count + _AT_ONCE)
    near_z, near_weight = np.empty(count + _AT_ONCE), np.empty(count + _AT_ONCE)
    for own in range(rows * columns):
        num_left = starts[own + 1] - starts[own]
        if num_left == 0:
            continue
        own_row, own_column = own // columns, own % columns
        for k in range(len(reaches)):
            span = int(np.ceil(reaches[k] / _BIN_MM))
            left, right = max(own_column - span, 0), min(own_column + span + 1, columns)
            top, bottom = max(own_row - span, 0), min(own_row + span + 1, rows)
            number, most = 0, 0.0
            for row in range(top * columns, bottom * columns, columns):
                number += starts[row + right] - starts[row + left]
                most += before[starts[row + right]] - before[starts[row + left]]
            if most < _ENOUGH_WEIGHT - 0.01 and k < len(reaches) - 1:
                continue
            padded = -(-number // _AT_ONCE) * _AT_ONCE
            # Next to each other, and filled up by some that weigh nothing.
            number = 0
            for row in range(top * columns, bottom * columns, columns):
                for j in range(starts[row + left], starts[row + right]):
                    near_x[number], near_y[number] = x[j], y[j]
                    near_z[number], near_weight[number] = z[j], weight[j]
                    number += 1
            for j in range(number, padded):
                near_x[j] = near_y[j] = near_z[j] = near_weight[j] = 0.0
            r2 = reaches[k] * reaches[k]
            for i in range(starts[own], starts[own + 1]):
                if is_done[i]:
                    continue
                s, sx, sy, sz, sxx, sxy, syy, sxz, syz = _sums_about(
                    x[i], y[i], z[i], near_x, near_y, near_z, near_weight, padded, r2
                )
                mx, my, mz = sx / s, sy / s, sz / s
                prior = 0.02 * r2 * s
                cxx, cyy, cxy = (
                    sxx - s * mx * mx + prior,
                    syy - s * my * my + prior,
                    sxy - s * mx * my,
                )
                cxz, cyz = sxz - s * mx * mz, syz - s * my * mz
                det = cxx * cyy - cxy * cxy
                a, b = (cxz * cyy - cyz * cxy) / det, (cyz * cxx - cxz * cxy) / det
                fitted = z[i] + mz - a * mx - b * my if s > 0.0 else z[i]
                height[order[i]] = fitted
                residual[order[i]] = z[i] - fitted
                if s >= _ENOUGH_WEIGHT:
                    is_done[i] = True
                    num_left -= 1
            if num_left == 0:
                break
    return height, residual


# In any order, so that they are added by eights: it changes a height by a millionth of a millionth.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz"})  # type: ignore[untyped-decorator]
def _sums_about(
    x0: float,
    y0: float,
    z0: float,
    x: NDArrayFloat,
    y: NDArrayFloat,
    z: NDArrayFloat,
    weight: NDArrayFloat,
    number: int,
    r2: float,
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Sums of weights, and weighted by them of x, y, z, xx, xy, yy, xz, yz, about a point.

    Of the first `number` points, those on the level of that point, and within a reach of
    which `r2` is the square; those further off weigh less. Slopes are held towards 0 by a
    prior that matters only where the neighbours lie nearly on a line.
    """
    s = sx = sy = sz = sxx = sxy = syy = sxz = syz = 0.0
    for j in range(number // _AT_ONCE * _AT_ONCE):
        dx, dy, dz = x[j] - x0, y[j] - y0, z[j] - z0
        d2 = dx * dx + dy * dy
        w = weight[j] * (1.0 - 0.5 * d2 / r2)
        w = w if (d2 <= r2) & (abs(dz) <= _LEVEL_MM) else 0.0
        wx, wy = w * dx, w * dy
        s += w
        sx += wx
        sy += wy
        sz += w * dz
        sxx += wx * dx
        sxy += wx * dy
        syy += wy * dy
        sxz += wx * dz
        syz += wy * dz
    return s, sx, sy, sz, sxx, sxy, syy, sxz, syz


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _by_cell(
    cell: NDArrayInt,
    weight: NDArrayFloat,
    height: NDArrayFloat,
    residual: NDArrayFloat,
    num_cells: int,
) -> tuple[NDArrayInt, NDArrayFloat, NDArrayFloat]:
    """Of each cell (num_cells,) its points, their weighted mean height, and scatter about their planes."""
    number = np.zeros(num_cells, dtype=np.int64)
    total, mean, scatter = np.zeros(num_cells), np.zeros(num_cells), np.zeros(num_cells)
    for i in range(len(cell)):
        c, w = cell[i], weight[i]
        number[c] += 1
        total[c] += w
        mean[c] += w * height[i]
        scatter[c] += w * (residual[i] * residual[i])
    for c in range(num_cells):
        mean[c] /= max(total[c], 1e-9)
        scatter[c] = np.sqrt(scatter[c] / max(total[c], 1e-9))
    return number, mean, scatter
