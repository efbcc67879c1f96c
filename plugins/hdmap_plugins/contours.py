"""Outlines between cell centres: marching squares on a probability, and what it says about accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hdmap_plugins.sampling import bilinear
from hdmap_tools.geometry.polyline import drop_repeats
from hdmap_tools.types import NDArrayFloat


@dataclass(frozen=True)
class Contour:
    """One line of equal probability, the higher side on its **right**.

    Attributes:
        xy_cells: (N, 2) column and row; first and last point equal when closed.
        is_closed: Whether it is a ring.
    """

    xy_cells: NDArrayFloat
    is_closed: bool

    @property
    def signed_area_cells(self) -> float:
        """Shoelace area of a ring: positive counter-clockwise, that is around a **low** area."""
        x, y = self.xy_cells.T
        return 0.5 * float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def contours(probability: NDArrayFloat, level: float, *, close_at_edge: bool) -> list[Contour]:
    """Marching squares with linear interpolation between cell centres.

    Args:
        probability: (y, x); lines stop at NaN cells.
        level: Probability of the line.
        close_at_edge: True takes everything beyond the window as 0, so that areas
            close along the window's outer edge; False lets lines end there.

    Returns:
        In the order of their canonical first points. Rings start at their lowest
        row, then lowest column, so that simplification does not depend on how
        much of the map the window holds.
    """
    from skimage.measure import find_contours

    field = np.asarray(probability, dtype=np.float64)
    margin = 1 if close_at_edge else 0
    if margin:
        field = np.pad(field, margin)
    if min(field.shape, default=0) < 2:
        return []
    result = []
    # Diagonal touches of the higher side stay apart. The direction is held by a test.
    for rows_cols in find_contours(
        field, level, fully_connected="low", positive_orientation="high"
    ):
        xy = drop_repeats(rows_cols[:, ::-1] - margin)
        is_closed = len(xy) > 3 and bool(np.all(rows_cols[0] == rows_cols[-1]))
        if len(xy) < 2:
            continue
        if is_closed:
            ring = xy[:-1]
            first = int(np.lexsort((ring[:, 0], ring[:, 1]))[0])
            ring = np.roll(ring, -first, axis=0)
            xy = np.vstack([ring, ring[:1]])
        result.append(Contour(xy, is_closed))
    return sorted(result, key=lambda c: (c.xy_cells[0, 1], c.xy_cells[0, 0], len(c.xy_cells)))


def edge_slope(probability: NDArrayFloat) -> NDArrayFloat:
    """(y, x) how much a probability without NaN changes per cell at each cell, 0..1."""
    field = np.asarray(probability, dtype=np.float64)
    if min(field.shape) < 2:
        return np.ones_like(field)
    slope_y, slope_x = (np.asarray(g) for g in np.gradient(field))
    # Central differences halve the slope of an edge that is one cell wide, so the
    # steps between neighbours count too, by half: an edge drawn by coverage is two wide.
    steps = np.hypot(
        np.diff(field, axis=0, append=field[-1:]), np.diff(field, axis=1, append=field[:, -1:])
    )
    neighbours: NDArrayFloat = ndimage.maximum_filter(steps, size=2)
    slope = np.maximum(np.hypot(slope_x, slope_y), 0.5 * neighbours)
    return np.asarray(np.minimum(slope, 1.0))


def edge_sigma_cells(slope: NDArrayFloat, xy_cells: NDArrayFloat) -> float:
    """How well an outline's place is known, from how steeply the probability falls across it.

    A sharp edge blurred by a Gaussian of sigma (poses, calibration, label noise)
    has the slope ``g = 1 / (sigma sqrt(2 pi))`` in the middle, so
    ``sigma = 1 / (g sqrt(2 pi))`` with the median slope along the line. Between
    neighbouring cells the probability cannot fall by more than 1 per cell, so sigma
    is never below 0.40 cells: the resolution's own share is within the figure.

    Args:
        slope: (y, x) of `edge_slope`.
        xy_cells: (N, 2) places on the outline.

    Returns:
        One standard deviation, cells; at most 5.
    """
    typical = float(np.median(bilinear(slope, xy_cells)))
    return float(np.clip(1.0 / (np.sqrt(2.0 * np.pi) * max(typical, 1e-3)), 0.0, 5.0))
