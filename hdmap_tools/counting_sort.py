"""Sorting by small whole numbers: cells of a tile, tiles around a sweep. In time linear in their number."""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayInt


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def counting_sort(keys: NDArrayInt, size: int) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt]:
    """Order of keys, those alike in their own order.

    Args:
        keys: (N,) 0 to size - 1; those below 0 are left out.
        size: Number of possible keys.

    Returns:
        Rows (M,) by key, the keys that occur (K,), and where in the rows each begins (K + 1,).
    """
    first = np.zeros(size + 1, dtype=np.int64)
    for i in range(len(keys)):
        if keys[i] >= 0:
            first[keys[i] + 1] += 1
    num = 0
    for k in range(size):
        num += first[k + 1] > 0
        first[k + 1] += first[k]
    found, starts = np.empty(num, dtype=np.int64), np.empty(num + 1, dtype=np.int64)
    num = 0
    for k in range(size):
        if first[k + 1] > first[k]:
            found[num], starts[num] = k, first[k]
            num += 1
    starts[num] = first[size]
    order = np.empty(first[size], dtype=np.int64)
    for i in range(len(keys)):
        if keys[i] >= 0:
            order[first[keys[i]]] = i
            first[keys[i]] += 1
    return order, found, starts
