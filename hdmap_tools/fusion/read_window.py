"""Reading a semantic map as the window of probabilities that vectorizers and pictures see."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hdmap_tools.fusion.cell_counts import Tile
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.observation_model import ObservationModel
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayAny, NDArrayFloat


class HasCounts(Protocol):
    """A semantic map on disk, or counts in memory."""

    meta: MapMeta

    def window(self, grid: BevGrid) -> Tile:
        """The layers over a grid."""
        ...


def read_window(
    source: HasCounts, grid: BevGrid, model: ObservationModel, fill_radius_cells: int = 0
) -> MapWindow:
    """The posterior and its companions over a grid.

    Args:
        source: Where the counts come from.
        grid: A window of the source's lattice.
        model: How counts are read.
        fill_radius_cells: Unknown cells take the mean evidence of a box of this
            radius (the paper's smoothing, on the sums and only where nothing was
            seen); 0 leaves them unknown.
    """
    import xarray as xr

    # A margin, so that filling does not see the window's edge.
    wide = grid.expand(fill_radius_cells)
    layers = source.window(wide).layers
    counts = layers["counts"]
    posterior = model.posterior(counts)
    if fill_radius_cells > 0:
        unknown = np.isnan(posterior[0])
        filled = model.posterior(box_mean(counts, fill_radius_cells))
        posterior = np.where(unknown, filled, posterior)
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = -np.where(posterior > 0, posterior * np.log(posterior), 0.0).sum(axis=0)
        entropy[np.isnan(posterior[0])] = np.nan
        height = layers["height_sum"] / layers["height_n"] / 1000.0 + source.meta.reference_height_m
        intensity = layers["intensity_sum"] / layers["intensity_n"]
    votes = counts.sum(axis=(0, 1), dtype=np.float64) / source.meta.quanta_per_vote
    inner = (
        (slice(fill_radius_cells, -fill_radius_cells),) * 2
        if fill_radius_cells
        else (slice(None), slice(None))
    )

    def plane(values: NDArrayAny) -> tuple[tuple[str, str], NDArrayAny]:
        return ("y", "x"), np.ascontiguousarray(values[inner], dtype=np.float32)

    dataset = xr.Dataset(
        {
            "posterior": (
                ("class", "y", "x"),
                np.ascontiguousarray(posterior[(slice(None), *inner)], dtype=np.float32),
            ),
            "entropy": plane(entropy),
            "observations": plane(votes),
            "intensity": plane(intensity),
            "height": plane(height),
        },
        coords={"class": list(model.classes), "y": grid.y_centres_m, "x": grid.x_centres_m},
    )
    return MapWindow(dataset, grid)


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
    channels = counts.reshape(-1, *counts.shape[2:]).astype(np.float64)
    sums = np.stack([uniform_filter(channel, size, mode="constant") for channel in channels])
    sums = sums.reshape(counts.shape)
    # Below half a cell of the box the filter's rounding is all there is.
    there = share > 0.5 / size**2
    return np.where(there, sums / np.where(there, share, 1.0), 0.0).clip(min=0.0)
