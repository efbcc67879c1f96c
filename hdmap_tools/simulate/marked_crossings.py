"""Crossings that a map gives only as pairs of lines across the road."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely

from hdmap_tools.types import NDArrayFloat

MIN_APART_M: Final = 1.2
MAX_APART_M: Final = 8.0
_MAX_ANGLE_RAD: Final = np.radians(25.0)
_MIN_OVERLAP: Final = 0.5
_MIN_ON_ROAD: Final = 0.5


def crossings_between(
    lines: Sequence[NDArrayFloat],
    known: Sequence[shapely.Polygon],
    lanes: Sequence[shapely.Polygon],
) -> list[shapely.Polygon]:
    """The areas between lines that lie side by side, nearest pairs first; each line serves once.

    Two lines make a crossing if they run the same way within 25 degrees, lie 1.2 to 8 m
    apart, each lies beside at least half of the other, and at least half of the area between
    them is lanes of vehicles: maps mark footpaths beside the road in the same way.

    Args:
        lines: (N, 2) each, metres.
        known: Crossings that exist already; areas that are mostly theirs are left out.
        lanes: Valid polygons of the lanes for vehicles and bicycles.

    Returns:
        Convex polygons, sorted by their place.
    """
    pairs = []
    shapes = np.array([shapely.LineString(line) for line in lines], dtype=object)
    near = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=MAX_APART_M)
    for i, j in near.T.tolist():
        apart_m = _distance_side_by_side(lines[i], lines[j]) if i < j else None
        if apart_m is not None:
            pairs.append((apart_m, i, j))
    used: set[int] = set()
    found: list[shapely.Polygon] = []
    for _, i, j in sorted(pairs):
        if {i, j} & used:
            continue
        area = shapely.convex_hull(shapely.MultiPoint(np.concatenate([lines[i], lines[j]])))
        if not are_on_road([area], lanes, _MIN_ON_ROAD)[0]:
            continue
        used |= {i, j}
        if not any(area.intersection(other).area > 0.5 * area.area for other in known):
            found.append(area)
    return sorted(found, key=lambda area: area.bounds)


def are_on_road(
    areas: Sequence[shapely.Polygon], lanes: Sequence[shapely.Polygon], share: float = 0.1
) -> list[bool]:
    """Whether at least a share of each area is lanes."""
    road = shapely.STRtree(lanes)
    found = []
    for area in areas:
        near = shapely.union_all([lanes[k] for k in road.query(area)])
        found.append(bool(near.intersection(area).area >= share * area.area))
    return found


def _distance_side_by_side(a: NDArrayFloat, b: NDArrayFloat) -> float | None:
    """How far apart the lines are if they face each other, else None."""
    along_a, along_b = a[-1] - a[0], b[-1] - b[0]
    length_a, length_b = np.hypot(*along_a), np.hypot(*along_b)
    if min(length_a, length_b) < 1.0:
        return None
    along_a, along_b = along_a / length_a, along_b / length_b
    if abs(along_a @ along_b) < np.cos(_MAX_ANGLE_RAD):
        return None
    mean = along_a + np.sign(along_a @ along_b) * along_b
    mean = mean / np.hypot(*mean)
    span_a, span_b = np.sort((a[[0, -1]] - a[0]) @ mean), np.sort((b[[0, -1]] - a[0]) @ mean)
    shared = min(span_a[1], span_b[1]) - max(span_a[0], span_b[0])
    if shared < _MIN_OVERLAP * max(np.ptp(span_a), np.ptp(span_b)):
        return None
    apart = float(abs((b.mean(axis=0) - a.mean(axis=0)) @ np.array([-mean[1], mean[0]])))
    return apart if MIN_APART_M <= apart <= MAX_APART_M else None
