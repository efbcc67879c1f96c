"""Counting truth cells into the cells of coarser grids."""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayAny, NDArrayByte


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def count_into(
    counts: NDArrayAny, codes: NDArrayByte, kinds: NDArrayByte, row: int, col: int, n: int
) -> None:
    """Add to counts (kind, y, x) how many cells of each kind lie in each block of n by n.

    Args:
        counts: (K, rows, cols) int32, changed in place.
        codes: (R, C) uint8 of the fine cells.
        kinds: (256,) uint8 from code to kind; those of K and above are not counted.
        row: Where codes[0, 0] lies, in fine cells from the corner of counts.
        col: The same along the other axis.
        n: Fine cells a coarse one, along each axis.
    """
    height, width = codes.shape
    # One block after another: its counts stay at hand, and nothing is divided in the inmost loop.
    of_kind = np.zeros(256, dtype=np.int32)
    for y in range(row // n, (row + height - 1) // n + 1):
        first_row, last_row = max(y * n - row, 0), min((y + 1) * n - row, height)
        for x in range(col // n, (col + width - 1) // n + 1):
            first_col, last_col = max(x * n - col, 0), min((x + 1) * n - col, width)
            for r in range(first_row, last_row):
                for c in range(first_col, last_col):
                    of_kind[kinds[codes[r, c]]] += 1
            for kind in range(counts.shape[0]):
                counts[kind, y, x] += of_kind[kind]
                of_kind[kind] = 0
            of_kind[255] = 0
