"""Which short lines are pieces of a longer one, cut by what was not seen."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.types import NDArrayFloat

_MAX_TURN_DEG: Final = 45.0
"""A line that goes on beyond a gap leaves one piece and enters the next within this angle."""


def lengths_with_company(lines: list[NDArrayFloat], heading_length: float) -> NDArrayFloat:
    """Length (N,) of each line together with those that go on with it.

    One line goes on with another when it starts where that one ends: in its direction,
    beyond a gap no longer than either of them. A line too short to tell where it
    points goes on with none.

    Args:
        lines: Directed open lines, each (K, 2).
        heading_length: How much of a line tells where its end points; unit of the lines.
    """
    lengths = np.array([float(arc_lengths(line)[-1]) for line in lines])
    if len(lines) < 2:
        return lengths
    starts = np.array([line[0] for line in lines])
    ends = np.array([line[-1] for line in lines])
    leaving = np.array([-_inward(line[::-1], heading_length) for line in lines])
    entering = np.array([_inward(line, heading_length) for line in lines])
    gap = starts[None, :] - ends[:, None]
    gap_length = np.hypot(gap[..., 0], gap[..., 1])
    least = np.cos(np.radians(_MAX_TURN_DEG))
    goes_on = gap_length <= np.minimum(lengths[:, None], lengths[None, :])
    goes_on &= leaving @ entering.T >= least
    for heading in (leaving[:, None], entering[None, :]):
        # Over next to no gap the way across has no direction.
        goes_on &= np.sum(gap * heading, axis=-1) >= least * gap_length - 1.0e-9
    has_heading = lengths >= heading_length
    goes_on &= has_heading[:, None] & has_heading[None, :]
    np.fill_diagonal(goes_on, False)
    _, group = connected_components(coo_array(goes_on), directed=False)
    return np.asarray(np.bincount(group, weights=lengths)[group])


def _inward(line: NDArrayFloat, heading_length: float) -> NDArrayFloat:
    """Unit direction from a line's first point into it."""
    last = int(np.searchsorted(arc_lengths(line), heading_length))
    chord: NDArrayFloat = line[min(max(last, 1), len(line) - 1)] - line[0]
    return chord / max(float(np.hypot(*chord)), 1e-12)
