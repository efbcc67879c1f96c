"""Smoothing and thinning of lines without moving them more than a tolerance."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from scipy.linalg import solveh_banded

from hdmap_tools.types import NDArrayFloat, NDArrayInt

MAX_TURN_DEG: Final = 120.0
"""A line that turns by more within a short way folds back on itself: no painted line does."""

MIN_STEP_M: Final = 0.05
"""Vertices nearer than this to the one before are left out; Lanelet2's checks warn about them."""


def smooth(
    xy: NDArrayFloat,
    wavelength_stations: float,
    *,
    weights: NDArrayFloat | None = None,
    is_closed: bool = False,
    max_move: float | None = None,
) -> NDArrayFloat:
    """Smooth equally spaced stations by a penalty on second differences (Whittaker, 1923).

    It leaves straight lines as they are, ends included, and bends of radius R with
    an error of order (wavelength / 2 pi)^4 / R^3, which is micrometres for roads; a
    moving average would pull every curve inwards. Stations of weight 0 are bridged
    with the least bend.

    Args:
        xy: (N, 2) stations; first and last equal when closed.
        wavelength_stations: Wiggles of this length, in stations, are halved; shorter ones vanish.
        weights: (N,) trust in each station, default 1.
        is_closed: Whether it is a ring.
        max_move: Longest way that any station may move, unit of xy.

    Returns:
        (N, 2), closed when the input was.
    """
    xy = np.asarray(xy, dtype=np.float64)
    weights = np.ones(len(xy)) if weights is None else np.asarray(weights, dtype=np.float64)
    if len(xy) < 5:
        return xy.copy()
    if is_closed:
        # Laid out three turns long the middle one does not feel the ends.
        lap = min(len(xy) - 1, int(4 * wavelength_stations) + 2)
        open_xy, open_w = xy[:-1], weights[:-1]
        extended = np.vstack([open_xy[-lap:], open_xy, open_xy[:lap]])
        result = _whittaker(
            extended,
            np.concatenate([open_w[-lap:], open_w, open_w[:lap]]),
            wavelength_stations,
        )[lap:-lap]
        result = np.vstack([result, result[:1]])
    else:
        result = _whittaker(xy, weights, wavelength_stations)
    if max_move is not None:
        move = result - xy
        length = np.maximum(np.linalg.norm(move, axis=1, keepdims=True), 1e-12)
        result = xy + move * np.minimum(1.0, max_move / length)
    return result


def _whittaker(xy: NDArrayFloat, weights: NDArrayFloat, wavelength: float) -> NDArrayFloat:
    n = len(xy)
    penalty = (wavelength / (2.0 * np.pi)) ** 4
    bands = np.zeros((3, n))  # upper form: diagonal last
    diagonal = np.full(n, 6.0)
    diagonal[[0, -1]] = 1.0
    diagonal[[1, -2]] = 5.0
    first = np.full(n - 1, -4.0)
    first[[0, -1]] = -2.0
    bands[2] = weights + 1e-6 + penalty * diagonal
    bands[1, 1:] = penalty * first
    bands[0, 2:] = penalty
    return np.asarray(solveh_banded(bands, (weights + 1e-6)[:, None] * xy))


def fold_cuts(xy: NDArrayFloat, within: float) -> list[int]:
    """Vertices at which to cut a line so that no piece folds back on itself.

    Args:
        xy: (N, 2) vertices.
        within: A turn of more than `MAX_TURN_DEG` over no more than this length is a
            fold, unit of xy; between two neighbouring segments it always is one.

    Returns:
        Ascending, without first and last vertex; empty for a line without folds.
    """
    steps = np.diff(np.asarray(xy, dtype=np.float64)[:, :2], axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    directions = np.arctan2(steps[:, 1], steps[:, 0])
    # Without a length there is no direction: keep the one before.
    has_length = lengths > 1e-9
    latest = np.maximum.accumulate(np.where(has_length, np.arange(len(steps)), 0))
    directions = directions[latest]
    heading = np.unwrap(directions)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    cuts = []
    start = 0
    for k in range(1, len(heading)):
        # Segment j ends at vertex j + 1, segment k begins at vertex k.
        first = int(np.searchsorted(at[1:k], at[k] - within))
        first = max(first, start)
        turn = np.degrees(np.abs(heading[k] - heading[first:k]))
        if turn.size and turn.max() > MAX_TURN_DEG:
            start = first + int(np.argmax(np.abs(np.diff(heading[first : k + 1])))) + 1
            cuts.append(start)
    return cuts


def kept_by_simplification(
    xy: NDArrayFloat, tolerance: float, *, is_closed: bool = False
) -> NDArrayInt:
    """Indices of the vertices that Douglas-Peucker keeps; what is dropped lies within the tolerance.

    A ring is opened at its first vertex and at the one farthest from that, and keeps
    at least three distinct vertices.
    """
    n = len(xy)
    keep = np.zeros(n, dtype=bool)
    keep[[0, -1]] = True
    stack = [(0, n - 1)]
    if is_closed and n > 4:
        far = int(np.argmax(np.linalg.norm(xy - xy[0], axis=1)))
        chord = xy[far] - xy[0]
        across = (xy - xy[0]) @ np.array([-chord[1], chord[0]])
        widest = int(np.argmax(np.abs(across)))
        corners = sorted({far, widest} - {0, n - 1})
        keep[corners] = True
        bounds = [0, *corners, n - 1]
        stack = list(pairwise(bounds))
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        chord = xy[b] - xy[a]
        inner = xy[a + 1 : b] - xy[a]
        length = float(np.hypot(*chord))
        if length < 1e-12:
            distance = np.linalg.norm(inner, axis=1)
        else:
            along = np.clip(inner @ chord / length**2, 0.0, 1.0)
            distance = np.linalg.norm(inner - along[:, None] * chord, axis=1)
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            split = a + 1 + worst
            keep[split] = True
            stack += [(a, split), (split, b)]
    return np.flatnonzero(keep)
