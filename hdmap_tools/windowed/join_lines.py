"""Lines that several windows saw parts of, put together again.

Windows are added one after the other, in a fixed order. Where a line of the next window runs
along one that is there already, the two are the same line seen twice; what is new of it goes
on from that line's end. The change from one to the other is made in the middle of what both
saw, where they are nearest to one another. A line that runs along a seam is so kept once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import shapely

from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.map_model.elements import LaneMark, MapElement, MarkStyle, StopLine
from hdmap_tools.types import NDArrayFloat
from hdmap_tools.windowed.combining import combined
from hdmap_tools.windowed.matching import Run, runs_of
from hdmap_tools.windowed.pieces import Piece

_UNDIRECTED: Final = (LaneMark, StopLine)
"""Their direction means nothing, so two windows may give one line in two directions."""

_END_WITHIN_M: Final = 3.0
"""An old line that goes on no further than that beyond what both saw ends there."""

_LEAST_NEW_M: Final = 1.0
"""What is new of a line and no longer than that adds nothing: ends are seen a little differently."""

_FORK_M: Final = 3.0
"""Where a line merges into another one the two run together for about so long."""

_CLEAR_M: Final = 0.1
"""Vertices nearer to where two lines were put together are left out."""

_TURNED_STYLE: Final = {
    MarkStyle.DASHED_SOLID: MarkStyle.SOLID_DASHED,
    MarkStyle.SOLID_DASHED: MarkStyle.DASHED_SOLID,
}

_End = tuple[int, int]
"""A strand and its end: 0 where it starts, 1 where it ends."""


@dataclass(eq=False)
class _Strand:
    """A line as far as it is known.

    Attributes:
        points: (N, 3) vertices.
        parts: The elements that it was put together from, with the length of each.
        is_whole: It is one element as its vectorizer made it.
    """

    points: NDArrayFloat
    parts: list[tuple[MapElement, float]]
    is_whole: bool

    @property
    def length(self) -> float:
        return float(arc_lengths(self.points)[-1])

    @property
    def is_ring(self) -> bool:
        return len(self.points) > 3 and bool(np.array_equal(self.points[0], self.points[-1]))

    def turned(self) -> _Strand:
        parts = [(_turned(element), length) for element, length in self.parts]
        return _Strand(self.points[::-1], parts, self.is_whole)


@dataclass
class _Chain:
    """Strands of one window and before, and which of their ends go together, cut where."""

    strands: list[_Strand]
    partner: dict[_End, _End] = field(default_factory=dict)
    cut: dict[_End, float] = field(default_factory=dict)

    def link(self, a: _End, at_a: float, b: _End, at_b: float) -> None:
        self.partner[a], self.partner[b] = b, a
        self.cut[a], self.cut[b] = at_a, at_b


def join_lines(windows: Sequence[Sequence[Piece]]) -> list[MapElement]:
    """The lines of all windows as elements of the map.

    Args:
        windows: What each handed over, of one vectorizer and one type of element.
    """
    strands: list[_Strand] = []
    for pieces in windows:
        fresh = [_strand(piece) for piece in pieces]
        if fresh:
            strands = _added(strands, fresh) if strands else fresh
    return [_element(strand) for strand in strands]


def _strand(piece: Piece) -> _Strand:
    points = shapely.get_coordinates(piece.geometry, include_z=True)
    parts = [(piece.element, float(piece.geometry.length))]
    return _Strand(points, parts, not piece.is_cut)


def _added(old: list[_Strand], new: list[_Strand]) -> list[_Strand]:
    may_turn = isinstance(new[0].parts[0][0], _UNDIRECTED)
    fresh = [strand.points for strand in new]
    found = runs_of(fresh, [strand.points for strand in old], may_turn=may_turn)
    inside = {run.old for runs, one in zip(found, new, strict=True) for run in runs
              if _is_covered(old[run.old], run) and one.length > old[run.old].length}  # fmt: skip
    if inside:
        # What one window saw all of stays as it is, without a change in its middle.
        old = [strand for k, strand in enumerate(old) if k not in inside]
        found = runs_of(fresh, [strand.points for strand in old], may_turn=may_turn)
    chain = _Chain(list(old))
    for strand, runs in zip(new, found, strict=True):
        _add_one(chain, strand, runs)
    return _assembled(chain)


def _is_covered(strand: _Strand, run: Run) -> bool:
    low, high = sorted(run.on_old)
    return low <= _LEAST_NEW_M and high >= strand.length - _LEAST_NEW_M and high > low


def _add_one(chain: _Chain, strand: _Strand, runs: list[Run]) -> None:
    """Add what is new of a strand, linked to the strands that it goes on from."""
    if strand.is_ring and runs:
        strand, runs = _opened(strand, runs)
    ends = [(_end_at(chain, run, 0), _end_at(chain, run, 1)) for run in runs]
    kept = [
        k
        for k, run in enumerate(runs)
        if run.length >= _FORK_M
        or ends[k] != (None, None)
        or strand.length - run.length < _LEAST_NEW_M
    ]
    runs, ends = [runs[k] for k in kept], [ends[k] for k in kept]
    for before, after in zip([None, *range(len(runs))], [*range(len(runs)), None], strict=True):
        left = None if before is None else runs[before]
        right = None if after is None else runs[after]
        start = 0.0 if left is None else left.on_new[1]
        end = strand.length if right is None else right.on_new[0]
        # Ends of old strands that are still free; the first to come has them.
        links = [None if before is None else ends[before][1], None if after is None else ends[after][0]]  # fmt: skip
        links = [None if link in chain.partner else link for link in links]
        if links[0] is not None and links[0] == links[1]:
            links = [None, None]
        is_all = left is None and right is None
        if end - start < _LEAST_NEW_M and not all(links) and not is_all:
            continue
        if left is not None and right is not None and not any(links) and _is_detour(left, right):
            continue
        if left is not None and links[0] is not None:
            start = left.nearest[0]
        if right is not None and links[1] is not None:
            end = right.nearest[0]
        if end <= start:
            continue
        number = len(chain.strands)
        chain.strands.append(strand if is_all else _between(strand, start, end))
        for side, run in ((0, left), (1, right)):
            link = links[side]
            if run is not None and link is not None:
                at = 0.0 if side == 0 else chain.strands[number].length
                chain.link((number, side), at, link, run.nearest[1])


def _is_detour(left: Run, right: Run) -> bool:
    """Whether the old line goes from one run to the next as well, on a way about as long."""
    if left.old != right.old or left.is_turned != right.is_turned:
        return False
    way = right.on_new[0] - left.on_new[1]
    old_way = (right.on_old[0] - left.on_old[1]) * (-1.0 if left.is_turned else 1.0)
    return abs(old_way - way) <= 0.3 * way + 1.0


def _end_at(chain: _Chain, run: Run, side: int) -> _End | None:
    """The end of the old strand near that side of a run; None where that goes on.

    Side 1: where the new line goes on beyond the run, and the old one should have ended.
    """
    old = chain.strands[run.old]
    if old.is_ring:
        return None
    at = run.on_old[side]
    towards_end = (side == 1) != run.is_turned
    left_over = old.length - at if towards_end else at
    return (run.old, int(towards_end)) if left_over <= _END_WITHIN_M else None


def _opened(strand: _Strand, runs: list[Run]) -> tuple[_Strand, list[Run]]:
    """A new ring begun in the middle of its longest run."""
    longest = max(runs, key=lambda run: run.length)
    at, total = longest.nearest[0], strand.length
    if longest.length >= total - _LEAST_NEW_M or not 0.0 < at < total:
        return strand, runs
    points = np.vstack([_cut_out(strand.points, at, total), _cut_out(strand.points, 0.0, at)[1:]])
    opened = _Strand(points, strand.parts, is_whole=False)
    on_old = longest.nearest[1]
    halves = [
        Run(longest.old, (0.0, longest.on_new[1] - at), (on_old, longest.on_old[1]), (0.0, on_old)),
        Run(
            longest.old,
            (total - at + longest.on_new[0], total),
            (longest.on_old[0], on_old),
            (total, on_old),
        ),
    ]
    middle = [
        Run(r.old, ((r.on_new[0] - at) % total, (r.on_new[1] - at) % total), r.on_old,
            ((r.nearest[0] - at) % total, r.nearest[1]))
        for r in runs
        if r is not longest
    ]  # fmt: skip
    return opened, sorted([halves[0], *middle, halves[1]], key=lambda run: run.on_new)


def _between(strand: _Strand, start: float, end: float) -> _Strand:
    points = _cut_out(strand.points, start, end)
    share = (end - start) / max(strand.length, 1e-9)
    return _Strand(points, [(e, length * share) for e, length in strand.parts], is_whole=False)


def _cut_out(points: NDArrayFloat, start: float, end: float) -> NDArrayFloat:
    """The polyline from one place on it to another, metres along it."""
    arcs = arc_lengths(points)
    ends = np.column_stack([np.interp([start, end], arcs, points[:, k]) for k in range(3)])
    inner = points[(arcs > start + 1e-9) & (arcs < end - 1e-9)]
    return np.vstack([ends[:1], inner, ends[1:]])


def _assembled(chain: _Chain) -> list[_Strand]:
    """The strands with those that are linked put together, in the order of the first of each."""
    result: list[_Strand] = []
    used: set[int] = set()
    for first in range(len(chain.strands)):
        if first in used:
            continue
        if (first, 0) not in chain.partner and (first, 1) not in chain.partner:
            used.add(first)
            result.append(chain.strands[first])
            continue
        row, is_closed = _row(chain, first)
        used.update(k for k, _ in row)
        result.append(_joined(chain, row, is_closed))
    return result


def _row(chain: _Chain, first: int) -> tuple[list[tuple[int, bool]], bool]:
    """Strands that are linked with one, in order, each with whether it is turned; and whether they close."""
    row = [(first, False)]
    for side in (1, 0):
        at, is_turned = row[-1] if side == 1 else row[0]
        while True:
            leave = (at, side if not is_turned else 1 - side)
            entered = chain.partner.get(leave)
            if entered is None:
                break
            if entered[0] == first and side == 1:
                return row, True
            at, is_turned = entered[0], entered[1] == side
            row.insert(len(row) if side == 1 else 0, (at, is_turned))
    return row, False


def _joined(chain: _Chain, row: list[tuple[int, bool]], is_closed: bool) -> _Strand:
    pieces: list[NDArrayFloat] = []
    parts: list[tuple[MapElement, float]] = []
    for number, is_turned in row:
        strand = chain.strands[number]
        start = chain.cut.get((number, 0), 0.0)
        end = chain.cut.get((number, 1), strand.length)
        if end - start > 1e-6:
            strand = _between(strand, start, end)
        else:
            # Cut at both ends in one place: it only leads from one neighbour to the other.
            place = _cut_out(strand.points, start, start)[:1]
            strand = _Strand(np.vstack([place, place]), [], is_whole=False)
        strand = strand.turned() if is_turned else strand
        pieces.append(strand.points)
        parts += strand.parts
    points = pieces[0]
    for piece in pieces[1:]:
        points = _spliced(points, piece)
    if is_closed:
        meeting = (points[0] + points[-1]) / 2.0
        inner = points[1:-1]
        inner = inner[np.hypot(*(inner - meeting)[:, :2].T) > _CLEAR_M]
        points = np.vstack([meeting, inner, meeting])
    return _Strand(points, parts, is_whole=False)


def _spliced(a: NDArrayFloat, b: NDArrayFloat) -> NDArrayFloat:
    """Two polylines that end and start at one place, as one through the middle of both ends."""
    meeting = (a[-1] + b[0]) / 2.0
    before, after = a[:-1], b[1:]
    while len(before) > 1 and np.hypot(*(before[-1] - meeting)[:2]) <= _CLEAR_M:
        before = before[:-1]
    while len(after) > 1 and np.hypot(*(after[0] - meeting)[:2]) <= _CLEAR_M:
        after = after[1:]
    return np.vstack([before, meeting, after])


def _turned(element: MapElement) -> MapElement:
    style = getattr(element, "style", None)
    if style in _TURNED_STYLE:
        return element.model_copy(update={"style": _TURNED_STYLE[style]})
    return element


def _element(strand: _Strand) -> MapElement:
    if strand.is_whole:
        return strand.parts[0][0]
    return combined(strand.parts, shapely.linestrings(strand.points))
