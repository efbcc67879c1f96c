"""Dense fusion, compiled: points sorted by cell, culled by cell, projected row by row, counted at once.

All arithmetic is float32 on coordinates within a block of the map, with transforms composed
in float64: a map 50 km from its origin loses nothing. Each expression is evaluated in the
order written, so that numpy in float32 gives the same bits (tests/fusion/dense_oracle.py).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayAny, NDArrayFloat, NDArrayFloat32, NDArrayInt

_SLACK: Final = 3e-3
"""Metres by which culling errs towards more: the float32 tests of each point decide."""
_ZERO: Final = np.float32(0.0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1.0)
_TWO: Final = np.float32(2.0)
_AT_ONCE: Final = 2048
"""Points whose pixels are kept at once: they stay in the fastest cache."""


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def in_block(
    points_city: NDArrayFloat,
    index: tuple[int, int],
    side: int,
    resolution_m: float,
    corner_mm: tuple[int, int],
) -> tuple[NDArrayInt, NDArrayInt]:
    """Cells of points in a block, and where they lie in it.

    Args:
        points_city: (N, 3) metres.
        index: Of the block.
        side: Its cells a side.
        resolution_m: Edge of a cell.
        corner_mm: South-west corner.

    Returns:
        (N,) ``y * side + x`` as `grid.cells_of` finds them, -1 outside of the block; and whole
        millimetres (N, 3), x and y from the corner, z in the city.
    """
    cells = np.full(len(points_city), -1, dtype=np.int64)
    local = np.empty((len(points_city), 3), dtype=np.int64)
    for i in range(len(points_city)):
        x, y = points_city[i, 0], points_city[i, 1]
        column = np.int64(np.floor(x / resolution_m)) - index[0] * side
        row = np.int64(np.floor(y / resolution_m)) - index[1] * side
        if 0 <= column < side and 0 <= row < side:
            cells[i] = row * side + column
        local[i, 0] = np.int64(np.rint(x * 1000.0)) - corner_mm[0]
        local[i, 1] = np.int64(np.rint(y * 1000.0)) - corner_mm[1]
        local[i, 2] = np.int64(np.rint(points_city[i, 2] * 1000.0))
    return cells, local


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def rows_in_view(
    planes: NDArrayFloat,
    z_range: tuple[float, float],
    resolution_m: float,
    row_starts: NDArrayInt,
    columns: NDArrayInt,
) -> NDArrayInt:
    """Cells of each row of a block that may lie within half spaces.

    Args:
        planes: (P, 4) a, b, c, d in the block's frame, inside where a x + b y + c z + d >= 0.
        z_range: Lowest and highest point of the block.
        resolution_m: Edge of a cell.
        row_starts: (R + 1,) first occupied cell of each row, rows along y.
        columns: (K,) column of each occupied cell, ascending in each row.

    Returns:
        (R, 2) half-open ranges of occupied cells.
    """
    rows = len(row_starts) - 1
    found = np.zeros((rows, 2), dtype=np.int64)
    for row in range(rows):
        first, last = row_starts[row], row_starts[row + 1]
        if first == last:
            continue
        low, high = -np.inf, np.inf
        y0, y1 = row * resolution_m, (row + 1) * resolution_m
        for p in range(len(planes)):
            a, b, c, d = planes[p, 0], planes[p, 1], planes[p, 2], planes[p, 3]
            rest = max(b * y0, b * y1) + max(c * z_range[0], c * z_range[1]) + d + _SLACK
            if a > 1e-9:
                low = max(low, -rest / a)
            elif a < -1e-9:
                high = min(high, -rest / a)
            elif rest < 0.0:
                high = -np.inf
        if low > high:
            continue
        low, high = np.floor(low / resolution_m) - 1.0, np.floor(high / resolution_m) + 1.0
        while first < last and columns[first] < low:
            first += 1
        while last > first and columns[last - 1] > high:
            last -= 1
        found[row, 0], found[row, 1] = first, last
    return found


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _project(
    xs: NDArrayAny,
    ys: NDArrayAny,
    zs: NDArrayFloat32,
    view: NDArrayFloat32,
    width: int,
    height: int,
    pixel: NDArrayAny,
    depth: NDArrayFloat32,
    is_distorted: bool,
) -> None:
    """Pixel of each point (row * width + column), or width * height where there is none; and depth.

    Args:
        xs: With
        ys: (N,) int16 and
        zs: (N,) float32 millimetres in the block's frame.
        view: (36,) as `dense_fusion.FrameView` fills it.
        width: With
        height: of the image.
        pixel: (N,) int32, filled.
        depth: (N,) filled.
        is_distorted: Whether the lens is more than a pinhole.
    """
    e00, e01, e02, e03 = view[0], view[1], view[2], view[3]
    e10, e11, e12, e13 = view[4], view[5], view[6], view[7]
    c00, c01, c02, c03 = view[8], view[9], view[10], view[11]
    c10, c11, c12, c13 = view[12], view[13], view[14], view[15]
    c20, c21, c22, c23 = view[16], view[17], view[18], view[19]
    fx, fy, cx, cy = view[20], view[21], view[22], view[23]
    k1, k2, p1, p2, k3 = view[24], view[25], view[26], view[27], view[28]
    ahead, across, nearest2 = view[29], view[30], view[31]
    camera_x, camera_y, least_depth, radius2 = view[32], view[33], view[34], view[35]
    right, below = np.float32(width), np.float32(height)
    none = np.int32(width * height)
    for i in range(len(xs)):
        x, y, z = np.float32(xs[i]), np.float32(ys[i]), zs[i]
        ex = e00 * x + e01 * y + e02 * z + e03
        ey = e10 * x + e11 * y + e12 * z + e13
        d = c20 * x + c21 * y + c22 * z + c23
        inverse = _ONE / d
        a = (c00 * x + c01 * y + c02 * z + c03) * inverse
        b = (c10 * x + c11 * y + c12 * z + c13) * inverse
        ok = (ex > _ZERO) & (ex <= ahead) & (abs(ey) <= across) & (d > least_depth)
        if is_distorted:
            r2 = a * a + b * b
            ok &= r2 <= radius2
            radial = _ONE + r2 * (k1 + r2 * (k2 + r2 * k3))
            tangent = a * b
            a, b = (
                a * radial + (_TWO * p1 * tangent + p2 * (r2 + _TWO * a * a)),
                b * radial + (p1 * (r2 + _TWO * b * b) + _TWO * p2 * tangent),
            )
        u = fx * a + cx + _HALF
        v = fy * b + cy + _HALF
        ok &= (u >= _ZERO) & (u < right) & (v >= _ZERO) & (v < below)
        gx, gy = ex - camera_x, ey - camera_y
        ok &= gx * gx + gy * gy >= nearest2
        at = np.int32(v if ok else _ZERO) * np.int32(width) + np.int32(u if ok else _ZERO)
        pixel[i] = at if ok else none
        depth[i] = d


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def see_block(
    x: NDArrayAny,
    y: NDArrayAny,
    z: NDArrayFloat32,
    bins: NDArrayAny,
    starts: NDArrayInt,
    runs: NDArrayInt,
    view: NDArrayFloat32,
    is_distorted: bool,
    size_px: tuple[int, int],
    labels: NDArrayAny,
    slot_of: NDArrayAny,
    hides_from_m: NDArrayFloat32,
    cell_px: int,
    slots: NDArrayAny,
) -> int:
    """The slot that an image gives each ground point of the runs; gives how many it saw.

    Args:
        x: With
        y: (N,) int16 and
        z: (N,) float32 millimetres in the block's frame, by cell.
        bins: (N,) uint8 intensity bin.
        starts: (K + 1,) first point of each cell.
        runs: (R, 2) ranges of cells.
        view: See `_project`.
        is_distorted: See `_project`.
        size_px: Width and height of the image.
        labels: (height * width + 1,) uint8, row by row; the last is that of no pixel.
        slot_of: (256,) uint16 first slot of each label; 0: it says nothing of the ground.
        hides_from_m: (rows, columns) depth from which on points are hidden; empty: nothing is.
        cell_px: Pixels along a cell of it.
        slots: (N,) uint16, filled in the runs: 1 + channel; 0: not seen.
    """
    width, height = size_px
    pixel = np.empty(_AT_ONCE, dtype=np.int32)
    depth = np.empty(_AT_ONCE, dtype=np.float32)
    w, px = np.uint32(width), np.uint32(cell_px)
    tested = hides_from_m.size > 0
    seen = np.int64(0)
    for r in range(len(runs)):
        end = starts[runs[r, 1]]
        for first in range(starts[runs[r, 0]], end, _AT_ONCE):
            last = min(first + _AT_ONCE, end)
            xs, ys, zs = x[first:last], y[first:last], z[first:last]
            _project(xs, ys, zs, view, width, height, pixel, depth, is_distorted)
            found, own = slots[first:last], bins[first:last]
            if not tested:
                for i in range(len(xs)):
                    slot = slot_of[labels[np.uint32(pixel[i])]]
                    slot = slot + np.uint16(own[i]) if slot > 0 else np.uint16(0)
                    found[i] = slot
                    seen += slot > 0
                continue
            for i in range(len(xs)):
                at = np.uint32(pixel[i])
                slot = slot_of[labels[at]]
                if slot > 0:
                    row = at // w
                    column = at - row * w
                    if depth[i] > hides_from_m[row // px, column // px]:
                        slot = np.uint16(0)
                    else:
                        slot = slot + np.uint16(own[i])
                        seen += 1
                found[i] = slot
    return int(seen)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def lay_block(
    x: NDArrayAny,
    y: NDArrayAny,
    z: NDArrayFloat32,
    starts: NDArrayInt,
    runs: NDArrayInt,
    view: NDArrayFloat32,
    is_distorted: bool,
    size_px: tuple[int, int],
    cell_px: int,
    nearest_m: float,
    buffer: NDArrayFloat32,
) -> None:
    """Lay standing points of the runs into a depth buffer.

    Args:
        x: With
        y: and
        z: and
        starts: and
        runs: and
        view: (with a least range of 0, for what is near hides too) and
        is_distorted: as of `see_block`.
        cell_px: Pixels along a cell of the buffer.
        size_px: Width and height of the image.
        nearest_m: What is nearer belongs to the vehicle.
        buffer: (rows, columns) changed: the nearest depth.
    """
    width, height = size_px
    pixel = np.empty(_AT_ONCE, dtype=np.int32)
    depth = np.empty(_AT_ONCE, dtype=np.float32)
    none, w, px = np.uint32(width * height), np.uint32(width), np.uint32(cell_px)
    for r in range(len(runs)):
        end = starts[runs[r, 1]]
        for first in range(starts[runs[r, 0]], end, _AT_ONCE):
            last = min(first + _AT_ONCE, end)
            xs, ys, zs = x[first:last], y[first:last], z[first:last]
            _project(xs, ys, zs, view, width, height, pixel, depth, is_distorted)
            for i in range(len(xs)):
                at = np.uint32(pixel[i])
                if at == none or depth[i] <= nearest_m:
                    continue
                row = at // w
                row, column = row // px, (at - row * w) // px
                if depth[i] < buffer[row, column]:
                    buffer[row, column] = depth[i]
