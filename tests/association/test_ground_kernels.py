"""The compiled ground against its plain forms: a sort, and a k-d tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hdmap_tools.association.ground import GroundSurface, near_ground
from hdmap_tools.association.ground_kernels import low_heights


def low_heights_by_sorting(cell, heights, num_cells):
    order = np.lexsort((heights, cell))
    sorted_cell, sorted_height = cell[order], heights[order]
    starts = np.flatnonzero(np.concatenate([[True], sorted_cell[1:] != sorted_cell[:-1]]))
    counts = np.diff(np.append(starts, len(order)))
    low = np.full(num_cells, np.nan)
    low[sorted_cell[starts]] = sorted_height[starts + counts // 10]
    return low


def heights_by_tree(samples, xy):
    neighbours = min(6, len(samples))
    distance, index = cKDTree(samples[:, :2]).query(xy, k=neighbours)
    distance, index = distance.reshape(len(xy), -1), index.reshape(len(xy), -1)
    weight = 1.0 / (distance + 0.1) ** 2
    height = (weight * samples[index, 2]).sum(axis=1) / weight.sum(axis=1)
    return np.where(distance[:, 0] <= 4.0, height, np.nan)


@pytest.mark.parametrize("count", [1, 9, 10, 5000])
def test_low_heights_are_those_of_sorting(count):
    rng = np.random.default_rng(count)
    cell, heights = rng.integers(0, 40, count), rng.normal(size=count)
    np.testing.assert_array_equal(
        low_heights(cell, heights, 60), low_heights_by_sorting(cell, heights, 60)
    )


@pytest.mark.parametrize("count", [1, 3, 6, 7, 60, 900])
@pytest.mark.parametrize("spread_m", [0.5, 8.0, 60.0])
def test_heights_are_those_of_the_six_nearest(count, spread_m):
    rng = np.random.default_rng(count)
    samples = rng.normal(0, spread_m, (count, 3)) + (300.0, -70.0, 0.0)
    xy = rng.normal(0, 1.3 * spread_m, (3000, 2)) + (300.0, -70.0)
    xy = np.concatenate([xy, samples[:, :2], np.floor(xy), [[1e9, 0.0], [-1e9, 1e9]]])
    expected = heights_by_tree(samples, xy)
    np.testing.assert_array_equal(GroundSurface(samples).height_at(xy), expected)
    assert np.isfinite(expected).any()


def test_points_near_the_ground_are_those_within_the_tolerance():
    rng = np.random.default_rng(0)
    surface = GroundSurface(rng.normal(0, (10.0, 10.0, 0.3), (400, 3)))
    points = rng.normal(0, (12.0, 12.0, 0.6), (20_000, 3))
    off = np.abs(points[:, 2] - heights_by_tree(surface.samples, points[:, :2]))
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(near_ground(points, surface, 0.1), off <= 0.1)
    assert 1000 < (off <= 0.1).sum() < 19_000
