"""Filling polygons into cells by the centre rule: a cell belongs to a polygon if its centre does."""

from __future__ import annotations

import numpy as np
import shapely
from numba import njit
from shapely.geometry.base import BaseGeometry

from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat

EVERYWHERE = np.ones(256, dtype=np.bool_)
"""Of `fill`: any code may be painted over."""


def only_on(*codes: int) -> NDArrayBool:
    """(256,) table for `fill`: only cells of these codes may be painted over."""
    table = np.zeros(256, dtype=np.bool_)
    table[list(codes)] = True
    return table


def fill_area(
    cells: NDArrayByte,
    area: BaseGeometry,
    corner_m: tuple[float, float],
    cell_m: float,
    code: int,
    may_cover: NDArrayBool = EVERYWHERE,
) -> None:
    """Write a code into all cells whose centre lies in an area, holes left out.

    Args:
        cells: (rows, cols) uint8, changed in place; row 0 is the southernmost.
        area: Polygons, city metres.
        corner_m: South-west corner of cell (0, 0), city metres.
        cell_m: Size of a cell.
        code: What to write.
        may_cover: (256,) which codes it may replace.
    """
    for polygon in shapely.get_parts(area):
        if polygon.geom_type != "Polygon" or polygon.is_empty:
            continue
        rings = [shapely.get_coordinates(r) for r in (polygon.exterior, *polygon.interiors)]
        starts = np.concatenate([ring[:-1] for ring in rings])
        ends = np.concatenate([ring[1:] for ring in rings])
        edges = np.concatenate([starts - corner_m, ends - corner_m], axis=1) / cell_m
        _fill(cells, edges, np.array([0, len(edges)]), int(code), may_cover)


def fill_quads(
    cells: NDArrayByte,
    quads: NDArrayFloat,
    corner_m: tuple[float, float],
    cell_m: float,
    code: int,
    may_cover: NDArrayBool = EVERYWHERE,
) -> None:
    """`fill_area` of many polygons (N, K, 2) of equally many corners, each on its own."""
    if len(quads) == 0:
        return
    scaled = (quads - np.asarray(corner_m)) / cell_m
    edges = np.concatenate([scaled, np.roll(scaled, -1, axis=1)], axis=2)
    k = edges.shape[1]
    _fill(cells, edges.reshape(-1, 4), np.arange(0, len(quads) * k + 1, k), int(code), may_cover)


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def _fill(
    cells: NDArrayByte, edges: NDArrayFloat, starts: NDArrayAny, code: int, may_cover: NDArrayBool
) -> None:
    """Even-odd scan conversion; edges (E, 4) as x0, y0, x1, y1 in cells."""
    rows, cols = cells.shape
    for p in range(len(starts) - 1):
        group = edges[starts[p] : starts[p + 1]]
        low, high = np.inf, -np.inf
        for e in range(len(group)):
            low = min(low, group[e, 1])
            high = max(high, group[e, 1])
        first = int(max(np.ceil(low - 0.5), 0.0))
        last = int(min(np.ceil(high - 0.5), float(rows)))
        if last <= first:
            continue
        counts = np.zeros(last - first + 1, dtype=np.int64)
        for e in range(len(group)):
            r0, r1 = _rows(group[e], first, last)
            for r in range(r0, r1):
                counts[r - first + 1] += 1
        offsets = np.cumsum(counts)
        cuts = np.empty(offsets[-1])
        filled = np.zeros(last - first, dtype=np.int64)
        for e in range(len(group)):
            x0, y0, x1, y1 = group[e, 0], group[e, 1], group[e, 2], group[e, 3]
            r0, r1 = _rows(group[e], first, last)
            for r in range(r0, r1):
                at = offsets[r - first] + filled[r - first]
                cuts[at] = x0 + (r + 0.5 - y0) * (x1 - x0) / (y1 - y0)
                filled[r - first] += 1
        for r in range(first, last):
            row = np.sort(cuts[offsets[r - first] : offsets[r - first + 1]])
            for k in range(0, len(row) - 1, 2):
                c0 = int(max(np.ceil(row[k] - 0.5), 0.0))
                c1 = int(min(np.ceil(row[k + 1] - 0.5), float(cols)))
                for c in range(c0, c1):
                    if may_cover[cells[r, c]]:
                        cells[r, c] = code


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def _rows(edge: NDArrayFloat, first: int, last: int) -> tuple[int, int]:
    """Rows whose centre line an edge crosses, its lower end counted, its upper end not."""
    low, high = min(edge[1], edge[3]), max(edge[1], edge[3])
    r0 = int(max(np.ceil(low - 0.5), float(first)))
    r1 = int(min(np.ceil(high - 0.5), float(last)))
    return r0, max(r1, r0)
