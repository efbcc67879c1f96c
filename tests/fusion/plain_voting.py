"""The votes of a frame in plain numpy, to hold the compiled ones to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.association.observations import Observations
from hdmap_tools.fusion.cell_counts import TILE_CELLS, CellCounts, Tile, heights_in_mm
from hdmap_tools.fusion.voting import SHARE_QUANTA, CountMode
from hdmap_tools.geometry.grid import cells_of
from hdmap_tools.types import NDArrayAny, NDArrayInt

_OFFSET: Final = 2**30
"""Beyond any cell's index, so that shifted indices are not negative."""


def add_plainly(counts: CellCounts, seen: Observations, frame_key: int) -> None:
    """What `CellCounts.add` does to counts, for observations with intensity and without ranges."""
    counts.num_frames += 1
    meta = counts.meta
    cells = cells_of(seen.points_city, meta.resolution_m)
    intensity = np.zeros(len(seen), np.uint8) if seen.intensity is None else seen.intensity
    measured = np.full(len(seen), seen.intensity is not None)
    if seen.has_intensity is not None:
        measured = seen.has_intensity
    bins = (measured & (intensity >= meta.intensity_threshold)).astype(np.int64)
    votes = cast_votes(
        cells, seen.labels, bins, num_bins=2, mode=meta.count_mode, frame_key=frame_key
    )
    height_mm = heights_in_mm(seen.points_city[:, 2], meta).astype(np.int64)
    for tx, ty in np.unique(cells // TILE_CELLS, axis=0).tolist():
        tile = counts.tiles.setdefault((tx, ty), Tile.zeros(len(meta.label_set), 2))
        layers = tile.layers

        def flat_in_tile(
            cells: NDArrayInt, tx: int = tx, ty: int = ty
        ) -> tuple[NDArrayAny, NDArrayInt]:
            inside = (cells // TILE_CELLS == (tx, ty)).all(axis=1)
            within = cells[inside] - np.array([tx, ty]) * TILE_CELLS
            return inside, within[:, 1] * TILE_CELLS + within[:, 0]

        rows, flat = flat_in_tile(votes.cells)
        channels = layers["counts"].reshape(-1, TILE_CELLS**2)
        np.add.at(channels, (votes.channels[rows], flat), votes.quanta[rows].astype(np.uint32))
        rows, flat = flat_in_tile(cells)
        for name, amounts in (
            ("height_n", np.ones(rows.sum())),
            ("height_sum", height_mm[rows]),
            ("height_sum_sq", height_mm[rows] ** 2),
            ("intensity_n", measured[rows]),
            ("intensity_sum", np.where(measured[rows], intensity[rows], 0)),
        ):
            layer = layers[name].reshape(-1)
            np.add.at(layer, flat, amounts.astype(layer.dtype))


@dataclass(frozen=True, eq=False)
class Votes:
    """Votes of one frame; rows are unique in (cell, channel).

    Attributes:
        cells: (N, 2) int64 lattice cells (ix, iy).
        channels: (N,) int64, ``label * num_bins + bin``.
        quanta: (N,) int64, at least 1.
    """

    cells: NDArrayInt
    channels: NDArrayInt
    quanta: NDArrayInt


def cast_votes(
    cells: NDArrayInt,
    labels: NDArrayAny,
    bins: NDArrayAny,
    *,
    num_bins: int,
    mode: CountMode,
    frame_key: int,
) -> Votes:
    """Turn the labelled points of one frame into its votes.

    Ties (two labels seen equally often in a cell) are broken by a hash of cell,
    label and frame: the same in every run and every order of frames, and in
    favour of no label. Always giving them to one label moves each edge by up to
    a cell.

    Args:
        cells: (N, 2) int64 lattice cells of the points.
        labels: (N,) label ids.
        bins: (N,) intensity bins, 0 to num_bins - 1.
        num_bins: Number of intensity bins.
        mode: See `hdmap_tools.config.FusionConfig`.
        frame_key: Any number that names the frame.
    """
    if len(cells) == 0:
        empty = np.zeros(0, dtype=np.int64)
        return Votes(np.zeros((0, 2), dtype=np.int64), empty, empty)
    channels = labels.astype(np.int64) * num_bins + bins.astype(np.int64)
    unique_cells, cell, channel, points = tally_by_sorting(
        np.asarray(cells, dtype=np.int64), channels
    )
    if mode == "point":
        return Votes(unique_cells[cell], channel, points)
    chance = _hash(unique_cells[cell], channel, frame_key)
    if mode == "share":
        quanta = _apportion(cell, points, chance)
        kept = quanta > 0
        return Votes(unique_cells[cell[kept]], channel[kept], quanta[kept])
    # A label's votes lie in the bin that most of its points fell in.
    label = channel // num_bins
    row_of_label = cell * (int(label.max()) + 1) + label
    best_bin = _first_of_each(row_of_label, points, chance)
    if mode == "frame":
        return Votes(
            unique_cells[cell[best_bin]], channel[best_bin], np.ones(len(best_bin), np.int64)
        )
    label_points = np.bincount(np.unique(row_of_label, return_inverse=True)[1], weights=points)
    label_chance = _hash(unique_cells[cell[best_bin]], label[best_bin], frame_key)
    winner = best_bin[_first_of_each(cell[best_bin], label_points, label_chance)]
    return Votes(unique_cells[cell[winner]], channel[winner], np.ones(len(winner), np.int64))


def tally_by_sorting(
    cells: NDArrayInt, channels: NDArrayInt
) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt, NDArrayInt]:
    """Cells (C, 2) in order; and a row for each cell and channel: cell, channel, number of points."""
    # Cells as single numbers: sorting rows is many times slower.
    packed, cell_index = np.unique(
        (cells[:, 0] + _OFFSET) * (2 * _OFFSET) + cells[:, 1] + _OFFSET, return_inverse=True
    )
    unique_cells = np.column_stack([packed // (2 * _OFFSET), packed % (2 * _OFFSET)]) - _OFFSET
    # One row for each (cell, channel) with the number of points in it.
    span = int(channels.max()) + 1
    key, points = np.unique(cell_index * span + channels, return_counts=True)
    return unique_cells, key // span, key % span, points.astype(np.int64)


def _first_of_each(group: NDArrayInt, points: NDArrayAny, chance: NDArrayAny) -> NDArrayInt:
    """Row with most points in each group, ties by chance."""
    order = np.lexsort((chance, -points, group))
    sorted_group = group[order]
    is_first = np.concatenate([[True], sorted_group[1:] != sorted_group[:-1]])
    return np.asarray(order[is_first])


def _apportion(cell: NDArrayInt, points: NDArrayInt, chance: NDArrayAny) -> NDArrayInt:
    """Share `SHARE_QUANTA` among the rows of each cell by largest remainder."""
    total = np.bincount(cell, weights=points).astype(np.int64)[cell]
    quanta = SHARE_QUANTA * points // total
    remainder = SHARE_QUANTA * points - quanta * total
    left = SHARE_QUANTA - np.bincount(cell, weights=quanta).astype(np.int64)
    order = np.lexsort((chance, -remainder, cell))
    sorted_cell = cell[order]
    starts = np.flatnonzero(np.concatenate([[True], sorted_cell[1:] != sorted_cell[:-1]]))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    quanta[order] += rank < left[sorted_cell]
    return np.asarray(quanta, dtype=np.int64)


def _hash(cells: NDArrayInt, channel: NDArrayInt, frame_key: int) -> NDArrayAny:
    """A well-mixed uint64 of (cell, channel, frame); splitmix64's finalizer."""
    with np.errstate(over="ignore"):
        mixed = (
            cells[:, 0].astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
            ^ cells[:, 1].astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
            ^ channel.astype(np.uint64) * np.uint64(0x165667B19E3779F9)
            ^ np.uint64(frame_key & 0xFFFFFFFFFFFFFFFF)
        )
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return np.asarray(mixed ^ (mixed >> np.uint64(31)))
