"""Reading the layers of a window at places between cell centres.

All vectorizers here work in **cells**: ``xy_cells`` (N, 2) is (column, row),
whole numbers are cell centres, y grows north. Nothing that is decided depends
on where the window lies, so moving the grid by whole cells moves every result
by exactly that; only `to_city` knows about city metres.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from hdmap_tools.plugin_api import BevGrid
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayFloat


def disk(radius_cells: float) -> NDArrayBool:
    """(K, K) bool disk, K odd; a radius below 1 gives the single centre cell."""
    reach = int(np.floor(max(radius_cells, 0.0) + 1e-9))
    offsets = np.arange(-reach, reach + 1)
    return np.asarray(
        offsets[:, None] ** 2 + offsets[None, :] ** 2 <= (max(radius_cells, 0.0) + 1e-9) ** 2
    )


def to_city(xy_cells: NDArrayFloat, grid: BevGrid) -> NDArrayFloat:
    """City points (N, 2), metres, kept inside the grid's outer edges."""
    xy = grid.to_city(np.asarray(xy_cells, dtype=np.float64)[:, ::-1])
    x0, y0, x1, y1 = grid.bounds_m
    return np.column_stack([np.clip(xy[:, 0], x0, x1), np.clip(xy[:, 1], y0, y1)])


def bilinear(layer: NDArrayAny, xy_cells: NDArrayFloat, *, outside: float = 0.0) -> NDArrayFloat:
    """Values (...) of a (y, x) layer at fractional places (..., 2), linear between cell centres."""
    return np.asarray(
        ndimage.map_coordinates(
            np.asarray(layer, dtype=np.float64),
            np.moveaxis(np.asarray(xy_cells)[..., ::-1], -1, 0),
            order=1,
            mode="constant",
            cval=outside,
        )
    )


def nearest(layer: NDArrayAny, xy_cells: NDArrayFloat) -> NDArrayAny:
    """Values (...) of the cells that hold the places (..., 2); the border's beyond the window."""
    rows, cols = layer.shape
    at = np.floor(np.asarray(xy_cells) + 0.5).astype(np.int64)
    return np.asarray(layer[np.clip(at[..., 1], 0, rows - 1), np.clip(at[..., 0], 0, cols - 1)])


def fill_small_gaps(
    probability: NDArrayFloat, is_known: NDArrayBool, gap_cells: float
) -> tuple[NDArrayFloat, NDArrayBool]:
    """Carry the probability into unknown cells that known ones enclose closely.

    Lidar rings leave unknown stripes between known ones. A cell is filled when it
    lies in a gap at most ``gap_cells`` wide (morphological closing of the known
    cells), by the Gaussian-weighted mean of the known cells around it.

    Args:
        probability: (y, x), any value where unknown.
        is_known: (y, x) bool.
        gap_cells: Widest gap to fill, cells; below 1 fills nothing.

    Returns:
        The probability, 0 where still unknown, and the cells now known.
    """
    known_probability = np.where(is_known, probability, 0.0).astype(np.float64)
    radius = int(np.ceil(gap_cells / 2.0))
    if gap_cells < 1.0 or is_known.all() or not is_known.any():
        return known_probability, is_known.copy()
    # An even gap of 2r cells is closed by a disk of radius r, an odd one of 2r-1 too.
    padded = np.pad(is_known, 2 * radius)
    closed = ndimage.binary_closing(padded, disk(radius))[
        2 * radius : -2 * radius, 2 * radius : -2 * radius
    ]
    sigma = max(radius / 1.5, 0.7)
    weight = ndimage.gaussian_filter(is_known.astype(np.float64), sigma, mode="constant")
    mean = ndimage.gaussian_filter(known_probability, sigma, mode="constant")
    is_filled = closed & ~is_known & (weight > 1e-6)
    known_probability[is_filled] = mean[is_filled] / weight[is_filled]
    return known_probability, is_known | is_filled


def height_surface(height: NDArrayAny) -> NDArrayFloat | None:
    """(y, x) ground height with unknown cells taken from the nearest known one; None if none is known."""
    is_known = np.isfinite(height)
    if not is_known.any():
        return None
    if is_known.all():
        return np.asarray(height, dtype=np.float64)
    at = ndimage.distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    return np.asarray(height[tuple(at)], dtype=np.float64)


def heights_along(
    surface: NDArrayFloat | None, xy_cells: NDArrayFloat, window_stations: int = 9
) -> NDArrayFloat:
    """Ground height (N,) at a line's stations, by a running median so that single bad cells do not show.

    A window without any height (planar association knows none) gives 0.
    """
    if surface is None:
        return np.zeros(len(xy_cells))
    heights = nearest(surface, xy_cells)
    size = min(window_stations, 2 * ((len(heights) - 1) // 2) + 1)
    return np.asarray(ndimage.median_filter(heights, size=max(size, 1), mode="nearest"))


def plane_heights(
    height: NDArrayAny, is_member: NDArrayBool, xy_cells: NDArrayFloat
) -> NDArrayFloat:
    """Height (N,) at points, from a plane through an area's known heights, robust to outliers.

    Least squares reweighted by Huber's function (1.345 robust sigmas); with fewer
    than six known cells, or all in one row, the median height instead, and with
    none the nearest known height.

    Args:
        height: (y, x) metres, NaN where unknown.
        is_member: (y, x) bool, the area.
        xy_cells: (N, 2) points.
    """
    rows, cols = np.nonzero(is_member & np.isfinite(height))
    if len(rows) == 0:
        return heights_along(height_surface(height), xy_cells, 1)
    z = height[rows, cols].astype(np.float64)
    centre = np.array([cols.mean(), rows.mean()])
    design = np.column_stack([np.ones(len(z)), cols - centre[0], rows - centre[1]])
    if len(z) < 6 or np.linalg.matrix_rank(design) < 3:
        return np.full(len(xy_cells), float(np.median(z)))
    residual = z - np.median(z)
    plane = np.zeros(3)
    for _ in range(8):
        sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        weight = np.sqrt(np.minimum(1.0, 1.345 * sigma / np.maximum(np.abs(residual), 1e-12)))
        plane = np.linalg.lstsq(design * weight[:, None], z * weight, rcond=None)[0]
        residual = z - design @ plane
    return np.asarray(plane[0] + (np.asarray(xy_cells) - centre) @ plane[1:])


def votes_at(observations: NDArrayAny, xy_cells: NDArrayFloat) -> int:
    """Median number of votes of the cells at these places, of those that have any."""
    votes = nearest(observations, xy_cells)
    votes = votes[np.isfinite(votes) & (votes > 0)]
    return round(float(np.median(votes))) if len(votes) else 0
