"""The ground under a sweep, compiled: low returns by cell, and heights between samples.

The plain forms are a sort and a k-d tree, which the tests hold these equal to, bit for
bit; they take four and six times as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

_BIN_M = 2.0
_NEIGHBOURS = 6
_LATTICE_M = 0.5
_FOR_SHIFT = 4000


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def polar_cells(
    points: NDArrayFloat,
    max_range_m: float,
    min_range_m: float,
    ring_m: float,
    num_sectors: int,
    num_rings: int,
) -> NDArrayInt:
    """Cell (N,) of each return, ``sector * num_rings + ring``; -1 out of range.

    Args:
        points: (N, 3) metres from the vehicle.
        max_range_m: With
        min_range_m: of the returns to look at, both exclusive.
        ring_m: Width of a ring.
        num_sectors: Around the vehicle.
        num_rings: In each.
    """
    cell = np.full(len(points), -1, dtype=np.int64)
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        distance = np.sqrt(x * x + y * y)
        if not min_range_m < distance < max_range_m:
            continue
        # Not negative, so that int() is the floor; a remainder takes as long as the angle.
        sector = int((np.arctan2(y, x) + np.pi) / (2 * np.pi) * num_sectors)
        if sector >= num_sectors:
            sector -= num_sectors
        cell[i] = sector * num_rings + int(distance / ring_m)
    return cell


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def mean_samples(points: NDArrayFloat, cell: NDArrayInt, ceiling_m: NDArrayFloat) -> NDArrayFloat:
    """Mean (M, 3) of the returns of each cell that lie no higher than its ceiling.

    Args:
        points: (N, 3) metres.
        cell: (N,) of each; -1 counts for none.
        ceiling_m: (cells,) metres; minus infinity leaves a cell out.
    """
    total = np.zeros((len(ceiling_m), 3))
    number = np.zeros(len(ceiling_m), dtype=np.int64)
    for i in range(len(points)):
        k = cell[i]
        if k >= 0 and points[i, 2] <= ceiling_m[k]:
            number[k] += 1
            total[k, 0] += points[i, 0]
            total[k, 1] += points[i, 1]
            total[k, 2] += points[i, 2]
    seen = np.flatnonzero(number)
    samples = np.empty((len(seen), 3))
    for j in range(len(seen)):
        for axis in range(3):
            samples[j, axis] = total[seen[j], axis] / number[seen[j]]
    return samples


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def _smallest(values: NDArrayFloat, first: int, last: int, wanted: int) -> float:
    """What would stand at a place if values from first to last were sorted; reorders them.

    Source:
        C. A. R. Hoare, Algorithm 65: Find, Communications of the ACM 4, 1961.
    """
    while first < last:
        pivot = values[wanted]
        i, j = first, last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < wanted:
            first = i
        if wanted < i:
            last = j
    return float(values[wanted])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def low_heights(cell: NDArrayInt, heights: NDArrayFloat, num_cells: int) -> NDArrayFloat:
    """A low height of each cell: the 10th percentile, robust to single returns from below.

    Args:
        cell: (N,) cell of each return, 0 to num_cells - 1; -1 counts for none.
        heights: (N,) metres, none of them NaN.
        num_cells: Cells.

    Returns:
        (num_cells,) metres; NaN where a cell is empty.
    """
    starts = np.zeros(num_cells + 1, dtype=np.int64)
    for i in range(len(cell)):
        if cell[i] >= 0:
            starts[cell[i] + 1] += 1
    for k in range(num_cells):
        starts[k + 1] += starts[k]
    by_cell = np.empty(len(cell))
    filled = starts[:-1].copy()
    for i in range(len(cell)):
        if cell[i] >= 0:
            by_cell[filled[cell[i]]] = heights[i]
            filled[cell[i]] += 1
    low = np.full(num_cells, np.nan)
    for k in range(num_cells):
        count = starts[k + 1] - starts[k]
        if count > 0:
            low[k] = _smallest(by_cell, starts[k], starts[k + 1] - 1, starts[k] + count // 10)
    return low


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def sorted_into_bins(
    samples: NDArrayFloat,
) -> tuple[NDArrayFloat, NDArrayInt, tuple[float, float], tuple[int, int]]:
    """Samples by bins of 2 m, so that those near a place are found without a tree.

    Args:
        samples: (N, 3) metres, N at least 1.

    Returns:
        Samples (N, 3) by bin, where each bin's begin (columns * rows + 1,), the corner of
        the first bin, and the number of columns and rows.
    """
    x0, y0 = np.floor(samples[:, 0].min()), np.floor(samples[:, 1].min())
    columns = int((samples[:, 0].max() - x0) // _BIN_M) + 1
    rows = int((samples[:, 1].max() - y0) // _BIN_M) + 1
    of_sample = np.empty(len(samples), dtype=np.int64)
    starts = np.zeros(columns * rows + 1, dtype=np.int64)
    for i in range(len(samples)):
        column, row = int((samples[i, 0] - x0) // _BIN_M), int((samples[i, 1] - y0) // _BIN_M)
        of_sample[i] = column * rows + row
        starts[of_sample[i] + 1] += 1
    for k in range(columns * rows):
        starts[k + 1] += starts[k]
    ordered = np.empty_like(samples)
    filled = starts[:-1].copy()
    for i in range(len(samples)):
        ordered[filled[of_sample[i]]] = samples[i]
        filled[of_sample[i]] += 1
    return ordered, starts, (x0, y0), (columns, rows)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def heights_between(
    xy: NDArrayFloat,
    samples: NDArrayFloat,
    starts: NDArrayInt,
    corner: tuple[float, float],
    shape: tuple[int, int],
    reach_m: float,
) -> NDArrayFloat:
    """Height at positions: the mean of the six nearest samples, nearer ones counting more.

    Args:
        xy: (N, 2 or 3) metres.
        samples: With
        starts: and
        corner: and
        shape: what `sorted_into_bins` gave.
        reach_m: Further than this from every sample nothing is known.

    Returns:
        (N,) metres, NaN out of reach.
    """
    result = np.full(len(xy), np.nan)
    columns, rows = shape
    wanted = min(_NEIGHBOURS, len(samples))
    near = np.empty(_NEIGHBOURS)
    height = np.empty(_NEIGHBOURS)
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        at_x, at_y = np.floor((x - corner[0]) / _BIN_M), np.floor((y - corner[1]) / _BIN_M)
        # So far outside that the samples are out of reach; and numbers that are no index.
        far = np.ceil(reach_m / _BIN_M)
        if not (-far - 1 <= at_x <= columns + far and -far - 1 <= at_y <= rows + far):
            continue
        column, row = int(at_x), int(at_y)
        found = 0
        ring = 0
        while True:
            for c in range(max(column - ring, 0), min(column + ring + 1, columns)):
                # Inside the ring only the first and the last row are new.
                step = 1 if abs(c - column) == ring else max(2 * ring, 1)
                for r in range(row - ring, row + ring + 1, step):
                    if r < 0 or r >= rows:
                        continue
                    for k in range(starts[c * rows + r], starts[c * rows + r + 1]):
                        dx, dy = x - samples[k, 0], y - samples[k, 1]
                        squared = dx * dx + dy * dy
                        if found == wanted and squared >= near[wanted - 1]:
                            continue
                        place = min(found, wanted - 1)
                        while place > 0 and near[place - 1] > squared:
                            near[place], height[place] = near[place - 1], height[place - 1]
                            place -= 1
                        near[place], height[place] = squared, samples[k, 2]
                        found = min(found + 1, wanted)
            # Everything nearer than this lies in the rings looked at.
            clear = ring * _BIN_M + min(
                min(x - corner[0] - column * _BIN_M, (column + 1) * _BIN_M + corner[0] - x),
                min(y - corner[1] - row * _BIN_M, (row + 1) * _BIN_M + corner[1] - y),
            )
            clear = max(clear - 1e-6, 0.0)
            if found == wanted and near[wanted - 1] <= clear * clear:
                break
            if found == 0 and clear > reach_m:
                break
            if ring > columns + rows + 2 * far:
                break
            ring += 1
        if found == 0 or np.sqrt(near[0]) > reach_m:
            continue
        top = bottom = 0.0
        for k in range(found):
            from_sample = np.sqrt(near[k]) + 0.1
            weight = 1.0 / (from_sample * from_sample)
            top += weight * height[k]
            bottom += weight
        result[i] = top / bottom
    return result


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def near_surface(
    points: NDArrayFloat,
    samples: NDArrayFloat,
    starts: NDArrayInt,
    corner: tuple[float, float],
    shape: tuple[int, int],
    reach_m: float,
    tolerance_m: float,
) -> NDArrayBool:
    """Which points lie within a tolerance of the height between samples.

    Neighbours share the heights of a lattice around them: a tenth of the look-ups of one for
    each. Where the lattice leaves what is known, a point's own is taken.

    Args:
        points: (N, 3) metres.
        samples: With
        starts: and
        corner: and
        shape: what `sorted_into_bins` gave.
        reach_m: See `heights_between`.
        tolerance_m: Above or below.
    """
    near = np.zeros(len(points), dtype=np.bool_)
    x0, y0 = corner[0] - reach_m, corner[1] - reach_m
    nx = int((shape[0] * _BIN_M + 2.0 * reach_m) / _LATTICE_M) + 2
    ny = int((shape[1] * _BIN_M + 2.0 * reach_m) / _LATTICE_M) + 2
    # A height is a mean of samples, so what lies above or below them all is not asked for.
    low = samples[:, 2].min() - tolerance_m - 1e-6
    high = samples[:, 2].max() + tolerance_m + 1e-6
    node = np.full(nx * ny, -1, dtype=np.int32)
    asked = np.empty(len(points), dtype=np.int64)
    num = num_nodes = 0
    for i in range(len(points)):
        u, v = (points[i, 0] - x0) / _LATTICE_M, (points[i, 1] - y0) / _LATTICE_M
        if not (low <= points[i, 2] <= high and 0.0 <= u < nx - 1 and 0.0 <= v < ny - 1):
            continue
        asked[num] = i
        num += 1
        first = int(u) * ny + int(v)
        for at in (first, first + 1, first + ny, first + ny + 1):
            if node[at] < 0:
                node[at] = num_nodes
                num_nodes += 1
    places = np.empty((num_nodes, 2))
    for at in range(nx * ny):
        if node[at] >= 0:
            places[node[at], 0] = x0 + (at // ny) * _LATTICE_M
            places[node[at], 1] = y0 + (at % ny) * _LATTICE_M
    height = heights_between(places, samples, starts, corner, shape, reach_m)
    left = np.empty(num, dtype=np.int64)
    num_left = 0
    for k in range(num):
        i = asked[k]
        u, v = (points[i, 0] - x0) / _LATTICE_M, (points[i, 1] - y0) / _LATTICE_M
        column, row = int(u), int(v)
        du, dv = u - column, v - row
        first = column * ny + row
        z = (1.0 - du) * ((1.0 - dv) * height[node[first]] + dv * height[node[first + 1]])
        z += du * ((1.0 - dv) * height[node[first + ny]] + dv * height[node[first + ny + 1]])
        if np.isnan(z):
            left[num_left] = i
            num_left += 1
        else:
            near[i] = abs(points[i, 2] - z) <= tolerance_m
    if num_left > 0:
        rest = np.empty((num_left, 2))
        for k in range(num_left):
            rest[k, 0], rest[k, 1] = points[left[k], 0], points[left[k], 1]
        own = heights_between(rest, samples, starts, corner, shape, reach_m)
        for k in range(num_left):
            near[left[k]] = abs(points[left[k], 2] - own[k]) <= tolerance_m
    return near


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def returns_off_ground(
    points: NDArrayFloat,
    city_SE3_sweep: tuple[NDArrayFloat, NDArrayFloat],
    ego_SE3_sweep: tuple[NDArrayFloat, NDArrayFloat],
    clip: tuple[float, float, float, float],
    heights: NDArrayFloat,
    first_cell: tuple[int, int],
    cell_m: float,
    tolerance_m: float,
) -> NDArrayFloat:
    """Returns of a clip that are not at the height of a known ground.

    The heights may lie above or below the sweep's as a whole, where the map stands on other
    poses: the middle difference of returns within half a metre is taken off, of some thousand
    of them.

    Args:
        points: (N, 3) metres, ego frame at the sweep's time.
        city_SE3_sweep: Rotation and translation.
        ego_SE3_sweep: The same into the frame of the clip.
        clip: (x0, x1, y0, y1) metres.
        heights: (rows, columns) metres by cell; NaN where no ground is known.
        first_cell: (ix, iy) of the first row and column.
        cell_m: Edge of a cell.
        tolerance_m: How far above or below a return still is ground.

    Returns:
        (M, 3) metres, city frame.
    """
    R, t = city_SE3_sweep
    E, e = ego_SE3_sweep
    x0, x1, y0, y1 = clip
    rows, columns = heights.shape
    inside = np.empty((len(points), 3))
    above = np.empty(len(points))
    near = np.empty(len(points))
    num = num_near = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        ex = E[0, 0] * x + E[0, 1] * y + E[0, 2] * z + e[0]
        ey = E[1, 0] * x + E[1, 1] * y + E[1, 2] * z + e[1]
        if not (x0 <= ex <= x1 and y0 <= ey <= y1):
            continue
        cx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        cy = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        cz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        inside[num, 0], inside[num, 1], inside[num, 2] = cx, cy, cz
        column = int(np.floor(cx / cell_m)) - first_cell[0]
        row = int(np.floor(cy / cell_m)) - first_cell[1]
        above[num] = np.nan
        if 0 <= row < rows and 0 <= column < columns:
            above[num] = cz - heights[row, column]
            if abs(above[num]) < 0.5:
                near[num_near] = above[num]
                num_near += 1
        num += 1
    step = num_near // _FOR_SHIFT + 1
    shift = np.median(near[:num_near:step].copy()) if num_near > 0 else 0.0
    kept = 0
    for i in range(num):
        if not abs(above[i] - shift) <= tolerance_m:
            inside[kept, 0], inside[kept, 1], inside[kept, 2] = (
                inside[i, 0],
                inside[i, 1],
                inside[i, 2],
            )
            kept += 1
    return inside[:kept].copy()
