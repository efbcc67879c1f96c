"""Reading a semantic map as the window of probabilities that vectorizers and pictures see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hdmap_tools.fusion.cell_counts import TILE_CELLS, Tile, TileIndex
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.observation_model import ObservationModel
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayAny, NDArrayFloat


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
    posterior = model.posterior(read.counts, read.mean_intensity)
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = -np.where(posterior > 0, posterior * np.log(posterior), 0.0).sum(axis=0)
        entropy[np.isnan(posterior[0])] = np.nan
        height = read.layers["height_sum"] / read.layers["height_n"] / 1000.0
    votes = read.layers["counts"].sum(axis=(0, 1), dtype=np.float64) / source.meta.quanta_per_vote
    return posterior, {
        "entropy": entropy,
        "observations": votes,
        "intensity": mean_intensity_of(read.layers),
        "height": height + source.meta.reference_height_m,
    }


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
        unknown = ~counts.any(axis=(0, 1))
        if not unknown.all() and unknown.any():
            counts = np.where(unknown, box_mean(counts, radius), counts)
            intensity = np.where(unknown, _box_mean_of_known(intensity, radius), intensity)
        inner = (..., slice(radius, -radius), slice(radius, -radius))
        counts, intensity = counts[inner], intensity[inner]
        layers = {name: layer[inner] for name, layer in layers.items()}
    return ReadCounts(counts, intensity, layers)


def mean_intensity_of(layers: dict[str, NDArrayAny]) -> NDArrayFloat:
    """(y, x) mean intensity 0..255 of each cell; NaN where no return measured it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(layers["intensity_sum"] / layers["intensity_n"])


def _box_mean_of_known(values: NDArrayFloat, radius: int) -> NDArrayFloat:
    """Mean of the numbers in a box around each cell (y, x); NaN where there are none."""
    known = np.isfinite(values)
    as_counts = np.stack([known, np.where(known, values, 0.0)])
    number, total = box_mean(as_counts[:, None].astype(np.float64), radius)[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(number > 0.0, total / number, np.nan))


def box_mean(counts: NDArrayAny, radius: int) -> NDArrayFloat:
    """Mean counts of the observed cells in a box around each cell; zeros where there are none.

    Args:
        counts: (label, bin, y, x).
        radius: Half the box, cells; 1 is the paper's 3 x 3 kernel.
    """
    from scipy.ndimage import uniform_filter

    size = 2 * radius + 1
    observed = counts.any(axis=(0, 1)).astype(np.float64)
    share = uniform_filter(observed, size, mode="constant")
    channels = counts.reshape(-1, *counts.shape[2:])
    sums = np.stack(
        [uniform_filter(channel.astype(np.float64), size, mode="constant") for channel in channels]
    )
    sums = sums.reshape(counts.shape)
    # Below half a cell of the box the filter's rounding is all there is.
    there = share > 0.5 / size**2
    return np.where(there, sums / np.where(there, share, 1.0), 0.0).clip(min=0.0)
