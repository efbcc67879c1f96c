"""Counting truth cells into the cells of coarser grids."""

from __future__ import annotations

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
    for r in range(codes.shape[0]):
        y = (row + r) // n
        for c in range(codes.shape[1]):
            kind = kinds[codes[r, c]]
            if kind < counts.shape[0]:
                counts[kind, y, (col + c) // n] += 1
