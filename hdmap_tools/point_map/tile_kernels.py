"""A tile's points from the sums of its voxels, compiled: one pass in place of a dozen arrays in between."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt

_WEIGHT_OF_ONE: Final = 64.0
"""What a return near the vehicle adds to the weight of its voxel."""


class ThinnedPoints(NamedTuple):
    """Points of a tile in order, and once more those on the ground, as they are to be smoothed.

    Attributes:
        columns_mm: (3, N) int32 x, y and z from the tile's corner.
        intensity: (N,) uint8.
        hits: (N,) int32.
        is_ground: (N,) bool.
        cell: (N,) uint16.
        ground_mm: (M, 3) float64, with
        ground_weight: (M,) float64, returns behind each, less for those from afar, and
        ground_cell: (M,) int64.
    """

    columns_mm: NDArrayAny
    intensity: NDArrayByte
    hits: NDArrayAny
    is_ground: NDArrayBool
    cell: NDArrayAny
    ground_mm: NDArrayFloat
    ground_weight: NDArrayFloat
    ground_cell: NDArrayInt


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator,unused-ignore]
def thinned_points(
    key: NDArrayInt, sums: NDArrayAny, left_out: NDArrayBool, voxel_mm: int
) -> ThinnedPoints:
    """Points of a tile's voxels but for those left out.

    Args:
        key: (N,) with
        sums: (N, 7) of `Voxels`, laid out as by `VoxelGrid`.
        left_out: (N,).
        voxel_mm: Edge of a voxel.
    """
    count, num_ground = 0, 0
    for i in range(len(key)):
        if not left_out[i]:
            count += 1
            num_ground += 2 * sums[i, 6] >= sums[i, 5]
    columns_mm = np.empty((3, count), dtype=np.int32)
    intensity, hits = np.empty(count, dtype=np.uint8), np.empty(count, dtype=np.int32)
    is_ground, cell = np.empty(count, dtype=np.bool_), np.empty(count, dtype=np.uint16)
    ground_mm, ground_weight = np.empty((num_ground, 3)), np.empty(num_ground)
    ground_cell = np.empty(num_ground, dtype=np.int64)
    at, on_ground = 0, 0
    for i in range(len(key)):
        if left_out[i]:
            continue
        weight = np.float64(sums[i, 0])
        x = ((key[i] >> 24) & 2047) * voxel_mm + sums[i, 1] / weight
        y = ((key[i] >> 35) & 2047) * voxel_mm + sums[i, 2] / weight
        z = ((key[i] & 16777215) - 8388608) * voxel_mm + sums[i, 3] / weight
        columns_mm[0, at], columns_mm[1, at] = np.rint(x), np.rint(y)
        columns_mm[2, at] = np.rint(z)
        intensity[at] = np.uint8(np.rint(sums[i, 4] / weight))
        hits[at], cell[at] = sums[i, 5], key[i] >> 46
        is_ground[at] = 2 * sums[i, 6] >= sums[i, 5]
        if is_ground[at]:
            ground_mm[on_ground, 0], ground_mm[on_ground, 1] = x, y
            ground_mm[on_ground, 2] = z
            ground_weight[on_ground], ground_cell[on_ground] = weight / _WEIGHT_OF_ONE, key[i] >> 46
            on_ground += 1
        at += 1
    return ThinnedPoints(
        columns_mm, intensity, hits, is_ground, cell, ground_mm, ground_weight, ground_cell
    )
