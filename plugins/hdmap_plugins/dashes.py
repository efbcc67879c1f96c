"""Which strokes of paint are one line: dashes in a regular rhythm, and lines broken by wear."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hdmap_plugins.lines import fold_cuts
from hdmap_plugins.profiles import Stroke
from hdmap_plugins.sampling import nearest
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_MAX_WIDTH_RATIO = 2.5
"""Strokes whose widths differ more are not one line; over a few cells a width is good to a factor."""


@dataclass(frozen=True)
class JoinRules:
    """When strokes belong together; lengths in cells.

    Attributes:
        max_gap: Longest gap between two dashes.
        max_dash: Longer strokes are no dashes.
        min_gap: Shorter known gaps are wear: they neither break a dash nor make one.
        bridge_gap: Longest gap in an unbroken line (wear), over known cells only.
        min_dashes: Fewer make no rhythm.
        rhythm: Share by which dashes and gaps may differ from their median.
        max_angle_deg: Largest angle between a stroke's end and the way to the next.
        min_solid: Less paint than this is no line by itself.
        max_fold: A turn of `MAX_TURN_DEG` within this length is a fold, which no line has.
    """

    max_gap: float
    max_dash: float
    min_gap: float
    bridge_gap: float
    min_dashes: int
    rhythm: float
    max_angle_deg: float
    min_solid: float
    max_fold: float


@dataclass(frozen=True)
class Line:
    """Strokes along one line, in order and all in its direction.

    Attributes:
        strokes: One, unless it is dashed.
        is_dashed: Whether they make a rhythm.
        is_lone: Whether it is too short for a line and nothing in its row says that it
            is part of one: arrows, letters and fragments are like that.
    """

    strokes: tuple[Stroke, ...]
    is_dashed: bool
    is_lone: bool = False

    @property
    def paint(self) -> float:
        """Painted length, cells."""
        return sum(s.length for s in self.strokes)


@dataclass(frozen=True)
class _Gap:
    length: float
    is_known: bool


def join_strokes(strokes: list[Stroke], is_known: NDArrayBool, rules: JoinRules) -> list[Line]:
    """Put strokes together that are one painted line.

    Each free end looks for the stroke that continues it; two ends that choose one
    another are neighbours. Along such a row, at least ``min_dashes`` short strokes of
    like length at like gaps are one dashed line. A gap over unknown cells may also
    hide whole dashes, if it fits the rhythm; nothing else is bridged over unknown
    cells. What is no dash is joined over short known gaps only.
    """
    lines: list[Line] = []
    for found in _rows(strokes, rules):
        row = _fused(found, is_known, rules.min_gap, rules)
        of_row: list[Line] = []
        gaps = [_gap(a, b, is_known) for a, b in pairwise(row)]
        start = 0
        while start < len(row):
            length = _dashed_run(row[start:], gaps[start:], rules)
            if length >= rules.min_dashes:
                of_row.append(Line(tuple(row[start : start + length]), True))
                start += length
                continue
            # Unbroken until a gap too long or unknown, or until dashes begin.
            end = start + 1
            while end < len(row) and (_dashed_run(row[end:], gaps[end:], rules) < rules.min_dashes):
                end += 1
            of_row += [
                Line((stroke,), False)
                for stroke in _fused(row[start:end], is_known, rules.bridge_gap, rules)
            ]
            start = end
        lines += _with_lone_ones_told(of_row, rules)
    return lines


def _with_lone_ones_told(row: list[Line], rules: JoinRules) -> list[Line]:
    """The lines of one row, those marked that are too short and have no company in it.

    Company is paint beyond a gap no longer than the paint on either side of it (a line
    that wear or what was not seen has cut into pieces), until there is enough for a
    line; or dashes in the same row, of the same length, at a multiple of their period.
    """
    gaps = [_gap_length(a, b) for a, b in pairwise(row)]
    is_near = [g <= min(a.paint, b.paint) for g, (a, b) in zip(gaps, pairwise(row), strict=True)]
    dashed = max((line for line in row if line.is_dashed), key=lambda x: x.paint, default=None)
    result = []
    for index, line in enumerate(row):
        first = last = index
        while first > 0 and is_near[first - 1]:
            first -= 1
        while last < len(row) - 1 and is_near[last]:
            last += 1
        beside = gaps[max(index - 1, 0) : index + 1]
        is_lone = (
            not line.is_dashed
            and sum(x.paint for x in row[first : last + 1]) < rules.min_solid
            and not (dashed is not None and _is_dash_of(dashed, line, beside, rules))
        )
        result.append(replace(line, is_lone=is_lone))
    return result


def _is_dash_of(dashed: Line, line: Line, gaps: list[float], rules: JoinRules) -> bool:
    """Whether a line is one more dash of a row, some of which are missing in between."""
    dash = float(np.median([s.length for s in dashed.strokes]))
    between = [
        _gap_length(Line((a,), False), Line((b,), False)) for a, b in pairwise(dashed.strokes)
    ]
    # Unseen gaps may hide dashes, so the shorter half of them is the rhythm's.
    gap = float(np.quantile(between, 0.25))
    if abs(line.paint - dash) > rules.rhythm * dash + 2.0:
        return False
    period, slack = dash + gap, rules.rhythm * gap + 2.0
    return any(
        g >= gap - slack and abs((g - gap) - period * round((g - gap) / period)) <= slack
        for g in gaps
    )


def _gap_length(a: Line, b: Line) -> float:
    return float(np.hypot(*(b.strokes[0].xy_cells[0] - a.strokes[-1].xy_cells[-1])))


def _fused(
    row: list[Stroke], is_known: NDArrayBool, max_gap: float, rules: JoinRules
) -> list[Stroke]:
    """The row with neighbours made one where only a short known gap parts them."""
    result = row[:1]
    for stroke in row[1:]:
        last = result[-1]
        gap = _gap(last, stroke, is_known)
        narrow, wide = sorted((last.width_cells, stroke.width_cells))
        if not gap.is_known or gap.length > max_gap or wide > _MAX_WIDTH_RATIO * narrow:
            result.append(stroke)
            continue
        between = _between(last, stroke)
        joined = np.vstack([last.xy_cells, between, stroke.xy_cells])
        if fold_cuts(joined, rules.max_fold):
            result.append(stroke)
            continue
        width = (last.width_cells + stroke.width_cells) / 2.0
        result[-1] = Stroke(
            joined,
            np.concatenate([last.mass, np.full(len(between), width), stroke.mass]),
            # Nothing was seen there: it counts against the line's confidence.
            np.concatenate([last.peak, np.zeros(len(between)), stroke.peak]),
            float(np.hypot(last.scatter_cells, stroke.scatter_cells) / np.sqrt(2.0)),
            (last.at_junction[0], stroke.at_junction[1]),
            is_fused=True,
        )
    return result


def _dashed_run(row: list[Stroke], gaps: list[_Gap], rules: JoinRules) -> int:
    """How many strokes from the first on make one rhythm (1 when none do)."""
    best = 1
    for count in range(rules.min_dashes, len(row) + 1):
        lengths = np.array([s.length for s in row[:count]])
        known = np.array([g.length for g in gaps[: count - 1] if g.is_known])
        if len(known) == 0:
            # Every gap is unseen: no rhythm was observed yet.
            continue
        gap = float(np.median(known))
        # First and last may be cut off by the edge of what was seen.
        inner = lengths[1:-1] if count > 2 else lengths
        dash = float(np.median(inner))
        dash_slack, gap_slack = rules.rhythm * dash + 2.0, rules.rhythm * gap + 2.0
        regular = (
            rules.min_gap <= gap <= rules.max_gap
            and lengths.max() <= min(rules.max_dash, dash + dash_slack)
            and np.all(np.abs(inner - dash) <= dash_slack)
            and all(_fits(g, gap, dash, gap_slack) for g in gaps[: count - 1])
        )
        if not regular:
            break
        best = count
    return best


def _fits(gap: _Gap, typical: float, dash: float, slack: float) -> bool:
    if abs(gap.length - typical) <= slack:
        return True
    hidden = round((gap.length - typical) / (typical + dash))
    off = abs(gap.length - typical - hidden * (typical + dash))
    return not gap.is_known and hidden >= 1 and off <= slack


def _gap(a: Stroke, b: Stroke, is_known: NDArrayBool) -> _Gap:
    first, last = a.xy_cells[-1], b.xy_cells[0]
    length = float(np.hypot(*(last - first)))
    places = np.linspace(first, last, max(int(np.ceil(length * 2.0)), 2))[1:-1]
    return _Gap(length, bool(np.all(nearest(is_known, places))) if len(places) else True)


def _outward(stroke: Stroke, end: int) -> NDArrayFloat:
    """Unit direction in which a stroke leaves at its end, over its last twenty cells."""
    xy = stroke.xy_cells if end == 1 else stroke.xy_cells[::-1]
    tail = xy[-min(len(xy), 20) :]
    chord: NDArrayFloat = tail[-1] - tail[0]
    return chord / max(float(np.hypot(*chord)), 1e-12)


def _rows(strokes: list[Stroke], rules: JoinRules) -> list[list[Stroke]]:
    """Strokes in rows of mutual neighbours, each turned into the direction of its row."""
    ends = [
        (i, e)
        for i, s in enumerate(strokes)
        for e in (0, 1)
        if not s.at_junction[e] and not s.is_closed
    ]
    place = {k: strokes[k[0]].xy_cells[0 if k[1] == 0 else -1] for k in ends}
    leave = {k: _outward(strokes[k[0]], k[1]) for k in ends}
    reach = max(rules.max_gap, rules.bridge_gap) * 3.0
    choice: dict[tuple[int, int], tuple[int, int]] = {}
    all_places = np.array([place[k] for k in ends]).reshape(-1, 2)
    all_leave = np.array([leave[k] for k in ends]).reshape(-1, 2)
    owner = np.array([k[0] for k in ends])
    for p in ends:
        cost = _costs(
            place[p], leave[p], all_places, all_leave, reach, np.radians(rules.max_angle_deg)
        )
        cost[owner == p[0]] = np.inf
        best = int(np.argmin(cost))
        if np.isfinite(cost[best]):
            choice[p] = ends[best]
    partner = {p: q for p, q in choice.items() if choice.get(q) == p}

    rows: list[list[Stroke]] = []
    used: set[int] = set()
    starts = [p for p in ends if p not in partner] + list(ends)
    for start in starts:
        if start[0] in used:
            continue
        row: list[Stroke] = []
        at: tuple[int, int] | None = start
        while at is not None and at[0] not in used:
            used.add(at[0])
            row.append(strokes[at[0]] if at[1] == 0 else strokes[at[0]].reversed())
            at = partner.get((at[0], 1 - at[1]))
        rows.append(row)
    rows += [[s] for i, s in enumerate(strokes) if i not in used]
    return rows


def _costs(
    from_xy: NDArrayFloat,
    heading: NDArrayFloat,
    to_xy: NDArrayFloat,
    other_heading: NDArrayFloat,
    reach: float,
    max_angle: float,
) -> NDArrayFloat:
    """Distance (N,) to each end, longer by every bend; inf where the ends do not continue one another."""
    result = np.full(len(to_xy), np.inf)
    distance = np.hypot(*(to_xy - from_xy).T)
    near = np.flatnonzero(distance <= reach)
    distance = distance[near]
    chord = to_xy[near] - from_xy
    # Over a gap of a few cells the angle of the way across is noise.
    slack = np.arctan2(1.5, distance)
    turn_out = _turns(heading[None], chord)
    turn_in = _turns(chord, -other_heading[near])
    # On an arc both turns are equal; opposite ones are a jump to a parallel line.
    fits = (np.maximum(np.abs(turn_out), np.abs(turn_in)) <= max_angle + slack) & (
        np.abs(turn_out - turn_in) <= 0.6 * max_angle + 2.0 * slack
    )
    cost = distance * (1.0 + np.abs(turn_out) + np.abs(turn_in))
    result[near] = np.where(distance < 1e-9, 0.0, np.where(fits, cost, np.inf))
    return result


def _turns(a: NDArrayFloat, b: NDArrayFloat) -> NDArrayFloat:
    return np.asarray(
        np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
    )


def stations_of(line: Line) -> tuple[NDArrayFloat, NDArrayBool]:
    """Stations along a whole line about one cell apart, and which of them are painted."""
    parts, painted = [line.strokes[0].xy_cells], [np.ones(len(line.strokes[0].xy_cells), bool)]
    for a, b in pairwise(line.strokes):
        between = _between(a, b)
        parts += [between, b.xy_cells]
        painted += [np.zeros(len(between), bool), np.ones(len(b.xy_cells), bool)]
    return np.vstack(parts), np.concatenate(painted)


def _between(a: Stroke, b: Stroke) -> NDArrayFloat:
    """Stations about one cell apart on the straight way from one stroke to the next."""
    first, last = a.xy_cells[-1], b.xy_cells[0]
    count = max(round(float(np.hypot(*(last - first)))) - 1, 0)
    return np.asarray(np.linspace(first, last, count + 2)[1:-1])
