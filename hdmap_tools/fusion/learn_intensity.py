"""Learn what classes look like in intensity from a map itself, with truth or without.

Without truth it is expectation maximization: the votes alone say what each cell
probably is; with that the histograms are filled; with those the cells are judged
anew, a few times. How common each class is is learned along: with the map's prior, under
which a tenth of all ground is paint, asphalt that was mistaken for paint would fill
the histogram of paint. The votes' model stays as it is, so the classes keep their
meaning, and the map's prior stays what it is.
Source: Dempster, Laird, Rubin, Maximum likelihood from incomplete data via the EM
algorithm, 1977.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.fusion.intensity_likelihood import IntensityLikelihood
from hdmap_tools.fusion.observation_model import ObservationModel
from hdmap_tools.fusion.read_window import (
    HasCounts,
    blocks_with_evidence,
    mean_intensity_of,
    read_counts,
)
from hdmap_tools.fusion.temperature import softmax
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.types import NDArrayFloat

ROUNDS: Final = 40
"""Cells are judged anew at most so often."""

_SETTLED: Final = 0.002
"""Rounds end when no class grows or shrinks by more than this share of it."""

MAX_CELLS: Final = 300_000
"""More cells do not change a histogram of 32 bins; bounds time and memory."""


def learn_from_map(
    source: HasCounts,
    model: ObservationModel,
    *,
    rounds: int = ROUNDS,
    weight: float = 1.0,
    max_cells: int = MAX_CELLS,
) -> IntensityLikelihood:
    """What classes look like, from a map and its votes alone.

    Args:
        source: The map.
        model: How its votes are read; an intensity term in it is left aside.
        rounds: How often the cells are judged; 1 uses the votes alone.
        weight: Weight of the intensity when they are judged anew.
        max_cells: Of more cells, so many spread over all tiles are used.

    Raises:
        ShapeError: If no cell of the map has an intensity.
    """
    evidence, intensity = _cells_with_intensity(source, model, max_cells)
    share = np.exp(model.log_prior)
    seen: NDArrayFloat | float = 0.0
    for done in range(1, max(rounds, 1) + 1):  # noqa: B007  (told of below)
        with np.errstate(divide="ignore"):  # a class that cannot be told stays at 0
            belief = softmax(np.log(share)[:, None] + seen + evidence)
        before, share = share, belief.mean(axis=1)
        if (np.abs(share - before) <= _SETTLED * np.maximum(share, 1e-4)).all():
            break
        # Bare histograms: what is added so that no class is ruled out would feed on itself.
        bare = IntensityLikelihood.estimate(
            intensity, belief, model.classes, neutral_cells=1.0, unrelated=0.0
        )
        seen = weight * bare.log_likelihood(intensity)
    return IntensityLikelihood.estimate(
        intensity,
        belief,
        model.classes,
        source=f"the map itself, {len(intensity)} cells, {done} rounds",
    )


def learn_from_truth(
    source: HasCounts,
    grid: BevGrid,
    shares: NDArrayFloat,
    classes: tuple[str, ...],
    name: str = "truth",
) -> IntensityLikelihood:
    """What classes look like, from a map's intensity and the true shares of its cells.

    Args:
        source: The map.
        grid: Cells of the map.
        shares: (class, y, x) share of each cell over that grid; NaN is left out.
        classes: Their names.
        name: Where the truth comes from, kept with the result.

    Raises:
        ShapeError: If the shares do not fit the grid, or no cell has an intensity.
    """
    if shares.shape != (len(classes), *grid.shape):
        raise ShapeError(
            f"Shares must be ({len(classes)}, {grid.shape[0]}, {grid.shape[1]}), found {shares.shape}."
        )
    intensity = np.full(grid.shape, np.nan)
    for block in blocks_with_evidence(source.tile_indices(), grid, 0):
        at = (
            slice(block.y_min - grid.y_min, block.y_max - grid.y_min),
            slice(block.x_min - grid.x_min, block.x_max - grid.x_min),
        )
        intensity[at] = mean_intensity_of(source.window(block).layers)
    return IntensityLikelihood.estimate(intensity, shares, classes, source=name)


def _cells_with_intensity(
    source: HasCounts, model: ObservationModel, max_cells: int
) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Evidence (class, N) and mean intensity (N,) of cells that have both."""
    tiles = source.tile_indices()
    grid = _grid_of(tiles, source)
    a_tile = max(max_cells // max(len(tiles), 1), 1)
    evidence, intensity = [], []
    for block in blocks_with_evidence(tiles, grid, 0):
        read = read_counts(source, block)
        rows, cols = np.nonzero(np.isfinite(read.mean_intensity))
        step = -(-len(rows) // a_tile) if len(rows) else 1
        rows, cols = rows[::step], cols[::step]
        evidence.append(model.evidence(read.counts[:, :, rows, cols][..., None])[..., 0])
        intensity.append(read.mean_intensity[rows, cols])
    if not any(len(part) for part in intensity):
        raise ShapeError(
            "No cell of the map has a lidar intensity, so what classes look like cannot be learned from "
            "it. Turn observation.intensity off, or give observation.intensity_likelihood."
        )
    return np.concatenate(evidence, axis=1), np.concatenate(intensity)


def _grid_of(tiles: tuple[tuple[int, int], ...], source: HasCounts) -> BevGrid:
    from hdmap_tools.fusion.cell_counts import grid_of_tiles

    return grid_of_tiles(tiles, source.meta) or BevGrid(source.meta.resolution_m, 0, 0, 0, 0)
