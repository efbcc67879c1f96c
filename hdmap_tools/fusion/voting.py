"""How one frame votes in each cell it saw: the count modes.

Points of one frame are not independent, so a frame casts votes of fixed weight
however many points fell in the cell (except in mode ``point``, the paper's text).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from hdmap_tools.types import NDArrayAny, NDArrayInt

CountMode = Literal["majority", "share", "frame", "point"]

SHARE_QUANTA: Final = 16
"""A frame's vote in mode ``share`` is split into so many whole parts, so that sums stay exact."""

_OFFSET: Final = 2**30
"""Beyond any cell's index, so that shifted indices are not negative."""


def quanta_per_vote(mode: CountMode) -> int:
    """How many counts one frame's vote is worth."""
    return SHARE_QUANTA if mode == "share" else 1


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
    unique_cells, cell, channel, points = _tally(np.asarray(cells, dtype=np.int64), channels)
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


def _tally(
    cells: NDArrayInt, channels: NDArrayInt
) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt, NDArrayInt]:
    """Cells (C, 2) in order; and a row for each cell and channel: cell, channel, number of points."""
    from hdmap_tools.fusion.vote_kernels import tally

    return tally(cells, channels) or tally_by_sorting(cells, channels)


def tally_by_sorting(
    cells: NDArrayInt, channels: NDArrayInt
) -> tuple[NDArrayInt, NDArrayInt, NDArrayInt, NDArrayInt]:
    """The same as `vote_kernels.tally`, for points however far apart."""
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
