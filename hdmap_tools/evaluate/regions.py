"""Where maps are held against the truth: what a drive passed, and how its road rises and falls."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.types import NDArrayBool, NDArrayFloat

SLOPE: Final = 0.03
"""From this grade on the road counts as sloped."""

GRADE_CHANGE_M: Final = 0.1
"""Height by which the road leaves the plane on which the vehicle stood, for that part."""

_SEEN_FROM_M: Final = 10.0
"""A cell is seen from about so far."""
_STEP_M: Final = 1.0


def passed_mask(
    grid: BevGrid, poses: Iterable[SE3], ahead_m: tuple[float, float], across_m: float
) -> NDArrayBool:
    """(y, x) bool: cells whose centres lay in the clip of any pose.

    Args:
        grid: Cells.
        poses: ``city_SE3_ego`` of the frames.
        ahead_m: Of the clip, in the ego frame: beyond the first, up to the second.
        across_m: Of the clip, to either side.
    """
    mask = np.zeros(grid.shape, dtype=bool)
    x, y = grid.x_centres_m, grid.y_centres_m
    corners = np.array([[a, b, 0.0] for a in ahead_m for b in (-across_m, across_m)])
    for pose in poses:
        # A filled polygon of OpenCV takes its outline's pixels too: half a cell too many all round.
        at = np.clip(grid.to_grid(pose.transform_from(corners)[:, :2]), 0, grid.shape)
        rows, cols = (
            slice(int(low), int(high) + 2) for low, high in zip(at.min(0), at.max(0), strict=True)
        )
        dx, dy = x[None, cols] - pose.translation[0], y[rows, None] - pose.translation[1]
        (a, b), (c, d) = np.linalg.inv(pose.rotation[:2, :2])
        ahead, left = a * dx + b * dy, c * dx + d * dy
        mask[rows, cols] |= (
            (ahead > ahead_m[0]) & (ahead <= ahead_m[1]) & (np.abs(left) <= across_m)
        )
    return mask


def terrain_masks(
    grid: BevGrid, trajectory: Trajectory, reach_m: float = 15.0
) -> dict[str, NDArrayBool]:
    """Cells by how the road runs where they were seen from: ``flat``, ``sloped``, ``bent``.

    Each cell belongs to the nearest piece of the driven path. ``sloped``: its grade is at
    least `SLOPE`, else ``flat``. ``bent``: the road leaves the plane on which the vehicle
    stood 10 m before by at least `GRADE_CHANGE_M`; this is what a plane cannot follow.

    Args:
        grid: Cells.
        trajectory: True poses.
        reach_m: Cells further from the path belong to none.
    """
    from scipy.spatial import KDTree

    path = _spaced(trajectory.translations)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    grade = np.gradient(path[:, 2], arc) if len(path) > 1 else np.zeros(len(path))
    behind = np.maximum(arc - _SEEN_FROM_M, 0.0)
    expected = np.interp(behind, arc, path[:, 2]) + np.interp(behind, arc, grade) * (arc - behind)
    deviation = np.abs(path[:, 2] - expected)
    x, y = np.meshgrid(grid.x_centres_m, grid.y_centres_m)
    distance, nearest = KDTree(path[:, :2]).query(
        np.column_stack([x.ravel(), y.ravel()]), distance_upper_bound=reach_m
    )
    near = np.isfinite(distance).reshape(grid.shape)
    station = np.minimum(nearest, len(path) - 1).reshape(grid.shape)
    sloped = near & (np.abs(grade[station]) >= SLOPE)
    return {
        "flat": near & ~sloped,
        "sloped": sloped,
        "bent": near & (deviation[station] >= GRADE_CHANGE_M),
    }


def _spaced(points: NDArrayFloat) -> NDArrayFloat:
    """Points about `_STEP_M` apart along a path."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    stations = np.arange(0.0, length[-1] + _STEP_M, _STEP_M)
    moving = np.concatenate([[True], np.diff(length) > 0])
    return np.column_stack([np.interp(stations, length[moving], c[moving]) for c in points.T])
