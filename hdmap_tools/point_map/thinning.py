"""Thin returns to one point a voxel, tile by tile, in bounded memory.

All sums are whole numbers that do not overflow, so the result depends neither on the order
of sweeps, nor on when a tile was put aside on disk, nor on who added up which of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.counting_sort import counting_sort
from hdmap_tools.point_map.point_map import TILE_MM, TileIndex
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt

_EMPTY: Final = -1
_WEIGHT_AT_ONCE: Final = 64
_HALF_WEIGHT_RANGE_M: Final = 15.0
"""At this range the error of 0.05 degrees in pitch equals that of 1.3 cm in height: what
comes from further away counts for less than half."""
_FIRST_SLOTS: Final = 1 << 17
_Z_BIAS: Final = 1 << 23

_BLOCKS: Final = 16
"""Blocks a side of a tile: returns are added block by block, while its sums are in the cache."""
_IN_GROUP: Final = 3 << 24 | 3
"""Bits of a key that tell voxels of a group apart: of the column and of the layer."""
_MAX_BLOCKS: Final = 1 << 18
"""More blocks than that around some returns are sorted by comparing."""

_SUMS: Final = 7
"""Weight, weighted x, y, z offsets in the voxel (mm), weighted intensity, hits, ground hits."""


@dataclass(frozen=True, eq=False)
class Voxels:
    """Sums of one tile's voxels, by ascending key.

    Attributes:
        key: (N,) int64, cell first: see `VoxelGrid`.
        sums: (N, 7) int64: weight, weighted x, y and z offset in the voxel (mm),
            weighted intensity, hits, hits on the ground.
    """

    key: NDArrayInt
    sums: NDArrayInt

    def __len__(self) -> int:
        return len(self.key)

    @classmethod
    def joined(cls, parts: list[Voxels]) -> Voxels:
        """Sums of several, voxel by voxel."""
        key = np.concatenate([part.key for part in parts] or [np.zeros(0, np.int64)])
        sums = np.concatenate([part.sums for part in parts] or [np.zeros((0, _SUMS), np.int64)])
        order = np.argsort(key, kind="stable")
        key, sums = key[order], sums[order]
        starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]])[: len(key)])
        return cls(key[starts], np.add.reduceat(sums, starts, axis=0) if len(starts) else sums)

    def keep(self, which: NDArrayAny) -> Voxels:
        """Some of them, in order."""
        return Voxels(self.key[which], self.sums[which])


@dataclass(frozen=True)
class VoxelGrid:
    """Voxels and cells of a tile; a voxel's key is its cell, then its row, column and height.

    Attributes:
        voxel_mm, cell_mm: Edges; a cell is a whole number of voxels, a tile of cells.
    """

    voxel_mm: int
    cell_mm: int

    @property
    def most_hits(self) -> int:
        """Returns that the sums of one voxel hold in 32 bits, wherever they lie in it."""
        largest = max(self.voxel_mm - 1, np.iinfo(np.uint8).max)
        return int(np.iinfo(np.int32).max) // (_WEIGHT_AT_ONCE * largest)

    def indices(self, key: NDArrayInt) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt]:
        """Column, row and layer of voxels (N,); the layer counts from city height 0."""
        return (key >> 24) & 2047, (key >> 35) & 2047, (key & (2 * _Z_BIAS - 1)) - _Z_BIAS

    def cells(self, key: NDArrayInt) -> NDArrayInt:
        """Cells (N,) of voxels, ``row * cells_a_side + col``."""
        return key >> 46

    def means_mm(self, voxels: Voxels) -> NDArrayFloat:
        """(N, 3) mean position of each voxel's returns, from the tile's corner."""
        corner = np.column_stack(self.indices(voxels.key)) * self.voxel_mm
        return corner + voxels.sums[:, 1:4] / voxels.sums[:, :1]


def intensity_of(voxels: Voxels) -> NDArrayByte:
    """(N,) mean intensity."""
    return np.rint(voxels.sums[:, 4] / voxels.sums[:, 0]).astype(np.uint8)


def is_ground_of(voxels: Voxels) -> NDArrayBool:
    """(N,) voxels at least half of whose returns were ground."""
    return np.asarray(2 * voxels.sums[:, 6] >= voxels.sums[:, 5])


@dataclass(frozen=True, eq=False)
class VoxelReturns:
    """Returns that know their voxels, sorted by tile and place; made in any thread.

    Attributes:
        tiles: (T,) indices.
        starts: (T + 1,) where the returns of each begin.
        key: (N,) int64 of each return's voxel in its tile.
        packed: (N,) int64 what each adds to the sums of its voxel, see `_packed`.
    """

    tiles: tuple[TileIndex, ...]
    starts: NDArrayInt
    key: NDArrayInt
    packed: NDArrayInt

    @classmethod
    def of(
        cls,
        points_city: NDArrayFloat,
        intensity: NDArrayByte,
        is_ground: NDArrayBool,
        range_m: NDArrayFloat,
        grid: VoxelGrid,
    ) -> VoxelReturns:
        """From returns (N, 3), city metres, and their distance from the vehicle."""
        block, local_mm, low, shape = _in_tiles(points_city)
        num_blocks = shape[0] * shape[1] * _BLOCKS**2
        if num_blocks <= _MAX_BLOCKS:
            order, blocks, starts = counting_sort(block, num_blocks)
        else:
            order = np.argsort(block, kind="stable")
            blocks, starts = np.unique(block[order], return_index=True)
            starts = np.append(starts, len(order))
        tile = blocks // _BLOCKS**2
        edges = np.append(np.flatnonzero(np.diff(tile, prepend=-1)), len(tile))
        found, starts = np.column_stack(np.divmod(tile[edges[:-1]], shape[1])) + low, starts[edges]
        key, packed = _packed(
            order, local_mm, intensity, is_ground, range_m, grid.voxel_mm, grid.cell_mm
        )
        return cls(tuple((x, y) for x, y in found.tolist()), starts, key, packed)


class VoxelTiles:
    """Sums of voxels while sweeps come in; tiles that were left are put aside on disk.

    Args:
        grid: Size of voxels and cells.
        folder: For the tiles put aside; must exist, and is for this one alone.
    """

    def __init__(self, grid: VoxelGrid, folder: Path) -> None:
        self.grid = grid
        self._folder = folder
        self._tables: dict[TileIndex, _Table] = {}
        self._aside: dict[TileIndex, list[Path]] = {}
        self._writer = ThreadPoolExecutor(1)
        self._writing: list[Future[None]] = []

    def add(
        self,
        points_city: NDArrayFloat,
        intensity: NDArrayByte,
        is_ground: NDArrayBool,
        range_m: NDArrayFloat,
    ) -> None:
        """Add returns: (N, 3) city metres, (N,) the rest; range_m is from the vehicle."""
        self.add_returns(VoxelReturns.of(points_city, intensity, is_ground, range_m, self.grid))

    def add_returns(self, returns: VoxelReturns) -> None:
        """Add returns that know their voxels."""
        most_at_once = self.grid.most_hits // 4
        for k, index in enumerate(returns.tiles):
            first, last = int(returns.starts[k]), int(returns.starts[k + 1])
            for start in range(first, last, most_at_once):
                self._add(index, returns, slice(start, min(start + most_at_once, last)))

    def put_aside(self, xy_city: NDArrayFloat, reach_m: float) -> None:
        """Write tiles to disk that lie further than reach_m from a position (2,), metres."""
        tile_m = TILE_MM / 1000.0
        for index in list(self._tables):
            centre = (np.array(index) + 0.5) * tile_m
            if np.abs(centre - xy_city[:2]).max() > reach_m + tile_m:
                self._write_aside(index)

    def finish(self) -> dict[TileIndex, tuple[Path, ...]]:
        """Put all tiles aside.

        Returns:
            For each tile with returns its files, for `read_voxels`.

        Raises:
            OSError: If any could not be written.
        """
        for index in list(self._tables):
            self._write_aside(index)
        for written in self._writing:
            written.result()
        self._writer.shutdown()
        return {index: tuple(paths) for index, paths in sorted(self._aside.items())}

    def close(self) -> None:
        """Leave off without finishing."""
        self._writer.shutdown(cancel_futures=True)

    def _add(self, index: TileIndex, returns: VoxelReturns, part: slice) -> None:
        table = self._tables.get(index)
        if table is not None and table.most_hits + part.stop - part.start > self.grid.most_hits:
            # A vehicle that stands for long: another return, and the sums might not fit.
            self._write_aside(index)
            table = None
        if table is None:
            table = self._tables[index] = _Table()
        table.make_room(part.stop - part.start)
        table.used, most_hits = _add_returns(
            returns.key[part],
            returns.packed[part],
            table.slots,
            table.key,
            table.sums,
            table.used,
        )
        table.most_hits = max(table.most_hits, most_hits)

    def _write_aside(self, index: TileIndex) -> None:
        table = self._tables.pop(index)
        paths = self._aside.setdefault(index, [])
        path = self._folder / f"{index[0]}_{index[1]}_{len(paths)}.npy"
        paths.append(path)
        self._writing.append(self._writer.submit(table.write, path))


def read_voxels(paths: Iterable[Path]) -> Voxels:
    """Sums of a tile from all files that hold some."""
    parts = []
    for path in paths:
        rows = np.load(path)
        parts.append(Voxels(rows["key"].copy(), rows["sums"].astype(np.int64)))
    return parts[0] if len(parts) == 1 else Voxels.joined(parts)


def write_voxels(path: Path, voxels: Voxels) -> None:
    """Keep sums of a tile in a file."""
    fits = len(voxels) == 0 or voxels.sums.max() <= np.iinfo(np.int32).max
    _write_rows(path, voxels.key, voxels.sums.astype(np.int32 if fits else np.int64))


def _write_rows(path: Path, key: NDArrayInt, sums: NDArrayAny) -> None:
    rows = np.empty(len(key), dtype=[("key", np.int64), ("sums", sums.dtype, _SUMS)])
    rows["key"], rows["sums"] = key, sums
    np.save(path, rows)


class _Table:
    """Voxels in the order in which they were first met, and a hash table of their rows.

    What is next to each other in a sweep is so next to each other in memory.
    """

    def __init__(self) -> None:
        self.slots = np.full(_FIRST_SLOTS, _EMPTY, dtype=np.int32)
        self.key = np.empty(_FIRST_SLOTS // 2, dtype=np.int64)
        self.sums = np.zeros((_FIRST_SLOTS // 2, _SUMS), dtype=np.int32)
        self.used = 0
        self.most_hits = 0

    def make_room(self, more: int) -> None:
        size = len(self.slots)
        while 2 * (self.used + more) > size:
            size *= 2
        if size > len(self.slots):
            self.slots = np.full(size, _EMPTY, dtype=np.int32)
            _fill_slots(self.slots, self.key, self.used)
            key, sums = self.key[: self.used], self.sums[: self.used]
            self.key = np.empty(size // 2, dtype=np.int64)
            self.sums = np.zeros((size // 2, _SUMS), dtype=np.int32)
            self.key[: self.used], self.sums[: self.used] = key, sums

    def write(self, path: Path) -> None:
        """Keep the voxels in a file, sorted."""
        order = np.argsort(self.key[: self.used])
        _write_rows(path, self.key[order], self.sums[order])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _in_tiles(
    points_city: NDArrayFloat,
) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt, tuple[int, int]]:
    """Which tile each return lies in, and which block of it.

    Returns:
        Number (N,) of the block, by tile, ``column * rows + row`` of those around all returns; whole
        millimetres (N, 3) from its corner; index (2,) of the first; columns and rows.
    """
    count = len(points_city)
    tiles = np.empty((count, 2), dtype=np.int64)
    local = np.empty((count, 3), dtype=np.int64)
    low, high = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64)
    for i in range(count):
        for axis in range(2):
            mm = np.int64(np.rint(points_city[i, axis] * 1000.0))
            tile = mm // TILE_MM
            tiles[i, axis] = tile
            local[i, axis] = mm - tile * TILE_MM
            if i == 0 or tile < low[axis]:
                low[axis] = tile
            if i == 0 or tile > high[axis]:
                high[axis] = tile
        local[i, 2] = np.int64(np.rint(points_city[i, 2] * 1000.0))
    columns, rows = high[0] - low[0] + 1, high[1] - low[1] + 1
    number = np.empty(count, dtype=np.int64)
    for i in range(count):
        tile = (tiles[i, 0] - low[0]) * rows + tiles[i, 1] - low[1]
        block = (local[i, 1] * _BLOCKS // TILE_MM) * _BLOCKS + local[i, 0] * _BLOCKS // TILE_MM
        number[i] = tile * _BLOCKS * _BLOCKS + block
    return number, local, low, (columns, rows)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _packed(
    order: NDArrayInt,
    local_mm: NDArrayInt,
    intensity: NDArrayByte,
    is_ground: NDArrayBool,
    range_m: NDArrayFloat,
    voxel_mm: int,
    cell_mm: int,
) -> tuple[NDArrayInt, NDArrayInt]:
    """Voxels of returns, and in one number each: position in the voxel, intensity, ground, weight."""
    key = np.empty(len(order), dtype=np.int64)
    packed = np.empty(len(order), dtype=np.int64)
    # 32 bits divide in a third of the time.
    side, cell = np.uint32(TILE_MM // cell_mm), np.uint32(cell_mm)
    edge, layers = np.uint32(voxel_mm), np.int64((1 << 30) // voxel_mm)
    for k in range(len(order)):
        i = order[k]
        x, y = np.uint32(local_mm[i, 0]), np.uint32(local_mm[i, 1])
        z = np.uint32(local_mm[i, 2] + layers * voxel_mm)
        vx, vy, vz = x // edge, y // edge, z // edge
        of_cell = np.int64((y // cell) * side + x // cell)
        layer = np.int64(vz) - layers + _Z_BIAS
        key[k] = (of_cell << 46) | (np.int64(vy) << 35) | (np.int64(vx) << 24) | layer
        away = range_m[i] / _HALF_WEIGHT_RANGE_M
        weight = np.int64(max(np.rint(_WEIGHT_AT_ONCE / (1.0 + away * away)), 1.0))
        offset = np.int64(x - vx * edge)
        offset = offset << 15 | np.int64(y - vy * edge)
        offset = offset << 15 | np.int64(z - vz * edge)
        offset = offset << 8 | np.int64(intensity[i])
        packed[k] = (offset << 1 | np.int64(is_ground[i])) << 7 | weight
    return key, packed


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _hash(key: int) -> int:
    """Fibonacci hashing of groups of 4 by 4 voxels, which stay beside each other.

    The shifts bring the high bits, which hold the cell, down.
    """
    group = key & ~_IN_GROUP
    group = (group ^ (group >> 29)) * 0x9E3779B97F4A7C1 >> 20
    return group << 4 | (key >> 22 & 12) | (key & 3)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _fill_slots(slots: NDArrayAny, key: NDArrayInt, used: int) -> None:
    """Put rows into an empty hash table."""
    mask = len(slots) - 1
    for row in range(used):
        at = _hash(key[row]) & mask
        while slots[at] != _EMPTY:
            at = (at + 1) & mask
        slots[at] = row


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _add_returns(
    wanted: NDArrayInt,
    packed: NDArrayInt,
    slots: NDArrayAny,
    key: NDArrayInt,
    sums: NDArrayAny,
    used: int,
) -> tuple[int, int]:
    """Add returns to the sums of their voxels.

    Returns:
        How many voxels there are then, and the most hits of those that were added to.
    """
    mask = len(slots) - 1
    most_hits = np.int32(0)
    for i in range(len(wanted)):
        own = wanted[i]
        at = _hash(own) & mask
        while slots[at] != _EMPTY and key[slots[at]] != own:
            at = (at + 1) & mask
        row = int(slots[at])
        if row == _EMPTY:
            row = used
            slots[at], key[row] = row, own
            used += 1
        rest = packed[i]
        w = np.int32(rest & 127)
        sums[row, 0] += w
        sums[row, 1] += w * np.int32(rest >> 46)
        sums[row, 2] += w * np.int32(rest >> 31 & 32767)
        sums[row, 3] += w * np.int32(rest >> 16 & 32767)
        sums[row, 4] += w * np.int32(rest >> 8 & 255)
        sums[row, 5] += np.int32(1)
        sums[row, 6] += np.int32(rest >> 7 & 1)
        most_hits = max(most_hits, sums[row, 5])
    return used, int(most_hits)
