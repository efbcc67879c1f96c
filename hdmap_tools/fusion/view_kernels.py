"""What a camera sees of a block of the map: its transforms, and which cells lie in its view.

Transforms are composed in float64 and rounded to float32 for each block, whose points count from
its corner.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayFloat, NDArrayFloat32, NDArrayInt

_SLACK: Final = 3e-3
"""Metres by which culling errs towards more: the float32 tests of each point decide."""
_MARGIN_PX: Final = 1.0
"""Cells are passed over where they lie so far outside of the image, and points of cells that lie so
far inside are not tested: float32 rounds by much less."""
_INNER_DEPTH_M: Final = 1.0
"""Points of nearer cells are tested, however far inside."""


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def view_at(
    city_SE3_ego: tuple[NDArrayFloat, NDArrayFloat],
    ego_SE3_cam: tuple[NDArrayFloat, NDArrayFloat],
    pinhole: tuple[float, float, float, float],
    size_px: tuple[int, int],
    clip_m: tuple[float, float, float],
    least_depth_m: float,
    is_distorted: bool,
) -> tuple[NDArrayFloat, NDArrayFloat, NDArrayFloat]:
    """A camera's transforms at an ego pose, and half spaces around and inside of what it is asked for.

    Args:
        city_SE3_ego: Rotation (3, 3) and translation (3,), metres.
        ego_SE3_cam: The camera's mount.
        pinhole: fx, fy, cx, cy.
        size_px: Width and height of the image.
        clip_m: How far ahead of the ego and to each side; and the least range from the camera.
        least_depth_m: What is nearer to the image plane is not seen.
        is_distorted: Whether the lens is more than a pinhole; culling then knows the clip alone.

    Returns:
        (5, 4) rows from the city into the ego frame (0 and 1) and the camera's (2 to 4); half spaces
        (P, 4), a x + b y + c z + d >= 0, that hold clip and view; half spaces (Q, 4) that both hold,
        none of a distorted lens.
    """
    rotation, translation = city_SE3_ego
    mount, place = ego_SE3_cam
    rows = np.zeros((5, 4))
    for j in range(3):
        for k in range(3):
            if j < 2:
                rows[j, k] = rotation[k, j]
            for m in range(3):
                rows[2 + j, k] += rotation[k, m] * mount[m, j]
    for k in range(3):
        at_camera = translation[k]
        for m in range(3):
            at_camera += rotation[k, m] * place[m]
        for j in range(2):
            rows[j, 3] -= rows[j, k] * translation[k]
        for j in range(2, 5):
            rows[j, 3] -= rows[j, k] * at_camera
    reach, across, least_range = clip_m
    fx, fy, cx, cy = pinhole
    num = 5 if is_distorted else 9
    planes, inner = np.empty((num, 4)), np.empty((0 if is_distorted else num, 4))
    # Loops over numbers: whole rows at once take many times as long to compile.
    for k in range(4):
        ahead, left, right, down, depth = rows[0, k], rows[1, k], rows[2, k], rows[3, k], rows[4, k]
        one = 1.0 if k == 3 else 0.0
        planes[0, k] = ahead
        planes[1, k] = depth - least_depth_m * one
        planes[2, k] = reach * one - ahead
        planes[3, k] = across * one - left
        planes[4, k] = across * one + left
        if is_distorted:
            continue
        inner[0, k] = ahead - max(0.0, place[0] + least_range) * one
        inner[1, k] = depth - _INNER_DEPTH_M * one
        for p in range(2, 5):
            inner[p, k] = planes[p, k]
        for half_spaces, margin in ((planes, 0.5 + _MARGIN_PX), (inner, 0.5 - _MARGIN_PX)):
            half_spaces[5, k] = fx * right + (cx + margin) * depth
            half_spaces[6, k] = fy * down + (cy + margin) * depth
            half_spaces[7, k] = (size_px[0] - 1 + margin - cx) * depth - fx * right
            half_spaces[8, k] = (size_px[1] - 1 + margin - cy) * depth - fy * down
    return rows, planes, inner


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _within(
    planes: NDArrayFloat, y0: float, y1: float, z_range: tuple[float, float], wholly: bool
) -> tuple[float, float]:
    """From where to where along x a row of cells may lie within half spaces, or does so wholly."""
    low, high = -np.inf, np.inf
    for p in range(len(planes)):
        a, b, c, d = planes[p, 0], planes[p, 1], planes[p, 2], planes[p, 3]
        if wholly:
            rest = min(b * y0, b * y1) + min(c * z_range[0], c * z_range[1]) + d - _SLACK
        else:
            rest = max(b * y0, b * y1) + max(c * z_range[0], c * z_range[1]) + d + _SLACK
        if a > 1e-9:
            low = max(low, -rest / a)
        elif a < -1e-9:
            high = min(high, -rest / a)
        elif rest < 0.0:
            high = -np.inf
    return low, high


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _rows_in_view(
    planes: NDArrayFloat,
    inner_planes: NDArrayFloat,
    z_range: tuple[float, float],
    resolution_m: float,
    row_starts: NDArrayInt,
    columns: NDArrayInt,
) -> NDArrayInt:
    """Cells of each row of a block that may lie within half spaces, and that surely do.

    Args:
        planes: (P, 4) a, b, c, d in the block's frame, inside where a x + b y + c z + d >= 0.
        inner_planes: (Q, 4) half spaces in which no point need be tested; none: all must be.
        z_range: Lowest and highest point of the block.
        resolution_m: Edge of a cell.
        row_starts: (R + 1,) first occupied cell of each row, rows along y.
        columns: (K,) column of each occupied cell, ascending in each row.

    Returns:
        (M, 3) half-open ranges of occupied cells, in order, none empty; the third is 1 where
        all of a range lies within the inner half spaces.
    """
    rows = len(row_starts) - 1
    found = np.empty((3 * rows, 3), dtype=np.int64)
    num = 0
    for row in range(rows):
        first, last = row_starts[row], row_starts[row + 1]
        if first == last:
            continue
        y0, y1 = row * resolution_m, (row + 1) * resolution_m
        low, high = _within(planes, y0, y1, z_range, False)
        if low > high:
            continue
        low, high = np.floor(low / resolution_m) - 1.0, np.floor(high / resolution_m) + 1.0
        while first < last and columns[first] < low:
            first += 1
        while last > first and columns[last - 1] > high:
            last -= 1
        low, high = -np.inf, -np.inf
        if len(inner_planes):
            low, high = _within(inner_planes, y0, y1, z_range, True)
        low, high = np.ceil(low / resolution_m), np.floor(high / resolution_m) - 1.0
        inner_first, inner_last = first, last
        while inner_first < last and columns[inner_first] < low:
            inner_first += 1
        while inner_last > inner_first and columns[inner_last - 1] > high:
            inner_last -= 1
        for k0, k1, is_inner in (
            (first, inner_first, 0),
            (inner_first, inner_last, 1),
            (inner_last, last, 0),
        ):
            if k0 < k1:
                found[num, 0], found[num, 1], found[num, 2] = k0, k1, is_inner
                num += 1
    return found[:num]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def view_of_block(
    rows: NDArrayFloat,
    planes: NDArrayFloat,
    inner_planes: NDArrayFloat,
    lens: NDArrayFloat,
    corner_city: NDArrayFloat,
    z_range_m: tuple[float, float],
    resolution_m: float,
    row_starts: NDArrayInt,
    columns: NDArrayInt,
) -> tuple[NDArrayFloat32, NDArrayInt]:
    """A view for points that count from a block's corner, in millimetres, and where it sees some.

    Args:
        rows: And
        planes: and
        inner_planes: of `view_at`.
        lens: (16,) see `frame_view.FrameView`.
        corner_city: (3,) of the block, metres.
        z_range_m: Lowest and highest point of the block, from its corner.
        resolution_m: Edge of a cell.
        row_starts: And
        columns: of `_rows_in_view`.

    Returns:
        (36,) rows, from millimetres to metres, and lens; and runs (M, 3) of `_rows_in_view`.
    """
    numbers = np.empty(36, dtype=np.float32)
    for j in range(5):
        shift = rows[j, 3]
        for k in range(3):
            numbers[4 * j + k] = np.float32(rows[j, k] / 1000.0)
            shift += rows[j, k] * corner_city[k]
        numbers[4 * j + 3] = np.float32(shift)
    for j in range(16):
        numbers[20 + j] = np.float32(lens[j])
    near, inside = planes.copy(), inner_planes.copy()
    for half_spaces in (near, inside):
        for p in range(len(half_spaces)):
            for k in range(3):
                half_spaces[p, 3] += half_spaces[p, k] * corner_city[k]
    return numbers, _rows_in_view(near, inside, z_range_m, resolution_m, row_starts, columns)
