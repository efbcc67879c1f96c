"""One frame's votes in the cells that it saw, compiled.

Tests hold it equal to a plain numpy form (tests/fusion/plain_voting.py), bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.counting_sort import counting_sort
from hdmap_tools.fusion.voting import SHARE_QUANTA
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayInt

POINT: Final = 0
FRAME: Final = 1
MAJORITY: Final = 2
SHARE: Final = 3
MODES: Final = {"point": POINT, "frame": FRAME, "majority": MAJORITY, "share": SHARE}

_A: Final = np.uint64(0x9E3779B97F4A7C15)
_B: Final = np.uint64(0xC2B2AE3D27D4EB4F)
_C: Final = np.uint64(0x165667B19E3779F9)
_D: Final = np.uint64(0xBF58476D1CE4E5B9)
_E: Final = np.uint64(0x94D049BB133111EB)
_30: Final = np.uint64(30)
_27: Final = np.uint64(27)
_31: Final = np.uint64(31)

_CROWDED: Final = 16
"""So many points in a cell are worth passing over again and again."""

_NO_SLOT: Final = np.uint16(65535)

_MAX_TILES: Final = 64
"""More tiles than that at once are sorted by comparing: counts would take 16 MB and more."""


def by_tile_and_cell(
    cells: NDArrayInt, side: int
) -> Iterator[tuple[tuple[int, int], NDArrayInt, NDArrayInt, NDArrayInt]]:
    """Sort points by cell, tile after tile.

    Args:
        cells: (N, 2) int64 lattice cells of the points, N at least 1.
        side: Cells a side of a tile.

    Yields:
        Tile (tx, ty), rows of its points in order of their cell, where in these each
        occupied cell begins (K + 1,), and the cells (K,), ``y * side + x`` in the tile.
    """
    tiles = cells // side
    low = tiles.min(axis=0)
    width, height = (int(n) for n in tiles.max(axis=0) - low + 1)
    tile = (tiles[:, 0] - low[0]) * height + tiles[:, 1] - low[1]
    within = cells - tiles * side
    keys = (tile * side + within[:, 1]) * side + within[:, 0]
    if width * height <= _MAX_TILES:
        order, found, starts = counting_sort(keys, width * height * side * side)
    else:
        order = np.argsort(keys, kind="stable")
        found, starts = np.unique(keys[order], return_index=True)
        starts = np.append(starts, len(keys)).astype(np.int64)
    tile_of_cell = found // (side * side)
    edges = np.flatnonzero(np.diff(tile_of_cell, prepend=-1, append=-1))
    for a, b in pairwise(edges.tolist()):
        tx, ty = divmod(int(tile_of_cell[a]), height)
        first, last = starts[a], starts[b]
        yield (
            (tx + int(low[0]), ty + int(low[1])),
            order[first:last],
            starts[a : b + 1] - first,
            found[a:b] % (side * side),
        )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _hash(ix: int, iy: int, channel: int, key: np.uint64) -> np.uint64:
    """As `voting._hash`."""
    mixed = np.uint64(ix) * _A ^ np.uint64(iy) * _B ^ np.uint64(channel) * _C ^ key
    mixed = (mixed ^ (mixed >> _30)) * _D
    mixed = (mixed ^ (mixed >> _27)) * _E
    return mixed ^ (mixed >> _31)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def scratch_for(num_channels: int) -> tuple[NDArrayAny, ...]:
    """What `vote_cells` writes into while it counts."""
    return (
        np.zeros(num_channels, dtype=np.int64),
        np.empty(num_channels, dtype=np.int64),
        np.empty(num_channels, dtype=np.uint64),
        np.empty(num_channels, dtype=np.int64),
        np.empty(num_channels, dtype=np.int64),
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def vote(
    runs: NDArrayInt,
    starts: NDArrayInt,
    cells: NDArrayInt,
    slots: NDArrayAny,
    rule: tuple[int, int, np.uint64],
    place: tuple[int, int, int],
    layers: tuple[NDArrayAny, ...],
    values: tuple[NDArrayAny, NDArrayByte, NDArrayAny],
    sums: tuple[NDArrayAny, NDArrayAny, NDArrayAny],
) -> None:
    """Add the votes of one frame to a tile, and sums of height and intensity.

    Args:
        runs: (R, 2) ranges of cells to look at.
        starts: With
        cells: of the cells,
        slots: (N,) of their points,
        rule: and
        place: and
        layers: and
        values: and
        sums: as of `vote_cells`.
    """
    scratch = scratch_for(len(layers[0]))
    for r in range(len(runs)):
        first, last = runs[r, 0], runs[r, 1]
        vote_cells(
            first, last, starts, cells, (slots, 0), rule, place, layers, values, sums, scratch
        )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def vote_cells(
    first_cell: int,
    last_cell: int,
    starts: NDArrayInt,
    cells: NDArrayInt,
    found: tuple[NDArrayAny, int],
    rule: tuple[int, int, np.uint64],
    place: tuple[int, int, int],
    layers: tuple[NDArrayAny, ...],
    values: tuple[NDArrayAny, NDArrayByte, NDArrayAny],
    sums: tuple[NDArrayAny, NDArrayAny, NDArrayAny],
    scratch: tuple[NDArrayAny, ...],
) -> int:
    """Add the votes of one frame in a range of cells; gives how many points were seen.

    Args:
        first_cell: With
        last_cell: the half-open range.
        starts: (K + 1,) first point of each cell.
        cells: (K,) flat cell in the tile, ``y * side + x``.
        found: Slots (M,) uint16, ``1 + label * num_bins + bin``, of points by cell, 0 not seen; and the
            point that the first of them is of.
        rule: Bins of a label; one of `MODES`; what names the frame, to break ties.
        place: Lattice cell (ix, iy) of the tile's first, and cells a side of the tile.
        layers: Changed: counts (channels, side * side); number, sum and sum of squares of
            heights, number and sum of intensities (side * side).
        values: (N,) int32 height above the map's reference, millimetres; (N,) uint8 intensity;
            (N,) bool which have one, or empty: all.
        sums: (K,) each, of all points of a cell: height, its square, intensity; or empty.
        scratch: Of `scratch_for`.
    """
    num_bins, mode, key = rule
    height_mm, intensity, has_intensity = values
    height_sums, square_sums, intensity_sums = sums
    counts, height_n, height_sum, height_sum_sq, intensity_n, intensity_sum = layers
    slots, base = found
    points, touched, chance, quanta, remainder = scratch
    has_sums, all_measured = len(height_sums) > 0, len(has_intensity) == 0
    in_all = np.int64(0)
    for k in range(first_cell, last_cell):
        first, last = starts[k], starts[k + 1]
        count = last - first
        if count == 0:
            continue
        here = slots[first - base : last - base]
        num, seen = 0, np.int64(0)
        # Most cells lie within one thing: a loop without a branch says so.
        same, differing = here[0], 0
        for i in range(count):
            differing += here[i] != same
        if differing == 0:
            if same > 0:
                touched[0], points[same - 1] = np.int64(same) - 1, count
                num, seen = 1, np.int64(count)
        elif _CROWDED <= count < _NO_SLOT:
            # One pass for each thing in it, 16 bits wide: faster than a tally, whose next count
            # must wait for the last.
            slot = _NO_SLOT
            for i in range(count):
                slot = min(slot, here[i])
            while slot != _NO_SLOT:
                total, following = np.uint16(0), _NO_SLOT
                for i in range(count):
                    total = np.uint16(total + np.uint16(here[i] == slot))
                    following = min(following, here[i] if here[i] > slot else _NO_SLOT)
                if slot > 0:
                    touched[num], points[np.int64(slot) - 1] = np.int64(slot) - 1, np.int64(total)
                    num += 1
                    seen += np.int64(total)
                slot = following
        else:
            for i in range(count):
                channel = np.int64(here[i]) - 1
                if channel < 0:
                    continue
                if points[channel] == 0:
                    touched[num] = channel
                    num += 1
                points[channel] += 1
                seen += 1
        if num == 0:
            continue
        cell = cells[k]
        ix = iy = 0
        if num > 1:  # only then may there be a tie; a division takes as long as many points
            ix, iy = place[0] + cell % place[2], place[1] + cell // place[2]
        if mode == POINT:
            for j in range(num):
                counts[touched[j], cell] += np.uint32(points[touched[j]])
        elif num == 1:
            counts[touched[0], cell] += np.uint32(SHARE_QUANTA if mode == SHARE else 1)
        elif mode == SHARE and num == 2:
            # One quantum at most is left, for the larger remainder; the remainders add up to `seen`.
            share = np.uint32(SHARE_QUANTA * points[touched[0]])
            first_share = np.int64(share // np.uint32(seen))
            twice = 2 * (np.int64(share) - first_share * seen)
            if twice > seen or (
                twice == seen and _hash(ix, iy, touched[0], key) < _hash(ix, iy, touched[1], key)
            ):
                first_share += 1
            counts[touched[0], cell] += np.uint32(first_share)
            counts[touched[1], cell] += np.uint32(SHARE_QUANTA - first_share)
        elif mode == SHARE:
            left = SHARE_QUANTA
            for j in range(num):
                channel = touched[j]
                # 32 bits divide in half the time; 2**28 points in a cell are none of ours.
                share = np.uint32(SHARE_QUANTA * points[channel])
                quanta[j] = np.int64(share // np.uint32(seen))
                remainder[j] = np.int64(share) - quanta[j] * seen
                chance[j] = _hash(ix, iy, channel, key)
                left -= quanta[j]
            for _ in range(left):
                best = -1
                for j in range(num):
                    if remainder[j] < 0:
                        continue
                    if (
                        best < 0
                        or remainder[j] > remainder[best]
                        or (remainder[j] == remainder[best] and chance[j] < chance[best])
                    ):
                        best = j
                quanta[best] += 1
                remainder[best] = -1
            for j in range(num):
                counts[touched[j], cell] += np.uint32(quanta[j])
        else:
            won, won_points, won_chance = -1, 0, np.uint64(0)
            for j in range(num):
                label = touched[j] // num_bins
                is_first = True
                for i in range(j):
                    if touched[i] // num_bins == label:
                        is_first = False
                if not is_first:
                    continue
                best, total = touched[j], points[touched[j]]
                for i in range(j + 1, num):
                    other = touched[i]
                    if other // num_bins != label:
                        continue
                    total += points[other]
                    if points[other] > points[best] or (
                        points[other] == points[best]
                        and _hash(ix, iy, other, key) < _hash(ix, iy, best, key)
                    ):
                        best = other
                if mode == FRAME:
                    counts[best, cell] += np.uint32(1)
                    continue
                luck = _hash(ix, iy, label, key)
                if total > won_points or (total == won_points and luck < won_chance):
                    won, won_points, won_chance = best, total, luck
            if mode == MAJORITY:
                counts[won, cell] += np.uint32(1)
        for j in range(num):
            points[touched[j]] = 0
        in_all += seen
        height_n[cell] += np.uint32(seen)
        if has_sums and seen == count:
            height_sum[cell] += height_sums[k]
            height_sum_sq[cell] += square_sums[k]
            intensity_n[cell] += np.uint32(count)
            intensity_sum[cell] += intensity_sums[k]
            continue
        total_h, total_sq, total_i = np.int64(0), np.int64(0), np.int64(0)
        measured = 0
        for i in range(first, last):
            if slots[i - base] == 0:
                continue
            h = np.int64(height_mm[i])
            total_h += h
            total_sq += h * h
            if all_measured or has_intensity[i]:
                measured += 1
                total_i += np.int64(intensity[i])
        height_sum[cell] += total_h
        height_sum_sq[cell] += np.uint64(total_sq)
        intensity_n[cell] += np.uint32(measured)
        intensity_sum[cell] += np.uint64(total_i)
    return int(in_all)
