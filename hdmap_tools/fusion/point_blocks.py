"""Point maps as the dense engine reads them: blocks of map cells, points sorted by cell.

A block holds all points of its cells, so each frame's vote in a cell is cast in one place,
whatever the sizes of the point map's tiles and of the cells.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.counting_sort import counting_sort
from hdmap_tools.fusion.block_kernels import in_block
from hdmap_tools.fusion.cell_counts import TILE_CELLS, TileIndex, heights_in_mm
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.point_map.point_map import PointMap
from hdmap_tools.point_map.values import MapPoints
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayInt

_MAX_BLOCK_MM: Final = 32_000
"""Positions in a block are 16-bit millimetres: half the bytes to read for each point."""

POINTS_BYTES: Final = 64 * 2**20
"""Of blocks in memory, where nothing else is said: those around a vehicle take a half of it."""

BlockIndex = tuple[int, int]


def block_cells(resolution_m: float) -> int:
    """Cells a side of a block; tiles hold whole blocks."""
    cells = TILE_CELLS // 2
    while cells > 1 and cells * resolution_m * 1000.0 > _MAX_BLOCK_MM:
        cells //= 2
    return cells


@dataclass(frozen=True, eq=False)
class SortedPoints:
    """Points of a block in order of their cell, rows (along y) first.

    Attributes:
        x, y: (N,) int16 millimetres from the block's corner.
        z: (N,) int16 millimetres from its height; float32 where some lie 32 m above or below.
        starts: (K + 1,) first point of each occupied cell.
        cells: (K,) flat cell in the map's tile, ``y * TILE_CELLS + x``.
        columns: (K,) column of the cell in the block.
        row_starts: (rows + 1,) first occupied cell of each row.
        z_range_m: Lowest and highest, metres.
    """

    x: NDArrayAny
    y: NDArrayAny
    z: NDArrayAny
    starts: NDArrayInt
    cells: NDArrayInt
    columns: NDArrayInt
    row_starts: NDArrayInt
    z_range_m: tuple[float, float]

    def __len__(self) -> int:
        return len(self.x)

    def sums_of(self, values: NDArrayAny) -> NDArrayAny:
        """Sum (K,) of values (N,) in each cell."""
        return np.add.reduceat(values, self.starts[:-1]) if len(values) else values

    @classmethod
    def from_points(
        cls, local_mm: NDArrayInt, cells: NDArrayInt, index: BlockIndex, side: int
    ) -> tuple[SortedPoints, NDArrayInt]:
        """Sort points by their cells; and which rows (M,) they are.

        Args:
            local_mm: (N, 3) whole millimetres from the block's corner.
            cells: (N,) cell in the block, ``y * side + x``; points with -1 are left out.
            index: Of the block.
            side: Its cells a side.
        """
        order, occupied, starts = counting_sort(cells, side * side)
        rows, columns = np.divmod(occupied, side)
        in_tile = np.array(index) % (TILE_CELLS // side) * side
        x, y, z = (local_mm[order, axis] for axis in range(3))
        lowest, highest = (int(z.min()), int(z.max())) if len(z) else (0, 0)
        fits = lowest >= -(2**15) and highest < 2**15
        return cls(
            x.astype(np.int16),
            y.astype(np.int16),
            z.astype(np.int16 if fits else np.float32),
            starts,
            (rows + in_tile[1]) * TILE_CELLS + columns + in_tile[0],
            columns,
            np.searchsorted(rows, np.arange(side + 1)),
            (lowest / 1000.0, highest / 1000.0),
        ), order


@dataclass(frozen=True, eq=False)
class PointBlock:
    """All points of the cells of a block.

    Attributes:
        tile: Of the semantic map, that holds the block.
        corner_city: (3,) south-west corner, whole millimetres given in metres, at a height near
            the points.
        ground: Points that are labelled.
        bins: (N,) uint8 intensity bin of each, 0 or 1,
        intensity: (N,) uint8, and
        height_mm: (N,) int32 above the map's reference.
        sums: (K,) each, by cell: height, its square, intensity.
        standing: Points that hide others.
    """

    tile: TileIndex
    corner_city: NDArrayFloat
    ground: SortedPoints
    bins: NDArrayAny
    intensity: NDArrayByte
    height_mm: NDArrayAny
    sums: tuple[NDArrayAny, NDArrayAny, NDArrayAny]
    standing: SortedPoints

    @classmethod
    def from_points(cls, index: BlockIndex, points: MapPoints, meta: MapMeta) -> PointBlock:
        """Take the points of a block out of those of a place."""
        side = block_cells(meta.resolution_m)
        edge_mm = side * meta.resolution_m * 1000.0
        x_mm, y_mm = (int(np.floor(i * edge_mm)) for i in index)
        cells, local_mm = in_block(points.points_city, index, side, meta.resolution_m, (x_mm, y_mm))
        inside = cells >= 0
        level_mm = int(np.median(local_mm[inside, 2])) if inside.any() else 0
        local_mm[:, 2] -= level_mm
        ground, order = SortedPoints.from_points(
            local_mm, np.where(points.is_ground, cells, -1), index, side
        )
        standing, _ = SortedPoints.from_points(
            local_mm, np.where(points.is_ground, -1, cells), index, side
        )
        intensity = points.intensity[order]
        height_mm = heights_in_mm(points.points_city[order, 2], meta)
        height = height_mm.astype(np.int64)
        sums = (
            ground.sums_of(height),
            ground.sums_of((height**2).astype(np.uint64)),
            ground.sums_of(intensity.astype(np.uint64)),
        )
        of_tile = TILE_CELLS // side
        return cls(
            (index[0] // of_tile, index[1] // of_tile),
            np.array([x_mm, y_mm, level_mm]) / 1000.0,
            ground,
            (intensity >= meta.intensity_threshold).astype(np.uint8),
            intensity,
            height_mm,
            sums,
            standing,
        )

    def __len__(self) -> int:
        return len(self.ground) + len(self.standing)

    @property
    def num_bytes(self) -> int:
        """Memory that it takes, roughly."""
        return 12 * len(self.ground) + 6 * len(self.standing) + 48 * len(self.ground.cells)


class PointBlocks:
    """The blocks of a point map, made when they are asked for; those used last are kept.

    Args:
        points: The map on disk.
        meta: Of the semantic map whose cells they are.
        max_bytes: Of blocks in memory.
    """

    def __init__(self, points: PointMap, meta: MapMeta, max_bytes: int = POINTS_BYTES) -> None:
        self._points, self._meta, self._max_bytes = points, meta, max_bytes
        self._kept: OrderedDict[BlockIndex, PointBlock] = OrderedDict()
        self._num_bytes = 0

    def block(self, index: BlockIndex) -> PointBlock:
        """One block, without points where the map has none."""
        found = self._kept.pop(index, None)
        if found is None:
            edge_m = block_cells(self._meta.resolution_m) * self._meta.resolution_m
            x0, y0 = index[0] * edge_m, index[1] * edge_m
            points = self._points.points_in((x0, y0, x0 + edge_m, y0 + edge_m))
            found = PointBlock.from_points(index, points, self._meta)
            self._num_bytes += found.num_bytes
        self._kept[index] = found
        while self._num_bytes > self._max_bytes and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            self._num_bytes -= oldest.num_bytes
        return found

    def within(self, bounds_m: tuple[float, float, float, float]) -> list[BlockIndex]:
        """Blocks that (x0, y0, x1, y1), city metres, touches."""
        edge_m = block_cells(self._meta.resolution_m) * self._meta.resolution_m
        x0, y0, x1, y1 = (int(np.floor(v / edge_m)) for v in bounds_m)
        return [(x, y) for y in range(y0, y1 + 1) for x in range(x0, x1 + 1)]
