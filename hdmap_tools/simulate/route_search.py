"""Which lanes to drive: long, with as few lanes twice as the map allows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely

from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.simulate.smooth_line import between
from hdmap_tools.simulate.world_map import WorldLane, WorldMap

MIN_CHANGE_M: Final = 25.0
"""Lanes shorter than this are not changed on."""
_LOOK_AHEAD_M: Final = 400.0
_MAX_STARTS: Final = 48
_TRIES: Final = 3
_AS_LONG: Final = 0.98
_AS_GOOD: Final = 0.85
_CROSSING_WORTH_M: Final = 20.0
_BESIDE_WORTH: Final = 0.25


@dataclass(frozen=True)
class RoadGraph:
    """Road lanes that can be driven, and where one can go from each.

    Attributes:
        length_m: Of each lane's middle.
        successors: Lanes ahead.
        changes: Lanes beside, in the same direction, behind a dashed line.
        sights_m: What a lane has to show, as metres of plain lane that weigh as much: 20 for
            each crossing on it, a quarter of its length where it has a neighbour in its direction.
    """

    length_m: Mapping[str, float]
    successors: Mapping[str, tuple[str, ...]]
    changes: Mapping[str, tuple[str, ...]]
    sights_m: Mapping[str, float]

    @classmethod
    def of_world(cls, world: WorldMap) -> RoadGraph:
        """Of a world's road lanes."""
        roads = {k: lane for k, lane in world.lanes.items() if lane.kind == "road"}
        middles = {k: between(lane.left, lane.right)[0] for k, lane in roads.items()}
        length_m = {k: float(arc_lengths(middle)[-1]) for k, middle in middles.items()}
        length_m = {k: length for k, length in length_m.items() if length > 0.1}
        successors = {k: tuple(s for s in roads[k].successors if s in length_m) for k in length_m}
        beside = _neighbours(roads, length_m)
        crossings = shapely.STRtree(world.crosswalks)
        sights_m = {}
        for k, length in length_m.items():
            crossed = crossings.query(shapely.LineString(middles[k]), predicate="intersects")
            shown = _BESIDE_WORTH * length if beside[k] else 0.0
            sights_m[k] = shown + _CROSSING_WORTH_M * len(crossed)
        return cls(length_m, successors, _lane_changes(world, roads, length_m, beside), sights_m)


def _neighbours(
    roads: Mapping[str, WorldLane], length_m: Mapping[str, float]
) -> dict[str, set[str]]:
    """Lanes in the same direction that share a line of the map."""
    by_left: dict[str, list[str]] = {}
    for k in length_m:
        if (left_line := roads[k].left_line) is not None:
            by_left.setdefault(left_line, []).append(k)
    beside: dict[str, set[str]] = {k: set() for k in length_m}
    for k in length_m:
        for other in by_left.get(roads[k].right_line or "", ()):
            # The neighbour on the right runs the same way if the shared line does in both.
            if other != k and np.allclose(roads[k].right[0], roads[other].left[0], atol=0.3):
                beside[k].add(other)
                beside[other].add(k)
    return beside


def _lane_changes(
    world: WorldMap,
    roads: Mapping[str, WorldLane],
    length_m: Mapping[str, float],
    beside: Mapping[str, set[str]],
) -> dict[str, tuple[str, ...]]:
    """Neighbours that a dashed line lets one change to, on lanes long enough to do so."""
    dashed = {
        line.id for line in world.lines if line.paint is not None and "dashed" in line.paint.style
    }

    def may_change(k: str, other: str) -> bool:
        shared = {roads[k].left_line, roads[k].right_line} & {
            roads[other].left_line,
            roads[other].right_line,
        }
        return bool(shared & dashed) and min(length_m[k], length_m[other]) >= MIN_CHANGE_M

    return {k: tuple(sorted(o for o in beside[k] if may_change(k, o))) for k in length_m}


def find_lanes(
    graph: RoadGraph, length_m: float, starts: Sequence[str], rng: np.random.Generator
) -> list[str]:
    """The lanes of one of the best drives from any of the starts.

    Drives are compared by how long they become (up to `length_m`), how much of them is new
    road, and what there is to see. From each start some are tried: at every fork a lane
    driven least, from which the drive can go on long enough; the first time the one with
    the most new road ahead.

    Args:
        graph: Lanes that can be driven.
        length_m: Wanted.
        starts: Lanes to start on.
        rng: Chooses among the starts whose drives are about as good as the best.

    Returns:
        Ids in driving order. Where two that follow each other are neighbours and no
        successors, the vehicle changes lane.
    """
    reach_m = _reach(graph, length_m)
    order = [starts[k] for k in rng.permutation(len(starts))]
    order.sort(key=lambda k: -round(min(reach_m[k], length_m)))
    found = []
    for start in order[:_MAX_STARTS]:
        for attempt in range(_TRIES):
            lanes = _drive(graph, length_m, start, reach_m, rng, is_greedy=attempt == 0)
            found.append((*_measure(graph, lanes, length_m), lanes))
    longest = max(driven for driven, _, _ in found)
    long = [(worth, lanes) for driven, worth, lanes in found if driven >= _AS_LONG * longest]
    best = max(worth for worth, _ in long)
    return next(lanes for worth, lanes in long if worth >= _AS_GOOD * best)


def _reach(graph: RoadGraph, length_m: float) -> dict[str, float]:
    """The longest drive from the begin of each lane, lanes driven again allowed, up to a limit.

    The limit is somewhat above `length_m`, so that a drive that goes on beats one that ends.
    Lanes from which one comes back to where one was have no other limit.
    """
    import networkx

    limit = length_m + 50.0
    ways = networkx.DiGraph()
    ways.add_nodes_from(graph.length_m)
    for k in graph.length_m:
        ways.add_edges_from((k, other) for other in (*graph.successors[k], *graph.changes[k]))
    reach: dict[str, float] = {}
    # Components come after those that they lead into.
    for component in networkx.strongly_connected_components(ways):
        is_loop = any(s in component for k in component for s in graph.successors[k])
        # Else they are neighbours, and one can change to the one that leads on.
        found = max(
            graph.length_m[k] + max((reach[s] for s in graph.successors[k]), default=0.0)
            if not is_loop
            else limit
            for k in component
        )
        reach |= dict.fromkeys(component, min(found, limit))
    return reach


def _drive(
    graph: RoadGraph,
    length_m: float,
    start: str,
    reach_m: Mapping[str, float],
    rng: np.random.Generator,
    is_greedy: bool,
) -> list[str]:
    visits: Counter[str] = Counter([_place(start)])
    lanes = [start]
    driven = graph.length_m[start]
    has_changed = False
    while driven < length_m:
        here = lanes[-1]
        needed = length_m - driven
        options = graph.successors[here]
        can_go_on = max((reach_m[k] for k in options), default=0.0)
        if can_go_on < needed and not has_changed:
            better = [
                k for k in graph.changes[here] if reach_m[k] - graph.length_m[k] > can_go_on + 1.0
            ]
            if better:
                lanes.append(max(better, key=lambda k: (reach_m[k], k)))
                visits[_place(lanes[-1])] += 1
                has_changed = True
                continue
        if not options:
            break
        enough = [k for k in options if reach_m[k] >= min(needed, can_go_on) - 1e-6]
        tie = rng.random(len(enough))
        chosen = max(
            range(len(enough)),
            key=lambda i: (
                -visits[_place(enough[i])],
                round(_new_ahead(graph, enough[i], visits), -1) if is_greedy else 0.0,
                tie[i],
            ),
        )
        lanes.append(enough[chosen])
        visits[_place(enough[chosen])] += 1
        driven += graph.length_m[enough[chosen]]
        has_changed = False
    return lanes


def _new_ahead(graph: RoadGraph, start: str, visits: Mapping[str, int]) -> float:
    """Length of the longest way ahead along lanes not driven yet, about, up to a limit."""
    best = 0.0
    stack = [(start, 0.0, frozenset[str]())]
    looks = 0
    while stack and looks < 200:
        here, length, on_way = stack.pop()
        looks += 1
        if visits.get(_place(here), 0) or here in on_way:
            continue
        length += graph.length_m[here]
        best = max(best, length)
        if length < _LOOK_AHEAD_M:
            on_way = on_way | {here}
            stack.extend((k, length, on_way) for k in graph.successors[here])
    return min(best, _LOOK_AHEAD_M)


def _measure(graph: RoadGraph, lanes: Sequence[str], length_m: float) -> tuple[float, float]:
    """Length driven, up to what is wanted, and what the drive is worth."""
    driven = worth = 0.0
    seen: set[str] = set()
    for k, lane in enumerate(lanes):
        following = lanes[k + 1] if k + 1 < len(lanes) else None
        is_change = following in graph.changes[lane] and following not in graph.successors[lane]
        part = 0.0 if is_change else min(graph.length_m[lane], length_m - driven)
        driven += part
        if _place(lane) not in seen:
            worth += part + graph.sights_m[lane] * part / graph.length_m[lane]
        seen.add(_place(lane))
    return driven, driven + worth


def _place(lane: str) -> str:
    """What a lane and the one against it on the same ground have in common."""
    return lane.removesuffix("~")
