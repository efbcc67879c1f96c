"""The ground under a sweep, compiled: low returns by cell, and heights between samples.

The plain forms are a sort and a k-d tree, which the tests hold these equal to, bit for
bit; they take four and six times as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayFloat, NDArrayInt

_BIN_M = 1.0
_NEIGHBOURS = 6


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def low_heights(cell: NDArrayInt, heights: NDArrayFloat, num_cells: int) -> NDArrayFloat:
    """A low height of each cell: the 10th percentile, robust to single returns from below.

    Args:
        cell: (N,) cell of each return, 0 to num_cells - 1.
        heights: (N,) metres, none of them NaN.
        num_cells: Cells.

    Returns:
        (num_cells,) metres; NaN where a cell is empty.
    """
    starts = np.zeros(num_cells + 1, dtype=np.int64)
    for i in range(len(cell)):
        starts[cell[i] + 1] += 1
    for k in range(num_cells):
        starts[k + 1] += starts[k]
    by_cell = np.empty(len(cell))
    filled = starts[:-1].copy()
    for i in range(len(cell)):
        by_cell[filled[cell[i]]] = heights[i]
        filled[cell[i]] += 1
    low = np.full(num_cells, np.nan)
    for k in range(num_cells):
        count = starts[k + 1] - starts[k]
        if count > 0:
            part = by_cell[starts[k] : starts[k + 1]]
            low[k] = np.partition(part, count // 10)[count // 10]
    return low


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def sorted_into_bins(
    samples: NDArrayFloat,
) -> tuple[NDArrayFloat, NDArrayInt, tuple[float, float], tuple[int, int]]:
    """Samples by bins of 1 m, so that those near a place are found without a tree.

    Args:
        samples: (N, 3) metres, N at least 1.

    Returns:
        Samples (N, 3) by bin, where each bin's begin (columns * rows + 1,), the corner of
        the first bin, and the number of columns and rows.
    """
    x0, y0 = np.floor(samples[:, 0].min()), np.floor(samples[:, 1].min())
    columns = int((samples[:, 0].max() - x0) // _BIN_M) + 1
    rows = int((samples[:, 1].max() - y0) // _BIN_M) + 1
    of_sample = np.empty(len(samples), dtype=np.int64)
    starts = np.zeros(columns * rows + 1, dtype=np.int64)
    for i in range(len(samples)):
        column, row = int((samples[i, 0] - x0) // _BIN_M), int((samples[i, 1] - y0) // _BIN_M)
        of_sample[i] = column * rows + row
        starts[of_sample[i] + 1] += 1
    for k in range(columns * rows):
        starts[k + 1] += starts[k]
    ordered = np.empty_like(samples)
    filled = starts[:-1].copy()
    for i in range(len(samples)):
        ordered[filled[of_sample[i]]] = samples[i]
        filled[of_sample[i]] += 1
    return ordered, starts, (x0, y0), (columns, rows)


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def heights_between(
    xy: NDArrayFloat,
    samples: NDArrayFloat,
    starts: NDArrayInt,
    corner: tuple[float, float],
    shape: tuple[int, int],
    reach_m: float,
) -> NDArrayFloat:
    """Height at positions: the mean of the six nearest samples, nearer ones counting more.

    Args:
        xy: (N, 2 or 3) metres.
        samples: With
        starts: and
        corner: and
        shape: what `sorted_into_bins` gave.
        reach_m: Further than this from every sample nothing is known.

    Returns:
        (N,) metres, NaN out of reach.
    """
    result = np.full(len(xy), np.nan)
    columns, rows = shape
    wanted = min(_NEIGHBOURS, len(samples))
    near = np.empty(_NEIGHBOURS)
    height = np.empty(_NEIGHBOURS)
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        at_x, at_y = np.floor((x - corner[0]) / _BIN_M), np.floor((y - corner[1]) / _BIN_M)
        # So far outside that the samples are out of reach; and numbers that are no index.
        far = np.ceil(reach_m / _BIN_M)
        if not (-far - 1 <= at_x <= columns + far and -far - 1 <= at_y <= rows + far):
            continue
        column, row = int(at_x), int(at_y)
        found = 0
        ring = 0
        while True:
            for c in range(max(column - ring, 0), min(column + ring + 1, columns)):
                # Inside the ring only the first and the last row are new.
                step = 1 if abs(c - column) == ring else max(2 * ring, 1)
                for r in range(row - ring, row + ring + 1, step):
                    if r < 0 or r >= rows:
                        continue
                    for k in range(starts[c * rows + r], starts[c * rows + r + 1]):
                        dx, dy = x - samples[k, 0], y - samples[k, 1]
                        squared = dx * dx + dy * dy
                        if found == wanted and squared >= near[wanted - 1]:
                            continue
                        place = min(found, wanted - 1)
                        while place > 0 and near[place - 1] > squared:
                            near[place], height[place] = near[place - 1], height[place - 1]
                            place -= 1
                        near[place], height[place] = squared, samples[k, 2]
                        found = min(found + 1, wanted)
            # Everything nearer than this lies in the rings looked at.
            clear = ring * _BIN_M + min(
                min(x - corner[0] - column * _BIN_M, (column + 1) * _BIN_M + corner[0] - x),
                min(y - corner[1] - row * _BIN_M, (row + 1) * _BIN_M + corner[1] - y),
            )
            clear = max(clear - 1e-6, 0.0)
            if found == wanted and near[wanted - 1] <= clear * clear:
                break
            if found == 0 and clear > reach_m:
                break
            if ring > columns + rows + 2 * far:
                break
            ring += 1
        if found == 0 or np.sqrt(near[0]) > reach_m:
            continue
        top = bottom = 0.0
        for k in range(found):
            from_sample = np.sqrt(near[k]) + 0.1
            weight = 1.0 / (from_sample * from_sample)
            top += weight * height[k]
            bottom += weight
        result[i] = top / bottom
    return result
