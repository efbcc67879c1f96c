"""Choosing the cells that a camera may see, compiled: most of a square around it is thrown away."""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayFloat


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def centres_in_view(
    centre: NDArrayFloat,
    resolution_m: float,
    reach_m: float,
    min_range_m: float,
    axis: NDArrayFloat,
    widest: float,
) -> NDArrayFloat:
    """City positions (N, 2) of the lattice's cell centres in a ring, and in a sector of it.

    Args:
        centre: (2,) middle of the ring, city metres.
        resolution_m: Cell size.
        reach_m: Outer and
        min_range_m: inner radius.
        axis: (2,) unit, the sector's middle.
        widest: Cosine of half the sector; -2 for all around.
    """
    middle_x, middle_y = np.floor(centre[0] / resolution_m), np.floor(centre[1] / resolution_m)
    first, last = -(reach_m // resolution_m) - 1.0, reach_m // resolution_m + 1.0
    side = int(last - first) + 1
    found = np.empty((side * side, 2))
    n = 0
    for row in range(side):
        y = (middle_y + (first + row) + 0.5) * resolution_m
        dy = y - centre[1]
        for column in range(side):
            x = (middle_x + (first + column) + 0.5) * resolution_m
            dx = x - centre[0]
            distance = np.sqrt(dx * dx + dy * dy)
            if distance > reach_m or distance < min_range_m:
                continue
            if dx * axis[0] + dy * axis[1] >= widest * distance:
                found[n, 0], found[n, 1] = x, y
                n += 1
    return found[:n].copy()
