"""Reading a semantic map as the window of probabilities that vectorizers and pictures see."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from hdmap_tools.fusion.cell_counts import TILE_CELLS, Tile, TileIndex, window_of_tiles
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.observation_model import ObservationModel
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayFloat, NDArrayInt

_TILES_IN_MEMORY: Final = 24
"""Of 19 labels and two bins, 240 MB of counts."""


class HasCounts(Protocol):
    """A semantic map on disk, or counts in memory."""

    meta: MapMeta

    def tile_indices(self) -> tuple[TileIndex, ...]:
        """Indices of the tiles that may hold evidence."""
        ...

    def window(self, grid: BevGrid) -> Tile:
        """The layers over a grid."""
        ...


def read_window(
    source: HasCounts, grid: BevGrid, model: ObservationModel, fill_radius_cells: int = 0
) -> MapWindow:
    """The posterior and its companions over a grid.

    Counts are read tile by tile and where there are any, so that beside the result
    (4 bytes a cell, class and layer) only a tile's counts are in memory.

    Args:
        source: Where the counts come from.
        grid: A window of the source's lattice.
        model: How counts are read.
        fill_radius_cells: Unknown cells take the mean evidence of a box of this
            radius (the paper's smoothing, on the sums and only where nothing was
            seen); 0 leaves them unknown.
    """
    import xarray as xr

    posterior = np.full((len(model.classes), *grid.shape), np.nan, dtype=np.float32)
    layers = {
        "entropy": np.full(grid.shape, np.nan, dtype=np.float32),
        "observations": np.zeros(grid.shape, dtype=np.float32),
        "intensity": np.full(grid.shape, np.nan, dtype=np.float32),
        "height": np.full(grid.shape, np.nan, dtype=np.float32),
    }
    source = _RecentTiles(source)
    for block in blocks_with_evidence(source.tile_indices(), grid, fill_radius_cells):
        rows = slice(block.y_min - grid.y_min, block.y_max - grid.y_min)
        cols = slice(block.x_min - grid.x_min, block.x_max - grid.x_min)
        posterior[:, rows, cols], read = _read_block(source, block, model, fill_radius_cells)
        for name, values in read.items():
            layers[name][rows, cols] = values
    dataset = xr.Dataset(
        {
            "posterior": (("class", "y", "x"), posterior),
            **{name: (("y", "x"), values) for name, values in layers.items()},
        },
        coords={"class": list(model.classes), "y": grid.y_centres_m, "x": grid.x_centres_m},
    )
    return MapWindow(dataset, grid)


def blocks_with_evidence(
    tiles: tuple[TileIndex, ...], grid: BevGrid, reach_cells: int
) -> Iterator[BevGrid]:
    """The grid cut along tiles; only pieces with a tile in them or within reach."""
    near = -(-reach_cells // TILE_CELLS)
    steps = range(-near, near + 1)
    wanted = {(tx + dx, ty + dy) for tx, ty in tiles for dx in steps for dy in steps}
    for tx, ty in sorted(wanted):
        x0, y0 = max(grid.x_min, tx * TILE_CELLS), max(grid.y_min, ty * TILE_CELLS)
        x1 = min(grid.x_max, (tx + 1) * TILE_CELLS)
        y1 = min(grid.y_max, (ty + 1) * TILE_CELLS)
        if x0 < x1 and y0 < y1:
            yield BevGrid(grid.resolution_m, x0, y0, x1, y1, grid.frame)


def _read_block(
    source: HasCounts, block: BevGrid, model: ObservationModel, radius: int
) -> tuple[NDArrayFloat, dict[str, NDArrayAny]]:
    """Posterior (class, y, x) and the other layers (y, x) of one block."""
    read = read_counts(source, block, radius)
    # Most of a map is unknown: only cells with counts are put through the model.
    rows, cols = np.nonzero((read.counts > 0).any(axis=(0, 1)))
    posterior = np.full((len(model.classes), *block.shape), np.nan)
    entropy = np.full(block.shape, np.nan)
    if len(rows):
        known = model.posterior(
            read.counts[:, :, rows, cols][..., None], read.mean_intensity[rows, cols][:, None]
        )[..., 0]
        posterior[:, rows, cols] = known
        # A probability of 0 adds nothing, and its logarithm would be infinite.
        entropy[rows, cols] = -(known * np.log(np.where(known > 0, known, 1.0))).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = read.layers["height_sum"] / read.layers["height_n"] / 1000.0
    votes = read.layers["counts"].sum(axis=(0, 1), dtype=np.float64) / source.meta.quanta_per_vote
    return posterior, {
        "entropy": entropy,
        "observations": votes,
        "intensity": mean_intensity_of(read.layers),
        "height": height + source.meta.reference_height_m,
    }


class _RecentTiles:
    """A source whose tiles are read once, though each block asks for its neighbours' edges."""

    def __init__(self, source: HasCounts) -> None:
        self.meta = source.meta
        self._source = source
        self._present = frozenset(source.tile_indices())
        # Blocks come column by column, so the columns before and behind are still wanted.
        columns = Counter(x for x, _ in self._present)
        self._most = min(3 * max(columns.values(), default=0), _TILES_IN_MEMORY)
        self._recent: OrderedDict[TileIndex, Tile] = OrderedDict()

    def tile_indices(self) -> tuple[TileIndex, ...]:
        """As the source."""
        return tuple(sorted(self._present))

    def window(self, grid: BevGrid) -> Tile:
        """As the source."""
        return window_of_tiles(self._tile, grid, self.meta)

    def _tile(self, index: TileIndex) -> Tile | None:
        if index not in self._present:
            return None
        if index not in self._recent:
            x, y = index[0] * TILE_CELLS, index[1] * TILE_CELLS
            grid = BevGrid(
                self.meta.resolution_m, x, y, x + TILE_CELLS, y + TILE_CELLS, self.meta.frame
            )
            self._recent[index] = self._source.window(grid)
        self._recent.move_to_end(index)
        while len(self._recent) > max(self._most, 1):
            self._recent.popitem(last=False)
        return self._recent[index]


@dataclass(frozen=True, eq=False)
class ReadCounts:
    """What the observation model is given over a block.

    Attributes:
        counts: (label, bin, y, x); where nothing was seen, the mean of the neighbours.
        mean_intensity: (y, x) mean intensity 0..255, filled likewise; NaN where none.
        layers: What was seen in the cells themselves, by layer of `cell_counts.LAYERS`.
    """

    counts: NDArrayAny
    mean_intensity: NDArrayFloat
    layers: dict[str, NDArrayAny]


def read_counts(source: HasCounts, block: BevGrid, radius: int = 0) -> ReadCounts:
    """Counts and mean intensity over a block, unknown cells filled from a box of this radius."""
    # A margin, so that filling does not see the block's edge.
    layers = source.window(block.expand(radius)).layers
    counts, intensity = layers["counts"], mean_intensity_of(layers)
    if radius > 0:
        observed = np.asarray(counts.any(axis=(0, 1)))
        inner = (..., slice(radius, -radius), slice(radius, -radius))
        rows, cols = _unknown_near(observed, radius)
        inside = counts[inner]
        if len(rows):
            inside = inside.astype(np.float64)
            at = (rows - radius, cols - radius)
            inside[:, :, *at] = box_mean_at(counts, observed, radius, rows, cols)
            filled = intensity[inner].copy()
            filled[at] = _box_mean_of_known_at(intensity, radius, rows, cols)
            intensity = filled
        else:
            intensity = intensity[inner]
        counts, layers = inside, {name: layer[inner] for name, layer in layers.items()}
    return ReadCounts(counts, intensity, layers)


def _unknown_near(observed: NDArrayBool, radius: int) -> tuple[NDArrayInt, NDArrayInt]:
    """Cells further than the radius from the edge that are unknown, with a known one in their box."""
    rows, cols = np.nonzero(~observed[radius:-radius, radius:-radius])
    rows, cols = rows + radius, cols + radius
    near = _box_sums(observed[None], radius, rows, cols)[0] > 0
    return rows[near], cols[near]


def mean_intensity_of(layers: dict[str, NDArrayAny]) -> NDArrayFloat:
    """(y, x) mean intensity 0..255 of each cell; NaN where no return measured it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(layers["intensity_sum"] / layers["intensity_n"])


def _box_mean_of_known_at(
    values: NDArrayFloat, radius: int, rows: NDArrayInt, cols: NDArrayInt
) -> NDArrayFloat:
    """Mean of the numbers in a box around cells (N,) of values (y, x); NaN where there are none."""
    known = np.isfinite(values)
    number, total = _box_sums(np.stack([known, np.where(known, values, 0.0)]), radius, rows, cols)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(number > 0.0, total.clip(min=0.0) / number, np.nan))


def box_mean_at(
    counts: NDArrayAny, observed: NDArrayBool, radius: int, rows: NDArrayInt, cols: NDArrayInt
) -> NDArrayFloat:
    """(label, bin, N) mean counts of the observed cells in a box around some cells.

    Args:
        counts: (label, bin, y, x) whole numbers.
        observed: (y, x) cells with any count.
        radius: Half the box, cells; 1 is the paper's 3 x 3 kernel.
        rows: With
        cols: (N,) cells whose box lies in the array and holds an observed one.
    """
    channels = counts.reshape(-1, *counts.shape[2:])
    used = np.flatnonzero(channels.any(axis=(1, 2)))
    mean = np.zeros((len(channels), len(rows)))
    sums = _box_sums(channels[used], radius, rows, cols)
    mean[used] = sums / _box_sums(observed[None], radius, rows, cols)
    return mean.reshape(*counts.shape[:2], -1)


def _box_sums(values: NDArrayAny, radius: int, rows: NDArrayInt, cols: NDArrayInt) -> NDArrayFloat:
    """(K, N) sums of values (K, y, x) over a box around cells, by running sums; exact for whole numbers."""
    height, width = values.shape[1:]
    sums = np.empty((len(values), len(rows)))
    running = np.zeros((height + 1, width + 1))
    top, left = rows - radius, cols - radius
    bottom, right = rows + radius + 1, cols + radius + 1
    for k, one in enumerate(values):
        np.cumsum(one, axis=0, dtype=np.float64, out=running[1:, 1:])
        np.cumsum(running[1:, 1:], axis=1, out=running[1:, 1:])
        sums[k] = running[bottom, right] - running[top, right]
        sums[k] -= running[bottom, left] - running[top, left]
    return sums
