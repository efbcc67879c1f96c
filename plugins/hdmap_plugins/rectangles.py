"""The rectangle that an outline stands for."""

from __future__ import annotations

import numpy as np
from shapely.geometry import MultiPoint

from hdmap_tools.geometry.polyline import arc_lengths, resample
from hdmap_tools.types import NDArrayFloat


def fit_rectangle(ring: NDArrayFloat) -> NDArrayFloat | None:
    """The rectangle whose sides run through the middle of an outline's four sides.

    The smallest enclosing rectangle gives the first direction only: it touches the
    outermost bumps, so it is too large, and turns with one bad corner. Each side is
    then placed at the median of the outline's points along its middle part, and the
    direction is corrected by the mean slope of the two long sides.

    Args:
        ring: (N, 2) closed outline.

    Returns:
        (5, 2) closed corners, counter-clockwise, or None for a degenerate outline.
    """
    if len(ring) < 4:
        return None
    box = MultiPoint(ring).minimum_rotated_rectangle
    if box.geom_type != "Polygon":
        return None
    corners = np.asarray(box.exterior.coords)
    edges = np.diff(corners, axis=0)[:2]
    longest = edges[int(np.argmax(np.linalg.norm(edges, axis=1)))]
    angle = float(np.arctan2(longest[1], longest[0]))
    points = resample(ring, max(float(arc_lengths(ring)[-1]) / 2000.0, 0.25))[:-1]
    centre = points.mean(axis=0)
    for _ in range(4):
        turned = (points - centre) @ _rotation(angle)
        low, high = turned.min(axis=0), turned.max(axis=0)
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        if half.min() <= 0.0:
            return None
        u, v = ((turned - middle) / half).T
        sides = []
        slopes = []
        for axis, along, across in ((0, u, v), (1, v, u)):
            for sign in (-1.0, 1.0):
                # The middle 70 % of the side: rounded corners stay out.
                on_side = (np.abs(along) < 0.7) & (sign * across > 0.3)
                if on_side.sum() < 2:
                    return None
                across_values = turned[on_side, 1 - axis]
                sides.append(float(np.median(across_values)))
                if axis == 0:
                    slopes.append(_slope(turned[on_side, 0], across_values))
        bottom, top, left, right = sides
        turn = float(np.arctan(np.mean(slopes)))
        if abs(turn) < 1e-6:
            break
        angle += turn
    if top <= bottom or right <= left:
        return None
    flat = np.array([[left, bottom], [right, bottom], [right, top], [left, top], [left, bottom]])
    return np.asarray(flat @ _rotation(angle).T + centre)


def _rotation(angle: float) -> NDArrayFloat:
    """Matrix R with ``xy @ R`` the coordinates along and across the direction."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _slope(x: NDArrayFloat, y: NDArrayFloat) -> float:
    """Slope of a line, with points beyond 2.5 robust sigmas of a first fit left out."""
    slope, offset = np.polyfit(x, y, 1)
    residual = y - slope * x - offset
    sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
    good = np.abs(residual) < 2.5 * sigma + 1e-9
    if good.sum() < 2 or np.ptp(x[good]) < 1e-9:
        return float(slope)
    return float(np.polyfit(x[good], y[good], 1)[0])
