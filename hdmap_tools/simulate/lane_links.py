"""Which lane leads into which: by shared end points, or by place where a map shares none."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Final

import numpy as np

from hdmap_tools.simulate.world_map import WorldLane

MAX_GAP_M: Final = 0.5
_MAX_TURN_RAD: Final = np.pi / 3.0

Gate = tuple[Hashable, Hashable]
"""The left and the right end point of a lane."""


def successors_by_gate(
    lanes: Mapping[str, WorldLane], entries: Mapping[str, Gate], exits: Mapping[str, Gate]
) -> dict[str, tuple[str, ...]]:
    """Lanes of the same kind that begin at the two points where a lane ends.

    Args:
        lanes: By id; those driven the other way are called ``<id>~``.
        entries: Left and right point of each lane's begin.
        exits: Left and right point of each lane's end.

    Returns:
        Sorted ids by lane. A lane does not lead into its own reverse.
    """
    starts: dict[Gate, list[str]] = {}
    for identifier, gate in entries.items():
        starts.setdefault(gate, []).append(identifier)
    return {
        identifier: tuple(
            sorted(
                other
                for other in starts.get(exits[identifier], ())
                if lanes[other].kind == lane.kind
                and other.removesuffix("~") != identifier.removesuffix("~")
            )
        )
        for identifier, lane in lanes.items()
    }


def bridge_gaps(
    lanes: Mapping[str, WorldLane], successors: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Join a lane without successor to lanes without predecessor that begin where it ends.

    Both end points may be up to `MAX_GAP_M` apart; the direction may turn by 60 degrees.

    Returns:
        All successors, with those found.
    """
    entered = {other for found in successors.values() for other in found}
    dead_ends = [k for k in lanes if not successors[k]]
    orphans = [k for k in lanes if k not in entered]
    result = dict(successors)
    if not dead_ends or not orphans:
        return result
    starts = np.array([(*lanes[k].left[0], *lanes[k].right[0]) for k in orphans])
    ahead = np.array([_heading(lanes[k], 0) for k in orphans])
    for identifier in dead_ends:
        lane = lanes[identifier]
        ends = np.concatenate([lane.left[-1], lane.right[-1]])
        gaps = (starts - ends).reshape(-1, 2, 2)
        near = np.linalg.norm(gaps, axis=2).max(axis=1) <= MAX_GAP_M
        turn = ahead - _heading(lane, -1)
        near &= np.abs(np.angle(np.exp(1j * turn))) <= _MAX_TURN_RAD
        result[identifier] = tuple(
            sorted(
                orphans[k]
                for k in np.flatnonzero(near)
                if lanes[orphans[k]].kind == lane.kind
                and orphans[k].removesuffix("~") != identifier.removesuffix("~")
            )
        )
    return result


def _heading(lane: WorldLane, end: int) -> float:
    """Direction, radians, in which the lane begins (0) or ends (-1)."""
    first, last = (0, 1) if end == 0 else (-2, -1)
    step = (lane.left[last] - lane.left[first]) + (lane.right[last] - lane.right[first])
    return float(np.arctan2(step[1], step[0]))
