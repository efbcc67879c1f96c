"""A sweep put where it was seen, compiled: one pass in place of a dozen arrays in between."""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayFloat, NDArrayInt


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def placed_within(
    points_ego: NDArrayFloat,
    rotation: NDArrayFloat,
    translation: NDArrayFloat,
    min_range_m: float,
    max_range_m: float,
) -> tuple[NDArrayInt, NDArrayFloat, NDArrayFloat, NDArrayFloat]:
    """Returns within a range of the ego origin, and their places in the city.

    Args:
        points_ego: (N, 3) metres.
        rotation: (3, 3), with
        translation: (3,) of ``city_SE3_ego``.
        min_range_m: With
        max_range_m: in x-y, both inclusive.

    Returns:
        Their rows (M,), ego and city positions (M, 3) and range (M,), metres.
    """
    count = len(points_ego)
    rows = np.empty(count, dtype=np.int64)
    ego, city = np.empty((count, 3)), np.empty((count, 3))
    range_m = np.empty(count)
    num = 0
    for i in range(count):
        x, y, z = points_ego[i, 0], points_ego[i, 1], points_ego[i, 2]
        away = np.sqrt(x * x + y * y)
        if not min_range_m <= away <= max_range_m:
            continue
        rows[num], range_m[num] = i, away
        ego[num, 0], ego[num, 1], ego[num, 2] = x, y, z
        for axis in range(3):
            city[num, axis] = (
                rotation[axis, 0] * x
                + rotation[axis, 1] * y
                + rotation[axis, 2] * z
                + translation[axis]
            )
        num += 1
    return rows[:num], ego[:num], city[:num], range_m[:num]
