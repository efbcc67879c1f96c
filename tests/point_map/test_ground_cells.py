"""Smoothed ground against its definition, point by point."""

import numpy as np
import pytest

from hdmap_tools.point_map.ground_cells import smooth_ground


def on_plane(points, weight, i):
    """Height of one point on the plane through its neighbours."""
    fitted = points[i, 2]
    for reach in (75.0, 150.0, 300.0):
        d = points - points[i]
        d2 = d[:, 0] ** 2 + d[:, 1] ** 2
        w = weight * (1.0 - 0.5 * d2 / reach**2) * (d2 <= reach**2) * (np.abs(d[:, 2]) <= 60.0)
        s = w.sum()
        if s <= 0.0:
            continue
        mean = (w[:, None] * d).sum(axis=0) / s
        c = (w[:, None, None] * d[:, :, None] * d[:, None, :]).sum(axis=0)
        c -= s * mean[:, None] * mean
        slope = np.linalg.solve(c[:2, :2] + 0.02 * reach**2 * s * np.eye(2), c[:2, 2])
        fitted = points[i, 2] + mean[2] - slope @ mean[:2]
        if s >= 12.0:
            break
    return fitted


@pytest.mark.parametrize(
    ("number", "heaviest"), [(1, 1.0), (40, 1.0), (600, 0.3), (600, 30.0), (3000, 4.0)]
)
def test_heights_lie_on_local_planes(number, heaviest):
    rng = np.random.default_rng(number)
    points = rng.uniform(0.0, 1500.0, (number, 3)) - (300.0, 0.0, 0.0)
    kerb = np.where(points[:, 0] > 400.0, 120.0, 0.0)
    points[:, 2] = 0.03 * points[:, 0] + kerb + rng.normal(size=number) * 8.0 + 70_000.0
    weight = rng.uniform(1 / 64, heaviest, number)
    cell = rng.integers(0, 5, number) * 2
    found = smooth_ground(points, weight, cell, 12)
    truth = np.array([on_plane(points, weight, i) for i in range(number)])
    np.testing.assert_allclose(found.height_mm, truth, rtol=0, atol=1e-8)
    seen = np.unique(cell)
    np.testing.assert_array_equal(found.cells, seen)
    for k, c in enumerate(seen):
        of = cell == c
        assert found.cell_points[k] == of.sum()
        mean = np.average(truth[of], weights=weight[of])
        rough = np.sqrt(np.average((points[of, 2] - truth[of]) ** 2, weights=weight[of]))
        assert found.cell_height_mm[k] == pytest.approx(mean, abs=1e-8)
        assert found.roughness_mm[k] == pytest.approx(rough, abs=1e-8)


def test_no_ground_is_no_ground():
    found = smooth_ground(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), 9)
    assert len(found.cells) == len(found.height_mm) == 0


def test_many_returns_of_one_place():
    """More neighbours than fit any room set apart for them."""
    points = np.zeros((5000, 3))
    points[:, 2] = np.tile([10.0, 20.0], 2500)
    found = smooth_ground(points, np.full(5000, 1 / 64), np.zeros(5000, np.int64), 1)
    np.testing.assert_allclose(found.height_mm, 15.0)
