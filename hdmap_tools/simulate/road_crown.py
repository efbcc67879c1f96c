"""The crown of the road: it rises from its edges to its middle, so that water runs off."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import shapely

from hdmap_tools.simulate.road_area import BLOCK_M, WorldIndex
from hdmap_tools.types import NDArrayFloat

CROSS_FALL: Final = 0.02
"""Slope at the edge of the road (RAS-Q and most others: 2 to 2.5 %)."""

_ROUNDING_M: Final = 4.0
"""So far from the edge the slope has fallen to a third: rounded, not folded, in the middle."""

_STEP_M: Final = 0.64
_NODES: Final = 40
_TILE_M: Final = 25.6
_REACH_M: Final = 10.0


class RoadCrown:
    """How much higher than the bare terrain the road is; bilinear between nodes 0.64 m apart.

    The nodes are those of the ground's mesh, so that mesh and heights agree.
    """

    def __init__(self, index: WorldIndex) -> None:
        self._index = index
        self._nodes = lru_cache(maxsize=400)(self._make)

    def __call__(self, xy: NDArrayFloat) -> NDArrayFloat:
        """(N,) metres at city points (N, 2); 0 off the road, but for the last cell at its edge."""
        result = np.zeros(len(xy))
        if len(xy) == 0:
            return result
        tiles = np.floor(xy / _TILE_M).astype(np.int64)
        unique, inverse = np.unique(tiles, axis=0, return_inverse=True)
        order = np.argsort(inverse.ravel(), kind="stable")
        bounds = np.searchsorted(inverse.ravel()[order], np.arange(len(unique) + 1))
        for k, (ix, iy) in enumerate(unique.tolist()):
            nodes = self._nodes(ix, iy)
            if nodes is None:
                continue
            members = order[bounds[k] : bounds[k + 1]]
            at = (xy[members] - (ix * _TILE_M, iy * _TILE_M)) / _STEP_M
            base = np.clip(np.floor(at).astype(np.int64), 0, _NODES - 1)
            u, v = np.clip(at - base, 0.0, 1.0).T
            c, r = base.T
            south = nodes[r, c] * (1 - u) + nodes[r, c + 1] * u
            north = nodes[r + 1, c] * (1 - u) + nodes[r + 1, c + 1] * u
            result[members] = south * (1 - v) + north * v
        return result

    def _make(self, ix: int, iy: int) -> NDArrayFloat | None:
        per_block = round(BLOCK_M / _TILE_M)
        area = self._index.road_area((ix // per_block, iy // per_block))
        corner = np.array([ix, iy]) * _TILE_M
        box = shapely.box(*corner, *(corner + _TILE_M))
        if not area.prepared.intersects(box):
            return None
        steps = np.arange(_NODES + 1)
        x, y = np.meshgrid((ix * _NODES + steps) * _STEP_M, (iy * _NODES + steps) * _STEP_M)
        inside = shapely.contains_xy(area.prepared, x, y)
        nodes = np.zeros(x.shape)
        edge = shapely.intersection(area.boundary, box.buffer(_REACH_M, join_style="mitre"))
        distance = np.full(int(inside.sum()), _REACH_M)
        if not edge.is_empty:
            points = shapely.points(x[inside], y[inside])
            distance = np.minimum(shapely.distance(edge, points), _REACH_M)
        nodes[inside] = CROSS_FALL * _ROUNDING_M * (1.0 - np.exp(-distance / _ROUNDING_M))
        return nodes
