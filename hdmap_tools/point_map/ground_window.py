"""The ground of a point map around a place, by cell, without its points."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Final

import numpy as np

from hdmap_tools.point_map.point_map import TILE_MM, PointMap, TileIndex
from hdmap_tools.types import NDArrayFloat

_REACH_MM: Final = 4_000
"""Ground is not guessed further than this from ground that was seen."""
_TILES_KEPT: Final = 64


class GroundHeights:
    """Ground heights of a point map; tiles are read when they are asked for.

    Args:
        points: The map.
    """

    def __init__(self, points: PointMap) -> None:
        self._points = points
        self._tile = lru_cache(maxsize=_TILES_KEPT)(partial(_ground_of, points))

    @property
    def cell_m(self) -> float:
        """Edge of a cell."""
        return self._points.meta.cell_mm / 1000.0

    def window(
        self, low_m: NDArrayFloat, high_m: NDArrayFloat
    ) -> tuple[NDArrayFloat, tuple[int, int]]:
        """Ground by cell around a place; where a cell has none, that of the nearest within 4 m.

        Nearest in the same tile: a place without ground at a tile's edge may stay unknown.

        Args:
            low_m: (2,) south-west corner, city metres, with
            high_m: (2,) the north-east one.

        Returns:
            Heights (rows, columns), metres, NaN where unknown, and cell (ix, iy) of the first.
        """
        side = self._points.meta.cells_a_side
        x0, y0 = (int(np.floor(v / self.cell_m)) for v in low_m)
        x1, y1 = (int(np.floor(v / self.cell_m)) + 1 for v in high_m)
        heights = np.full((y1 - y0, x1 - x0), np.nan)
        for tx in range(x0 // side, (x1 - 1) // side + 1):
            for ty in range(y0 // side, (y1 - 1) // side + 1):
                left, right = max(x0, tx * side), min(x1, (tx + 1) * side)
                below, above = max(y0, ty * side), min(y1, (ty + 1) * side)
                heights[below - y0 : above - y0, left - x0 : right - x0] = self._tile((tx, ty))[
                    below - ty * side : above - ty * side, left - tx * side : right - tx * side
                ]
        return heights, (x0, y0)


def _ground_of(points: PointMap, index: TileIndex) -> NDArrayFloat:
    """Heights (side, side) of a tile, with those of cells that have one given to cells near them."""
    from scipy.ndimage import distance_transform_edt

    heights = points.read_ground(index)
    unknown = np.isnan(heights)
    if not unknown.any() or unknown.all():
        return heights
    away, (row, column) = distance_transform_edt(unknown, return_indices=True)
    return np.where(away <= _REACH_MM * len(heights) / TILE_MM, heights[row, column], np.nan)
