"""How much of each grid cell an area covers: the way from vectors to truth cells."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.types import NDArrayFloat, NDArrayInt

SCAN_LINES_PER_CELL: Final = 16
"""Along x the covered length is exact; along y it is sampled on this many lines a
cell, so an edge that runs east-west is off by at most 1/32 of a cell."""


def coverage_share(geometries: Iterable[BaseGeometry], grid: BevGrid) -> NDArrayFloat:
    """(y, x) share 0..1 of each cell that lies inside the union of city-frame areas."""
    x0, y0, _, _ = grid.bounds_m
    area = shapely.union_all(list(geometries))
    # In units of cells with the origin in the grid's corner.
    area = shapely.transform(area, lambda xy: (xy - (x0, y0)) / grid.resolution_m)
    return unit_coverage(area, grid.shape)


def unit_coverage(
    area: BaseGeometry, shape: tuple[int, int], lines_per_cell: int = SCAN_LINES_PER_CELL
) -> NDArrayFloat:
    """Share 0..1 of each unit square that a valid area covers.

    Square (row, column) is ``[column, column + 1) x [row, row + 1)``. Each scan line
    is cut at the area's edges; every cut adds the part of its square to the right of
    it (entering) or takes it away (leaving), and a running sum along the line then
    gives the covered length of each square.
    """
    rows, cols = shape
    if rows == 0 or cols == 0:
        return np.zeros(shape)
    area = shapely.intersection(area, shapely.box(-1, -1, cols + 1, rows + 1))
    rings = [
        ring
        for polygon in shapely.get_parts(area)
        if polygon.geom_type == "Polygon" and not polygon.is_empty
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    if not rings:
        return np.zeros(shape)
    scale = np.array([1.0, lines_per_cell])
    starts = np.concatenate([shapely.get_coordinates(ring)[:-1] for ring in rings])
    ends = np.concatenate([shapely.get_coordinates(ring)[1:] for ring in rings])
    lines, cuts = _cuts(starts * scale, ends * scale)
    inside = (lines >= 0) & (lines < rows * lines_per_cell)
    lines, cuts = lines[inside], cuts[inside]
    order = np.lexsort((cuts, lines))
    lines, cuts = lines[order], np.clip(cuts[order], 0.0, float(cols))
    # Closed rings cut every line an even number of times, so entering and leaving alternate.
    sign = np.where(np.arange(len(cuts)) % 2 == 0, 1.0, -1.0)
    cell = np.minimum(np.floor(cuts).astype(np.int64), cols)
    row = lines // lines_per_cell
    steps = np.zeros((rows, cols + 2))
    np.add.at(steps, (row, cell), sign * (cell + 1 - cuts))
    np.add.at(steps, (row, cell + 1), sign * (cuts - cell))
    share = np.cumsum(steps, axis=1)[:, :cols] / lines_per_cell
    return np.asarray(np.clip(share, 0.0, 1.0))


def _cuts(starts: NDArrayFloat, ends: NDArrayFloat) -> tuple[NDArrayInt, NDArrayFloat]:
    """Scan line number and x of each crossing of edges (N, 2) with the lines y = k + 1/2."""
    upward = ends[:, 1] >= starts[:, 1]
    low = np.where(upward[:, None], starts, ends)
    high = np.where(upward[:, None], ends, starts)
    # Half-open in y, so that a vertex on a line is counted once.
    first = np.ceil(low[:, 1] - 0.5).astype(np.int64)
    count = np.maximum(np.ceil(high[:, 1] - 0.5).astype(np.int64) - first, 0)
    edge = np.repeat(np.arange(len(low)), count)
    within = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    line = first[edge] + within
    a, b = low[edge], high[edge]
    along = (line + 0.5 - a[:, 1]) / (b[:, 1] - a[:, 1])
    return line, a[:, 0] + along * (b[:, 0] - a[:, 0])
