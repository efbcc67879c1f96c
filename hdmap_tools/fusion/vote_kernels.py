"""Counting points by cell and channel, compiled; the plain form is in `voting`."""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayAny, NDArrayInt

MAX_BOX_CELLS: Final = 2**24
"""Largest box of cells that is counted in; 64 MB of indices."""

MAX_COUNTS: Final = 2**25
"""Most cell and channel pairs; 128 MB of counts."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def _cells_in_box(
    x: NDArrayInt, y: NDArrayInt, x0: int, y0: int, width: int, height: int
) -> tuple[NDArrayAny, int]:
    """Number of each occupied cell of the box (width, height), by x and then y; -1 elsewhere."""
    number = np.full(width * height, -1, dtype=np.int32)
    for i in range(len(x)):
        number[(x[i] - x0) * height + y[i] - y0] = 0
    count = 0
    for i in range(len(number)):
        if number[i] == 0:
            number[i] = count
            count += 1
    return number, count


@njit(cache=True)  # type: ignore[untyped-decorator]
def _count(
    x: NDArrayInt,
    y: NDArrayInt,
    channel: NDArrayInt,
    x0: int,
    y0: int,
    height: int,
    number: NDArrayAny,
    counts: NDArrayAny,
) -> int:
    """Fill counts (cell, channel); gives how many are above zero."""
    rows = 0
    for i in range(len(x)):
        cell = number[(x[i] - x0) * height + y[i] - y0]
        if counts[cell, channel[i]] == 0:
            rows += 1
        counts[cell, channel[i]] += 1
    return rows


@njit(cache=True)  # type: ignore[untyped-decorator]
def _listed(counts: NDArrayAny, rows: int) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt]:
    """Cell, channel and number of points of each count above zero, in that order."""
    cell = np.empty(rows, dtype=np.int64)
    channel = np.empty(rows, dtype=np.int64)
    points = np.empty(rows, dtype=np.int64)
    row = 0
    for c in range(counts.shape[0]):
        for k in range(counts.shape[1]):
            if counts[c, k] > 0:
                cell[row], channel[row], points[row] = c, k, counts[c, k]
                row += 1
    return cell, channel, points


def tally(
    cells: NDArrayInt, channels: NDArrayInt
) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt, NDArrayInt] | None:
    """Points by cell and channel, without sorting.

    Args:
        cells: (N, 2) int64 lattice cells, N at least 1.
        channels: (N,) int64, not negative.

    Returns:
        Occupied cells (C, 2) by x and then y; and for each cell and channel with a
        point, by cell and then channel: index of the cell, channel, number of points.
        None where the points are spread so widely that sorting them takes less memory.
    """
    low, high = cells.min(axis=0), cells.max(axis=0)
    width, height = (int(n) for n in high - low + 1)
    if width * height > MAX_BOX_CELLS:
        return None
    x, y = np.ascontiguousarray(cells[:, 0]), np.ascontiguousarray(cells[:, 1])
    number, occupied = _cells_in_box(x, y, int(low[0]), int(low[1]), width, height)
    num_channels = int(channels.max()) + 1
    if occupied * num_channels > MAX_COUNTS:
        return None
    counts = np.zeros((occupied, num_channels), dtype=np.int32)
    rows = _count(x, y, channels, int(low[0]), int(low[1]), height, number, counts)
    cell, channel, points = _listed(counts, rows)
    flat = np.flatnonzero(number >= 0)
    unique_cells = np.column_stack([flat // height, flat % height]) + low
    return unique_cells, cell, channel, points
