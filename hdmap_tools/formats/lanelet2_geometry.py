"""Geometry that Lanelet2 leaves to its readers: sides, centerlines, crossings, rings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.types import NDArrayFloat

_MAX_CUTS_TRIED = 200
_MAX_VERTICES_ADDED = 3


def are_reversed(left: NDArrayFloat, right: NDArrayFloat) -> tuple[bool, bool]:
    """Whether the left and the right bound (N, 3) run against the lanelet's direction.

    Files do not say; readers turn each line so that the other's middle lies on its proper
    side. This follows the same rule as the library, so that both see the same lanelet.

    Source:
        Lanelet2, lanelet2_core, ``geometry::align``.
    """
    left_reversed = _signed_distance(left, _middle(right)) >= 0.0
    if left_reversed:
        left = left[::-1]
    right_reversed = _signed_distance(right, _middle(left)) <= 0.0
    return left_reversed, right_reversed


def centerline_between(left: NDArrayFloat, right: NDArrayFloat) -> NDArrayFloat:
    """The middle (N, 3) of two bounds (N, 3) in driving direction, paired by share of length."""
    at = np.linspace(0.0, 1.0, max(len(left), len(right)))
    sides = []
    for bound in (left, right):
        lengths = arc_lengths(bound)
        share = lengths / max(float(lengths[-1]), 1e-12)
        sides.append(np.column_stack([np.interp(at, share, bound[:, k]) for k in range(3)]))
    return np.asarray((sides[0] + sides[1]) / 2.0)


def split_crosswalk(polygon: Polygon) -> tuple[NDArrayFloat, NDArrayFloat] | None:
    """Left and right chain (N, 3) of a crossing's outline, running the same way.

    The outline is cut at its two ends along its longer axis: the edges there belong to
    neither chain, every vertex to one of them. Where that cannot be done (a triangle, a
    dart) the longest edge gets a vertex in its middle, which leaves the shape as it is.
    Returns None if no cut gives two sides that a reader can tell apart.
    """
    ring = shapely.get_coordinates(orient(polygon, 1.0).exterior, include_z=True)[:-1]
    axis = _long_axis(polygon)
    for _ in range(1 + _MAX_VERTICES_ADDED):
        sides = _best_cut(ring, axis)
        if sides is not None:
            return sides
        ring = _with_midpoint(ring)
    return None


def _best_cut(ring: NDArrayFloat, axis: NDArrayFloat) -> tuple[NDArrayFloat, NDArrayFloat] | None:
    count = len(ring)
    along = (ring + np.roll(ring, -1, axis=0))[:, :2] / 2.0 @ axis
    first, second = np.triu_indices(count, k=2)
    apart = count - (second - first) >= 2
    first, second = first[apart], second[apart]
    best = np.argsort(-np.abs(along[first] - along[second]), kind="stable")[:_MAX_CUTS_TRIED]
    for i, j in zip(first[best], second[best], strict=True):
        # Counter-clockwise, so the outline's inside lies left of the chain that runs along.
        right = ring[i + 1 : j + 1]
        left = np.concatenate([ring[j + 1 :], ring[: i + 1]])[::-1]
        if are_reversed(left, right) == (False, False):
            return left, right
    return None


def crosswalk_outline(left: NDArrayFloat, right: NDArrayFloat) -> NDArrayFloat:
    """The open ring (N, 3) of a crossing's two bounds, both in the lanelet's direction."""
    return np.concatenate([right, left[::-1]])


def assemble_rings(lines: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]] | None:
    """Closed rings of node ids (first not repeated) from lines that meet at their ends.

    Returns None if the lines do not close.
    """
    waiting = list(lines)
    rings: list[tuple[int, ...]] = []
    while waiting:
        ring = waiting.pop(0)
        while ring[0] != ring[-1]:
            found = next(
                (k for k, line in enumerate(waiting) if ring[-1] in (line[0], line[-1])), None
            )
            if found is None:
                return None
            line = waiting.pop(found)
            ring = ring + (line if line[0] == ring[-1] else line[::-1])[1:]
        rings.append(ring[:-1])
    return rings


def _long_axis(polygon: Polygon) -> NDArrayFloat:
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))
    sides = np.diff(box[:3], axis=0)
    axis = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    return np.asarray(axis / np.linalg.norm(axis))


def _with_midpoint(ring: NDArrayFloat) -> NDArrayFloat:
    following = np.roll(ring, -1, axis=0)
    longest = int(np.argmax(np.linalg.norm(following - ring, axis=1)))
    middle = (ring[longest] + following[longest]) / 2.0
    return np.insert(ring, longest + 1, middle, axis=0)


def _middle(line: NDArrayFloat) -> NDArrayFloat:
    point = line[len(line) // 2] if len(line) > 2 else (line[0] + line[-1]) / 2.0
    return np.asarray(point[:2])


def _signed_distance(line: NDArrayFloat, point: NDArrayFloat) -> float:
    """Distance in the plane, positive on the left of the line."""
    start, step = line[:-1, :2], np.diff(line[:, :2], axis=0)
    squared = np.maximum((step**2).sum(axis=1), 1e-18)
    at = np.clip(((point - start) * step).sum(axis=1) / squared, 0.0, 1.0)
    away = point - (start + at[:, None] * step)
    distance = np.linalg.norm(away, axis=1)
    k = int(np.argmin(distance))
    direction = step[k] / np.sqrt(squared[k])
    # Nearest to a corner: the side follows from both its edges.
    neighbour = k + 1 if at[k] >= 1.0 else k - 1 if at[k] <= 0.0 else None
    if neighbour is not None and 0 <= neighbour < len(step):
        direction = direction + step[neighbour] / np.sqrt(squared[neighbour])
    side = direction[0] * away[k][1] - direction[1] * away[k][0]
    return float(np.copysign(distance[k], side)) if side != 0.0 else 0.0
