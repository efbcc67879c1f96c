"""Which cells lie near a path, compiled: each point marks a run of cells in each row."""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayAny, NDArrayFloat


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def mark_near(x: NDArrayFloat, y: NDArrayFloat, path: NDArrayFloat, reach_m: float) -> NDArrayAny:
    """(rows, columns) int32, above 0 where a cell's centre is nearer than reach_m to a point.

    Args:
        x: (columns,) centres, ascending, metres.
        y: (rows,) centres, ascending, metres.
        path: (N, 2) points, metres.
        reach_m: Distance.
    """
    columns = len(x)
    near = np.zeros((len(y), columns), dtype=np.int32)
    # Where runs begin and end: a running sum makes them whole, however many overlap.
    steps = np.zeros((len(y), columns + 1), dtype=np.int32)
    squared = reach_m * reach_m
    for i in range(len(path)):
        px, py = path[i]
        low, high = np.searchsorted(y, py - reach_m), np.searchsorted(y, py + reach_m, side="right")
        for r in range(low, high):
            dy = y[r] - py
            if dy * dy >= squared:
                continue
            half = np.sqrt(squared - dy * dy)
            first, last = np.searchsorted(x, px - half), np.searchsorted(x, px + half)
            # The root is rounded: the distance itself decides at the ends.
            while first > 0 and (x[first - 1] - px) ** 2 + dy * dy < squared:
                first -= 1
            while first < columns and x[first] < px and (x[first] - px) ** 2 + dy * dy >= squared:
                first += 1
            while last < columns and (x[last] - px) ** 2 + dy * dy < squared:
                last += 1
            while last > first and (x[last - 1] - px) ** 2 + dy * dy >= squared:
                last -= 1
            if first < last:
                steps[r, first] += 1
                steps[r, last] -= 1
    for r in range(len(y)):
        total = 0
        for c in range(columns):
            total += steps[r, c]
            near[r, c] = total
    return near
