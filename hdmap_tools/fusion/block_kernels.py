"""Dense fusion, compiled: points sorted by cell, culled by cell, projected row by row, counted at once.

All arithmetic is float32 on coordinates within a block of the map, with transforms composed
in float64: a map 50 km from its origin loses nothing. Each expression is evaluated in the
order written, so that numpy in float32 gives the same bits (tests/fusion/dense_oracle.py).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.association.visibility import CELL_PX
from hdmap_tools.fusion.vote_kernels import scratch_for, vote_cells
from hdmap_tools.types import NDArrayAny, NDArrayFloat, NDArrayFloat32, NDArrayInt

_ZERO: Final = np.float32(0.0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1.0)
_TWO: Final = np.float32(2.0)
_BIT: Final = np.uint32(1)
_CELL_PX: Final = np.uint32(CELL_PX)
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
def _project(
    xs: NDArrayAny,
    ys: NDArrayAny,
    zs: NDArrayAny,
    view: NDArrayFloat32,
    width: int,
    height: int,
    pixel: NDArrayAny,
    cell: NDArrayAny,
    depth: NDArrayFloat32,
    is_distorted: bool,
) -> None:
    """Pixel of each point (row * width + column), or width * height where there is none; and depth.

    Args:
        xs: With
        ys: and
        zs: (N,) millimetres in the block's frame.
        view: (36,) as `view_kernels.view_of_block` fills it.
        width: With
        height: of the image.
        pixel: (N,) int32, filled.
        cell: (N,) int32, filled: of the depth buffer.
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
    none, columns = np.int32(width * height), np.int32(-(-width // CELL_PX))
    for i in range(len(xs)):
        x, y, z = np.float32(xs[i]), np.float32(ys[i]), np.float32(zs[i])
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
        row, column = (
            np.uint32(np.int32(v if ok else _ZERO)),
            np.uint32(np.int32(u if ok else _ZERO)),
        )
        pixel[i] = np.int32(row) * np.int32(width) + np.int32(column) if ok else none
        cell[i] = np.int32(row // _CELL_PX) * columns + np.int32(column // _CELL_PX)
        depth[i] = d


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _project_inner(
    xs: NDArrayAny,
    ys: NDArrayAny,
    zs: NDArrayAny,
    view: NDArrayFloat32,
    width: int,
    pixel: NDArrayAny,
    cell: NDArrayAny,
    depth: NDArrayFloat32,
) -> None:
    """`_project` where clip and view hold all points, through a pinhole."""
    c00, c01, c02, c03 = view[8], view[9], view[10], view[11]
    c10, c11, c12, c13 = view[12], view[13], view[14], view[15]
    c20, c21, c22, c23 = view[16], view[17], view[18], view[19]
    fx, fy, cx, cy = view[20], view[21], view[22], view[23]
    columns = np.int32(-(-width // CELL_PX))
    for i in range(len(xs)):
        x, y, z = np.float32(xs[i]), np.float32(ys[i]), np.float32(zs[i])
        d = c20 * x + c21 * y + c22 * z + c23
        inverse = _ONE / d
        a = (c00 * x + c01 * y + c02 * z + c03) * inverse
        b = (c10 * x + c11 * y + c12 * z + c13) * inverse
        u = fx * a + cx + _HALF
        v = fy * b + cy + _HALF
        row, column = np.uint32(np.int32(v)), np.uint32(np.int32(u))
        pixel[i] = np.int32(row) * np.int32(width) + np.int32(column)
        cell[i] = np.int32(row // _CELL_PX) * columns + np.int32(column // _CELL_PX)
        depth[i] = d


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def fuse_block(
    points: tuple[NDArrayAny, NDArrayAny, NDArrayAny, NDArrayAny],
    starts: NDArrayInt,
    cells: NDArrayInt,
    runs: NDArrayInt,
    view: NDArrayFloat32,
    is_distorted: bool,
    size_px: tuple[int, int],
    labels: NDArrayAny,
    slot_of: NDArrayAny,
    hides_from_m: NDArrayFloat32,
    rule: tuple[int, int, np.uint64],
    place: tuple[int, int, int],
    layers: tuple[NDArrayAny, ...],
    values: tuple[NDArrayAny, NDArrayAny, NDArrayAny],
    sums: tuple[NDArrayAny, NDArrayAny, NDArrayAny],
) -> int:
    """Project the ground points of runs into an image, look up, and vote; gives how many were seen.

    A few thousand points at a time, from their position to their vote: what lies in between
    never leaves the fastest cache.

    Args:
        points: x, y, z (N,) millimetres in the block's frame, by cell, and (N,) uint8 intensity bin.
        starts: (K + 1,) first point of each cell.
        cells: (K,) flat cell in the tile.
        runs: (R, 3) of `view_kernels.view_of_block`.
        view: See `_project`.
        is_distorted: See `_project`.
        size_px: Width and height of the image.
        labels: (height * width + 1,) uint8, row by row; the last is that of no pixel.
        slot_of: (512,) uint16 slot of each label and bin, ``2 * label + bin``; 0: it says nothing
            of the ground.
        hides_from_m: (cells,) depth from which on points are hidden, row by row of the depth buffer;
            empty: nothing is.
        rule: And
        place: and
        layers: and
        values: and
        sums: of `vote_cells`.
    """
    x, y, z, bins = points
    width, height = size_px
    scratch = scratch_for(len(layers[0]))
    room = _AT_ONCE
    for r in range(len(runs)):
        for k in range(runs[r, 0], runs[r, 1]):
            room = max(room, starts[k + 1] - starts[k])
    pixel = np.empty(room, dtype=np.int32)
    hide_cell = np.empty(room, dtype=np.int32)
    depth = np.empty(room, dtype=np.float32)
    slots = np.empty(room, dtype=np.uint16)
    tested = len(hides_from_m) > 0
    seen = 0
    for r in range(len(runs)):
        k1 = runs[r, 0]
        while k1 < runs[r, 1]:
            k0, first = k1, starts[k1]
            k1 += 1
            while k1 < runs[r, 1] and starts[k1 + 1] - first <= _AT_ONCE:
                k1 += 1
            last = starts[k1]
            xs, ys, zs = x[first:last], y[first:last], z[first:last]
            if runs[r, 2]:
                _project_inner(xs, ys, zs, view, width, pixel, hide_cell, depth)
            else:
                _project(xs, ys, zs, view, width, height, pixel, hide_cell, depth, is_distorted)
            own = bins[first:last]
            for i in range(len(xs)):
                label = np.uint32(labels[np.uint32(pixel[i])])
                slots[i] = slot_of[(label << _BIT) | np.uint32(own[i])]
            if tested:
                for i in range(len(xs)):
                    if depth[i] > hides_from_m[np.uint32(hide_cell[i])]:
                        slots[i] = np.uint16(0)
            seen += vote_cells(
                k0,
                k1,
                starts,
                cells,
                (slots, first),
                rule,
                place,
                layers,
                values,
                sums,
                scratch,
            )
    return seen


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def lay_block(
    x: NDArrayAny,
    y: NDArrayAny,
    z: NDArrayAny,
    starts: NDArrayInt,
    runs: NDArrayInt,
    view: NDArrayFloat32,
    is_distorted: bool,
    size_px: tuple[int, int],
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
        is_distorted: as of `fuse_block`.
        size_px: Width and height of the image.
        nearest_m: What is nearer belongs to the vehicle.
        buffer: (cells,) row by row, changed: the nearest depth.
    """
    width, height = size_px
    pixel = np.empty(_AT_ONCE, dtype=np.int32)
    cell = np.empty(_AT_ONCE, dtype=np.int32)
    depth = np.empty(_AT_ONCE, dtype=np.float32)
    none = np.int32(width * height)
    for r in range(len(runs)):
        end = starts[runs[r, 1]]
        for first in range(starts[runs[r, 0]], end, _AT_ONCE):
            last = min(first + _AT_ONCE, end)
            xs, ys, zs = x[first:last], y[first:last], z[first:last]
            _project(xs, ys, zs, view, width, height, pixel, cell, depth, is_distorted)
            for i in range(len(xs)):
                if pixel[i] == none or depth[i] <= nearest_m:
                    continue
                at = np.uint32(cell[i])
                if depth[i] < buffer[at]:
                    buffer[at] = depth[i]
