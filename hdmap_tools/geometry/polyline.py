"""Lines in the plane and in space: length, resampling, direction."""

from __future__ import annotations

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.types import NDArrayFloat


def arc_lengths(points: NDArrayFloat) -> NDArrayFloat:
    """Distance (N,) along a polyline (N, D) to each of its vertices, in the x-y plane."""
    points = _checked(points)
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: NDArrayFloat, step_m: float) -> NDArrayFloat:
    """Equally spaced vertices, about step_m apart, both ends kept."""
    if not (np.isfinite(step_m) and step_m > 0):
        raise ShapeError(f"The step of resampling must be positive metres, found {step_m}.")
    points = _checked(points)
    lengths = arc_lengths(points)
    count = max(round(float(lengths[-1]) / step_m), 1) + 1
    at = np.linspace(0.0, lengths[-1], count)
    sampled = np.column_stack(
        [np.interp(at, lengths, points[:, k]) for k in range(points.shape[1])]
    )
    # Where several vertices share the end's place in the plane, interpolation takes any of them.
    sampled[0], sampled[-1] = points[0], points[-1]
    return sampled


def drop_repeats(points: NDArrayFloat, min_step_m: float = 1e-6) -> NDArrayFloat:
    """The polyline without vertices nearer than min_step_m to the one kept before.

    Both ends stay, unless the whole line is that short: then the first vertex alone.
    """
    points = _checked(points)
    last = len(points) - 1

    def is_apart(a: int, b: int) -> bool:
        return bool(np.linalg.norm(points[a, :2] - points[b, :2]) > min_step_m)

    kept = [0]
    for k in range(1, last + 1):
        if is_apart(k, kept[-1]):
            kept.append(k)
    if len(kept) > 1 and kept[-1] != last:
        while len(kept) > 1 and not is_apart(last, kept[-1]):
            kept.pop()
        if is_apart(last, kept[-1]):
            kept.append(last)
    return points[kept]


def normals(points: NDArrayFloat) -> NDArrayFloat:
    """Unit normals (N, 2) to the left of a polyline (N, 2+), from central differences."""
    points = _checked(points)[:, :2]
    if len(points) < 2:
        raise ShapeError(f"Normals need at least two vertices, found {len(points)}.")
    tangents = np.gradient(points, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    return np.column_stack([-tangents[:, 1], tangents[:, 0]])


def _checked(points: NDArrayFloat) -> NDArrayFloat:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) == 0:
        raise ShapeError(f"A polyline is (N, 2) or (N, 3) with N at least 1, found {points.shape}.")
    return points
