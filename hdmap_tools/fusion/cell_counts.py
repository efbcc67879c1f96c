"""The map's sufficient statistic: integers per cell, so that fusion is plain addition.

    log P(S=c | z, I) = log prior(c) + sum_l N[l] log M[c, l] + (intensity) - log Z

depends on the observations only through the counts N. Adding frames is adding
integers: the order does not matter, halves of a drive merge to the whole, and a
drive can be taken out again, all exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, MutableMapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hdmap_tools.association.observations import Observations
from hdmap_tools.errors import LabelError, MapMismatchError, ShapeError
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.vote_kernels import MODES, by_tile_and_cell, vote
from hdmap_tools.geometry.grid import BevGrid, cells_of
from hdmap_tools.types import NDArrayAny, NDArrayFloat

TILE_CELLS: Final = 256
"""Cells a side of a tile, which is also a chunk of the store."""

LATTICE_CELLS: Final = 2**21
"""Cells a side of the store's arrays; cell (0, 0) lies in their middle."""

MAX_HEIGHT_MM: Final = 3_000_000
"""Heights further from the reference would overflow the sum of squares within two million points."""

LAYERS: Final[dict[str, type[np.integer[Any]]]] = {
    "counts": np.uint32,
    "height_n": np.uint32,
    "height_sum": np.int64,
    "height_sum_sq": np.uint64,
    "intensity_n": np.uint32,
    "intensity_sum": np.uint64,
}
"""Name and dtype of each layer. Heights in whole millimetres above the map's reference height."""

_NO_SUMS: Final = (np.zeros(0, np.int64), np.zeros(0, np.uint64), np.zeros(0, np.uint64))

TileIndex = tuple[int, int]

Ballot = tuple[tuple[int, int, np.uint64], tuple[int, int, int], tuple[NDArrayAny, ...]]
"""Rule, place and layers of `vote_kernels.vote_cells`."""


@dataclass(eq=False)
class Tile:
    """The layers of `TILE_CELLS` squared cells; ``counts`` is (label, bin, y, x), the rest (y, x)."""

    layers: dict[str, NDArrayAny]

    @classmethod
    def zeros(cls, num_labels: int, num_bins: int, shape: tuple[int, int] | None = None) -> Tile:
        """A tile, or a window of another shape, without any evidence."""
        shape = shape or (TILE_CELLS, TILE_CELLS)
        return cls(
            {
                name: np.zeros((num_labels, num_bins, *shape) if name == "counts" else shape, dtype)
                for name, dtype in LAYERS.items()
            }
        )

    def equals(self, other: Tile) -> bool:
        """Whether all layers are equal, bit for bit."""
        return all(np.array_equal(self.layers[name], other.layers[name]) for name in LAYERS)

    @property
    def num_bytes(self) -> int:
        """Memory that the layers take."""
        return sum(layer.nbytes for layer in self.layers.values())

    @property
    def is_empty(self) -> bool:
        """Whether nothing was observed anywhere."""
        return not any(layer.any() for layer in self.layers.values())


def heights_in_mm(z_city: NDArrayFloat, meta: MapMeta) -> NDArrayAny:
    """Heights (N,) int32 above a map's reference, of city heights (N,) in metres.

    Raises:
        ShapeError: If one is too far from the reference.
    """
    height_mm = np.rint((z_city - meta.reference_height_m) * 1000.0)
    if len(height_mm) and np.abs(height_mm).max() > MAX_HEIGHT_MM:
        raise ShapeError(
            f"A ground point is {np.abs(height_mm).max() / 1000:.0f} m from the map's reference "
            f"height {meta.reference_height_m} m; at most {MAX_HEIGHT_MM // 1000} m are held. "
            "Set fusion.reference_height_m nearer to the ground."
        )
    return height_mm.astype(np.int32)


class CellCounts:
    """Counts of many tiles: what a build adds up, and what maps exchange.

    Attributes:
        meta: What the counts mean; only counts of compatible maps can be added.
        tiles: Tile by index (tx, ty); tile (0, 0) starts at cell (0, 0).
        num_frames: Frames added.

    Args:
        meta: What the counts mean.
        tiles: Empty, to keep them in; by default in memory.
    """

    def __init__(self, meta: MapMeta, tiles: MutableMapping[TileIndex, Tile] | None = None) -> None:
        self.meta = meta
        self.tiles: MutableMapping[TileIndex, Tile] = {} if tiles is None else tiles
        self.num_frames = 0

    def add(self, observations: Observations, frame_key: int) -> None:
        """Add the votes of one frame.

        Args:
            observations: Labelled ground points of the frame, city frame.
            frame_key: Any number that names the frame; it only breaks ties.

        Raises:
            LabelError: If a label is outside the map's label set.
            ShapeError: If a height is too far from the reference height, a point lies
                outside the lattice, or a range is needed and missing.
        """
        self.num_frames += 1
        if len(observations) == 0:
            return
        num_labels, num_bins = len(self.meta.label_set), self.meta.num_bins
        if int(observations.labels.max()) >= num_labels:
            raise LabelError(
                f"Observations hold label id {int(observations.labels.max())}, but label set "
                f"{self.meta.label_set.name!r} has ids 0..{num_labels - 1}."
            )
        cells = cells_of(observations.points_city, self.meta.resolution_m)
        if np.abs(cells).max() >= LATTICE_CELLS // 2:
            raise ShapeError(
                f"A point lies {np.abs(observations.points_city[:, :2]).max() / 1000:.0f} km from the "
                f"city origin; at {self.meta.resolution_m} m the map reaches "
                f"{LATTICE_CELLS // 2 * self.meta.resolution_m / 1000:.0f} km. Use a nearer origin."
            )
        intensity, has_intensity = observations.intensity, observations.has_intensity
        if intensity is None:
            intensity = np.zeros(len(observations), dtype=np.uint8)
            has_intensity = np.zeros(len(observations), dtype=bool)
        elif has_intensity is None:
            has_intensity = np.ones(len(observations), dtype=bool)
        bins = (has_intensity & (intensity >= self.meta.intensity_threshold)).astype(np.int64)
        if self.meta.range_edges_m:
            if observations.range_m is None:
                raise ShapeError(
                    f"The map counts bands of range from {self.meta.range_edges_m} m on, but the "
                    "observations say no range."
                )
            bins += 2 * np.searchsorted(self.meta.range_edges_m, observations.range_m, side="right")
        slots = (1 + observations.labels * np.int32(num_bins) + bins).astype(np.uint16)
        height_mm = heights_in_mm(observations.points_city[:, 2], self.meta)
        for index, order, starts, flat in by_tile_and_cell(cells, TILE_CELLS):
            values = (height_mm[order], intensity[order], has_intensity[order])
            whole = np.array([[0, len(flat)]])
            ballot = self.ballot(index, frame_key)
            vote(whole, starts, flat, slots[order], *ballot, values, _NO_SUMS)

    def ballot(self, index: TileIndex, frame_key: int) -> Ballot:
        """Where and how kernels cast a frame's votes in a tile: rule, place and layers of `vote_cells`."""
        cells = TILE_CELLS * TILE_CELLS
        counts, *layers = (self._tile(index).layers[name] for name in LAYERS)
        key = np.uint64(frame_key & 0xFFFFFFFFFFFFFFFF)
        return (
            (self.meta.num_bins, MODES[self.meta.count_mode], key),
            (index[0] * TILE_CELLS, index[1] * TILE_CELLS, TILE_CELLS),
            (counts.reshape(-1, cells), *(layer.reshape(-1) for layer in layers)),
        )

    def merge(self, other: CellCounts) -> CellCounts:
        """The sum of both; equal to adding all frames of both to one.

        Raises:
            MapMismatchError: If the maps are not compatible, or a count overflows.
        """
        return self._combined(other, sign=1)

    def subtract(self, other: CellCounts) -> CellCounts:
        """Take the frames of the other out again.

        Raises:
            MapMismatchError: If the other's counts are not contained in these.
        """
        return self._combined(other, sign=-1)

    def equals(self, other: CellCounts) -> bool:
        """Whether both hold the same evidence, bit for bit; empty tiles do not count."""
        mine = {i: t for i, t in self.tiles.items() if not t.is_empty}
        theirs = {i: t for i, t in other.tiles.items() if not t.is_empty}
        return mine.keys() == theirs.keys() and all(t.equals(theirs[i]) for i, t in mine.items())

    def tile_indices(self) -> tuple[TileIndex, ...]:
        """Indices of the tiles, sorted."""
        return tuple(sorted(self.tiles))

    @property
    def grid(self) -> BevGrid | None:
        """The smallest grid that covers all tiles, or None when there are none."""
        return grid_of_tiles(self.tiles.keys(), self.meta)

    def window(self, grid: BevGrid) -> Tile:
        """The layers over any grid of this map's lattice, zeros where there is no tile."""
        return window_of_tiles(lambda index: self.tiles.get(index), grid, self.meta)

    def _tile(self, index: TileIndex) -> Tile:
        tile = self.tiles.get(index)
        if tile is None:
            tile = Tile.zeros(len(self.meta.label_set), self.meta.num_bins)
            self.tiles[index] = tile
        return tile

    def _combined(self, other: CellCounts, sign: int) -> CellCounts:
        self.meta.require_compatible(other.meta)
        result = CellCounts(self.meta)
        result.num_frames = self.num_frames + sign * other.num_frames
        shift_mm = round((other.meta.reference_height_m - self.meta.reference_height_m) * 1000)
        for index in sorted(self.tiles.keys() | other.tiles.keys()):
            mine, theirs = self.tiles.get(index), other.tiles.get(index)
            if theirs is None:
                assert mine is not None
                result.tiles[index] = Tile({n: a.copy() for n, a in mine.layers.items()})
                continue
            mine = mine or Tile.zeros(len(self.meta.label_set), self.meta.num_bins)
            result.tiles[index] = combine_tiles(mine, shift_heights(theirs, shift_mm), sign, index)
        return result


def combine_tiles(mine: Tile, theirs: Tile, sign: int, index: TileIndex) -> Tile:
    """Add (sign 1) or subtract (sign -1) a tile, refusing what would leave the integers' range.

    Raises:
        MapMismatchError: If a sum overflows or a difference would be negative.
    """
    layers: dict[str, NDArrayAny] = {}
    for name, dtype in LAYERS.items():
        a, b = mine.layers[name], theirs.layers[name]
        if name == "height_sum":  # signed: any whole number is a sum of heights
            layers[name] = a + sign * b
            continue
        bad = (a > np.iinfo(dtype).max - b) if sign > 0 else (a < b)
        if bad.any():
            what = "overflows" if sign > 0 else "would fall below zero"
            why = (
                "the map holds too many frames"
                if sign > 0
                else "the drive was not part of this map"
            )
            raise MapMismatchError(
                f"Layer {name!r} of tile {index} {what}: {why}. Nothing was changed."
            )
        layers[name] = a + b if sign > 0 else a - b
    return Tile(layers)


def shift_heights(tile: Tile, shift_mm: int) -> Tile:
    """The same tile with heights counted from a reference that lies shift_mm lower; exact."""
    if shift_mm == 0:
        return tile
    n = tile.layers["height_n"].astype(np.int64)
    total = tile.layers["height_sum"]
    layers = dict(tile.layers)
    layers["height_sum"] = total + n * shift_mm
    squares = tile.layers["height_sum_sq"].astype(np.int64)
    layers["height_sum_sq"] = (squares + 2 * shift_mm * total + n * shift_mm**2).astype(np.uint64)
    return Tile(layers)


def grid_of_tiles(indices: Iterable[TileIndex], meta: MapMeta) -> BevGrid | None:
    """The smallest grid that covers these tiles, or None when there are none."""
    listed = list(indices)
    if not listed:
        return None
    xs, ys = [i[0] for i in listed], [i[1] for i in listed]
    return BevGrid(
        meta.resolution_m,
        min(xs) * TILE_CELLS,
        min(ys) * TILE_CELLS,
        (max(xs) + 1) * TILE_CELLS,
        (max(ys) + 1) * TILE_CELLS,
        meta.frame,
    )


def window_of_tiles(read: Callable[[TileIndex], Tile | None], grid: BevGrid, meta: MapMeta) -> Tile:
    """Cut a window out of tiles; zeros where `read` gives None.

    Raises:
        MapMismatchError: If the grid has another resolution than the map.
    """
    if grid.resolution_m != meta.resolution_m:
        raise MapMismatchError(
            f"A window of {grid.resolution_m} m was asked of a map of {meta.resolution_m} m."
        )
    window = Tile.zeros(len(meta.label_set), meta.num_bins, grid.shape)
    for ty in range(grid.y_min // TILE_CELLS, -(-grid.y_max // TILE_CELLS)):
        for tx in range(grid.x_min // TILE_CELLS, -(-grid.x_max // TILE_CELLS)):
            tile = read((tx, ty))
            if tile is None:
                continue
            x0, y0 = max(grid.x_min, tx * TILE_CELLS), max(grid.y_min, ty * TILE_CELLS)
            x1 = min(grid.x_max, (tx + 1) * TILE_CELLS)
            y1 = min(grid.y_max, (ty + 1) * TILE_CELLS)
            to = (slice(y0 - grid.y_min, y1 - grid.y_min), slice(x0 - grid.x_min, x1 - grid.x_min))
            of = (
                slice(y0 - ty * TILE_CELLS, y1 - ty * TILE_CELLS),
                slice(x0 - tx * TILE_CELLS, x1 - tx * TILE_CELLS),
            )
            for name, layer in window.layers.items():
                layer[..., to[0], to[1]] = tile.layers[name][..., of[0], of[1]]
    return window
