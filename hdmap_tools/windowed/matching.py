"""Which stretches of a line run along which other lines: the same line, seen from two windows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely

from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

SAME_WITHIN_M: Final = 0.25
"""Two windows place a line within centimetres of one another; double lines are 0.3 m apart, and
of several lines the nearest one is taken."""

_STEP_M: Final = 0.25
_SAME_HEADING: Final = float(np.cos(np.radians(30.0)))
_JITTER_M: Final = 1.0
"""A run may be interrupted for so long by cells that two windows read differently."""


@dataclass(frozen=True)
class Run:
    """A stretch of a new line along an old one.

    Attributes:
        old: Which one.
        on_new: From where to where on the new line, metres; ascending.
        on_old: The places beside these on the old one; descending if it runs the other way.
        nearest: Where on both they are nearest to one another, not near the stretch's ends.
    """

    old: int
    on_new: tuple[float, float]
    on_old: tuple[float, float]
    nearest: tuple[float, float]

    @property
    def is_turned(self) -> bool:
        """Whether the old line runs the other way."""
        return self.on_old[1] < self.on_old[0]

    @property
    def length(self) -> float:
        """Metres, on the new line."""
        return self.on_new[1] - self.on_new[0]


@dataclass(frozen=True, eq=False)
class _Samples:
    at: NDArrayFloat
    old: NDArrayInt
    on_old: NDArrayFloat
    is_turned: NDArrayBool
    distance: NDArrayFloat


def runs_of(
    new: Sequence[NDArrayFloat], old: Sequence[NDArrayFloat], *, may_turn: bool
) -> list[list[Run]]:
    """For each new line (N, 3) its stretches along old ones, in their order on the new line.

    Args:
        new: Lines of one window.
        old: Lines that were there before.
        may_turn: Whether a line is the same one also if it runs the other way.
    """
    samples = _samples(new, old, may_turn)
    lengths = [float(arc_lengths(points)[-1]) for points in old]
    return [_runs(one, lengths) for one in samples]


def _samples(
    new: Sequence[NDArrayFloat], old: Sequence[NDArrayFloat], may_turn: bool
) -> list[_Samples]:
    places, headings, at = [], [], []
    for points in new:
        arcs = arc_lengths(points)
        count = max(round(float(arcs[-1]) / _STEP_M), 4) + 1
        stations = np.linspace(0.0, arcs[-1], count)
        xy = np.column_stack([np.interp(stations, arcs, points[:, k]) for k in (0, 1)])
        at.append(stations)
        places.append(xy)
        headings.append(_unit(np.gradient(xy, axis=0)))
    bounds = np.cumsum([0, *(len(a) for a in at)])
    xy, heading = np.vstack(places), np.vstack(headings)
    owner, on_old, is_turned, distance = _nearest_segments(xy, heading, old, may_turn)
    parts = [slice(bounds[k], bounds[k + 1]) for k in range(len(new))]
    return [
        _Samples(at[k], owner[part], on_old[part], is_turned[part], distance[part])
        for k, part in enumerate(parts)
    ]


def _nearest_segments(
    xy: NDArrayFloat, heading: NDArrayFloat, old: Sequence[NDArrayFloat], may_turn: bool
) -> tuple[NDArrayInt, NDArrayFloat, NDArrayBool, NDArrayFloat]:
    """Of each place: the nearest line with its heading (-1: none), where on it, turned, how far."""
    number = len(xy)
    nobody = np.full(number, -1), np.zeros(number), np.zeros(number, bool), np.full(number, np.inf)
    first, last, owner, start = [], [], [], []
    low, high = xy.min(axis=0) - SAME_WITHIN_M, xy.max(axis=0) + SAME_WITHIN_M
    for k, points in enumerate(old):
        a, b = points[:-1, :2], points[1:, :2]
        is_near = np.all((np.maximum(a, b) >= low) & (np.minimum(a, b) <= high), axis=1)
        first.append(a[is_near])
        last.append(b[is_near])
        owner.append(np.full(int(is_near.sum()), k))
        start.append(arc_lengths(points)[:-1][is_near])
    if not sum(map(len, owner)):
        return nobody
    a, way = np.vstack(first), np.vstack(last) - np.vstack(first)
    owners, starts = np.concatenate(owner), np.concatenate(start)
    length = np.hypot(*way.T)
    tree = shapely.STRtree(shapely.linestrings(np.stack([a, a + way], axis=1)))
    place, segment = tree.query(shapely.points(xy), predicate="dwithin", distance=SAME_WITHIN_M)
    along = np.einsum("nk,nk->n", xy[place] - a[segment], way[segment])
    share = np.clip(along / np.maximum(length[segment], 1e-12) ** 2, 0.0, 1.0)
    distance = np.hypot(*(a[segment] + share[:, None] * way[segment] - xy[place]).T)
    cosine = np.einsum("nk,nk->n", heading[place], _unit(way)[segment])
    fits = (np.abs(cosine) if may_turn else cosine) >= _SAME_HEADING
    # Of the nearest ones the line that came first, so that nothing hangs on the tree's order.
    order = np.lexsort((segment, distance, place))
    order = order[fits[order]]
    _, at = np.unique(place[order], return_index=True)
    chosen = order[at]
    result = nobody
    for values, found in zip(
        result,
        (
            owners[segment],
            starts[segment] + share * length[segment],
            cosine < 0.0,
            distance,
        ),
        strict=True,
    ):
        values[place[chosen]] = found[chosen]
    return result


def _runs(samples: _Samples, lengths: Sequence[float]) -> list[Run]:
    pieces = [
        (int(samples.old[a]), bool(samples.is_turned[a]), a, b) for a, b in _stretches(samples)
    ]
    joined: list[tuple[int, bool, int, int]] = []
    for old, is_turned, a, b in pieces:
        if joined and joined[-1][:2] == (old, is_turned):
            before = joined[-1][3]
            gap = samples.at[a] - samples.at[before]
            skipped = abs(float(samples.on_old[a] - samples.on_old[before]))
            if max(gap, skipped) <= _JITTER_M:
                joined[-1] = (old, is_turned, joined[-1][2], b)
                continue
        joined.append((old, is_turned, a, b))
    return [_run(samples, old, a, b) for old, _, a, b in joined if b > a]


def _stretches(samples: _Samples) -> Iterator[tuple[int, int]]:
    """First and last sample of the stretches that go steadily along one line."""
    start = None
    for k in range(len(samples.at)):
        goes_on = (
            start is not None
            and samples.old[k] == samples.old[k - 1]
            and samples.is_turned[k] == samples.is_turned[k - 1]
            and abs(samples.on_old[k] - samples.on_old[k - 1]) <= 2.0 * _JITTER_M
        )
        if start is not None and not goes_on:
            yield start, k - 1
            start = None
        if start is None and samples.old[k] >= 0:
            start = k
    if start is not None:
        yield start, len(samples.at) - 1


def _run(samples: _Samples, old: int, a: int, b: int) -> Run:
    quarter = (b - a) // 4
    # Near the ends of a stretch the two may be about to part.
    inner = np.arange(a + quarter, b - quarter + 1)
    known = inner[samples.old[inner] == old]
    if len(known) == 0:
        known = np.array([a, b])
    best = known[np.argmin(samples.distance[known])]
    return Run(
        old,
        (float(samples.at[a]), float(samples.at[b])),
        (float(samples.on_old[a]), float(samples.on_old[b])),
        (float(samples.at[best]), float(samples.on_old[best])),
    )


def _unit(vectors: NDArrayFloat) -> NDArrayFloat:
    return np.asarray(vectors / np.maximum(np.hypot(*vectors.T), 1e-12)[:, None])
