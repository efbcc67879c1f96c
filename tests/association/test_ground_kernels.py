"""The compiled ground against its plain forms: a sort, and a k-d tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hdmap_tools.association.ground import GroundSurface
from hdmap_tools.association.ground_kernels import low_heights, mean_samples, polar_cells


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


def near_by_lattice(samples, points, tolerance_m):
    """Heights by tree at the corners of squares of half a metre, interpolated; a point's own beyond."""
    corner = np.floor(samples[:, :2].min(axis=0)) - 4.0
    at = (points[:, :2] - corner) / 0.5
    low = np.floor(at)
    du, dv = (at - low).T
    h = {
        (i, j): heights_by_tree(samples, corner + (low + (i, j)) * 0.5)
        for i in (0, 1)
        for j in (0, 1)
    }
    height = (1 - du) * ((1 - dv) * h[0, 0] + dv * h[0, 1])
    height += du * ((1 - dv) * h[1, 0] + dv * h[1, 1])
    height = np.where(np.isnan(height), heights_by_tree(samples, points[:, :2]), height)
    return np.abs(points[:, 2] - height) <= tolerance_m


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (-310.5, 72.25, 0.0)])
def test_points_near_the_ground_are_those_within_the_tolerance(offset):
    rng = np.random.default_rng(0)
    surface = GroundSurface(rng.normal(0, (10.0, 10.0, 0.3), (400, 3)) + offset)
    points = rng.normal(0, (12.0, 12.0, 0.6), (20_000, 3)) + offset
    points[:5] = [[np.nan, 0, 0], [0, np.inf, 0], [1e9, 1e9, 0], [0, 0, np.nan], [-1e9, 0, 0]]
    with np.errstate(invalid="ignore", over="ignore"):
        expected = near_by_lattice(surface.samples, points[5:], 0.1)
    found = surface.is_near(points, 0.1)
    assert not found[:5].any()
    np.testing.assert_array_equal(found[5:], expected)
    assert 1000 < expected.sum() < 19_000


def test_between_the_lattice_the_ground_is_the_one_of_each_point():
    rng = np.random.default_rng(1)

    def height(xy):
        return 0.04 * xy[:, 0] + 0.3 * np.sin(xy[:, 1] / 9.0)

    samples = rng.uniform(-30, 30, (4000, 3))
    samples[:, 2] = height(samples[:, :2])
    points = rng.uniform(-28, 28, (20_000, 3))
    points[:, 2] = height(points[:, :2]) + rng.choice([0.0, 0.05, 0.15, 0.5, -0.2], len(points))
    own = np.abs(points[:, 2] - heights_by_tree(samples, points[:, :2])) <= 0.1
    assert (GroundSurface(samples).is_near(points, 0.1) == own).mean() > 0.995


def test_cells_around_the_vehicle_and_their_means():
    rng = np.random.default_rng(2)
    points = rng.normal(0, (20.0, 20.0, 1.0), (5000, 3))
    points[0], points[1] = (np.nan, 0, 0), (0.5, 0.5, 0)
    distance = np.hypot(points[:, 0], points[:, 1])
    sector = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / (2 * np.pi) * 72) % 72
    inside = (distance > 1.0) & (distance < 40.0)
    expected = np.where(inside, sector * 41 + np.floor(distance), -1)
    cell = polar_cells(points, 40.0, 1.0, 1.0, 72, 41)
    np.testing.assert_array_equal(cell, expected)
    ceiling = rng.normal(0, 1, 72 * 41)
    ceiling[rng.random(len(ceiling)) < 0.3] = -np.inf
    low = np.flatnonzero((cell >= 0) & (points[:, 2] <= ceiling[cell]))
    means = [points[low[cell[low] == k]].mean(axis=0) for k in np.unique(cell[low])]
    np.testing.assert_allclose(mean_samples(points, cell, ceiling), means, atol=1e-12)
    assert len(means) > 500
