"""Surfaces found in points of known planes, and what they say about a pose."""

import numpy as np
import pytest

from hdmap_tools.point_map.refine_config import RefineConfig
from hdmap_tools.point_map.registration import (
    find_surfaces,
    held_directions,
    jacobians,
    observe_known,
    thin_sweep,
)

CONFIG = RefineConfig()
ORIGIN = np.full(3, -30.8)  # no plane lies near the face between two voxels


def corner(count: int, rng: np.random.Generator, noise_m: float = 0.01) -> np.ndarray:
    """Points on the ground z = 0 and on two walls, x = 10.2 and y = 8.7."""
    u, v = rng.uniform(-12, 12, (2, count))
    low = np.abs(v) / 4
    kind = rng.integers(0, 3, count)
    flat = np.c_[u, v, np.zeros(count)]
    points = np.where((kind == 0)[:, None], flat, 0.0)
    points += (kind == 1)[:, None] * np.c_[np.full(count, 10.2), u, low]
    points += (kind == 2)[:, None] * np.c_[u, np.full(count, 8.7), low]
    return points + rng.normal(0, noise_m, points.shape)


def test_planes_are_found_with_their_normals_and_every_sweep_that_saw_them() -> None:
    rng = np.random.default_rng(0)
    points = corner(30000, rng)
    sweeps = np.repeat(np.arange(5), 6000)
    surfaces, seen = find_surfaces(
        *(points, np.ones(len(points)), sweeps, np.zeros(5, np.int64)),
        origin=ORIGIN,
        thickness_m=0.03,
        config=CONFIG,
    )
    assert len(surfaces) > 200
    # Voxels along an edge hold two planes; all others have one of the three normals.
    apart = np.sort(np.abs(surfaces.means - [10.2, 8.7, 0.0]), axis=1)[:, 1]
    straight = np.abs(surfaces.normals).max(axis=1)
    assert np.all(straight[apart > CONFIG.surface_size_m] > np.cos(np.deg2rad(10)))
    assert np.median(straight) > 0.9999
    assert np.array_equal(np.unique(seen.sweep), np.arange(5))
    assert np.all(np.diff(seen.surface) >= 0)
    assert np.array_equal(
        seen.starts[seen.surface] <= np.arange(len(seen.surface)), np.ones_like(seen.surface, bool)
    )
    mean = np.average(seen.means[seen.surface == 7], axis=0, weights=seen.counts[seen.surface == 7])
    assert np.allclose(mean, surfaces.means[7])


def test_two_visits_that_disagree_do_not_make_a_wall_thick() -> None:
    rng = np.random.default_rng(0)
    points, again = corner(20000, rng), corner(20000, rng) + [0.2, 0.2, 0.2]
    sweeps = np.repeat(np.arange(8), 5000)
    found = [
        find_surfaces(
            *(np.concatenate([points, again]), np.ones(40000), sweeps, visits),
            origin=ORIGIN,
            thickness_m=0.03,
            config=RefineConfig(surface_levels=1),
        )[0]
        for visits in (np.repeat([0, 1], 4), np.zeros(8, np.int64))
    ]
    assert len(found[0]) > 4 * len(found[1])


@pytest.mark.parametrize("axis", range(6))
def test_the_pose_of_a_sweep_is_found_from_known_surfaces(axis: int) -> None:
    rng = np.random.default_rng(1)
    points = corner(30000, rng)
    surfaces, _ = find_surfaces(
        *(points, np.ones(len(points)), np.repeat(np.arange(5), 6000), np.zeros(5, np.int64)),
        origin=ORIGIN,
        thickness_m=0.03,
        config=CONFIG,
    )
    moved = np.zeros(6)
    moved[axis] = 0.03 if axis < 3 else 0.003
    fresh = corner(6000, rng)
    wrong = fresh + moved[:3] + np.cross(moved[3:], fresh)
    seen = observe_known(surfaces, wrong, np.ones(len(wrong)), 0)
    normals = surfaces.normals[seen.surface]
    off = np.einsum("ij,ij->i", normals, seen.means - surfaces.means[seen.surface])
    rows = jacobians(normals, seen.means)
    found = np.zeros(6)
    for _ in range(10):
        # Surfaces along the edges hold points of two planes: they lie off, and lose their say.
        weights = 1 / (1 + ((off - rows @ found) / 0.02) ** 2) * np.sqrt(seen.counts)
        found, *_ = np.linalg.lstsq(rows * weights[:, None], off * weights, rcond=None)
    # Points pushed over the face of a voxel are lost to it: part of a move is hidden at first.
    close = np.array([0.002] * 3 + [0.0003] * 3) + 0.15 * np.abs(moved)
    assert np.all(np.abs(found - moved) < close)


def test_directions_without_information_are_not_held() -> None:
    sigmas = np.array([[0.02, 0.02, 0.02, 0.001, 0.001, 0.001]])
    information = np.diag([0.5, 40.0, 1e4, 1e4, 1e4, 2.0])[None] / sigmas[:, :, None] ** 2
    hold = held_directions(information, sigmas, 10.0)
    assert np.allclose(hold.keep[0], np.diag([0, 1, 1, 1, 1, 0]))
    assert not hold.is_full
    turned = np.eye(6)
    turned[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    oblique = held_directions(turned @ information @ turned.T, sigmas, 10.0)
    assert np.allclose(oblique.keep[0] @ turned[:, 0], 0)
    assert np.allclose(oblique.keep[0] @ turned[:, 1], turned[:, 1])


def test_thinning_keeps_means_and_limits() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-30, 30, (40000, 3)) * [1, 1, 0.05]
    thinned, weights = thin_sweep(points, RefineConfig(max_points=3000, max_range_m=20))
    assert len(thinned) == 3000
    assert np.linalg.norm(thinned[:, :2], axis=1).max() < 20
    assert weights.min() >= 1
    assert weights.max() <= 5
    lone, weight = thin_sweep(np.array([[5.0, 5.0, 0.1], [5.02, 5.02, 0.12]]), CONFIG)
    assert np.allclose(lone, [[5.01, 5.01, 0.11]])
    assert weight.tolist() == [2.0]
    assert len(thin_sweep(np.zeros((0, 3)), CONFIG)[0]) == 0
