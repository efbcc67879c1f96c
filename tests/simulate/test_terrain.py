import numpy as np
import pytest

from hdmap_tools.simulate.terrain import Terrain

SEEDS = range(20)


@pytest.mark.parametrize("seed", [0, 7, 2**62])
def test_slope_is_the_derivative_of_height(seed: int) -> None:
    terrain = Terrain(seed)
    xy = np.random.default_rng(seed % 100).uniform(-3000, 3000, (500, 2))
    h = 1e-4
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = h
        measured = (terrain.height_at(xy + step) - terrain.height_at(xy - step)) / (2 * h)
        np.testing.assert_allclose(terrain.gradient_at(xy)[:, axis], measured, atol=1e-6)


def test_most_drives_of_300_m_have_a_slope_and_none_a_mountain_pass() -> None:
    steepest = []
    for seed in SEEDS:
        heading = seed * 0.7
        along = np.arange(0.0, 300.0, 1.0)[:, None]
        xy = along * [np.cos(heading), np.sin(heading)] + [seed * 100.0, -seed * 50.0]
        # Over 10 m: what makes a plane fitted under the vehicle wrong.
        height = Terrain(seed).height_at(xy)
        steepest.append(np.abs(height[10:] - height[:-10]).max() / 10.0)
    assert np.mean(np.array(steepest) > 0.025) >= 0.75
    assert max(steepest) < 0.10


def test_the_road_is_even_at_the_scale_of_a_wheel() -> None:
    xy = np.column_stack([np.arange(0.0, 200.0, 0.5), np.zeros(400)])
    height = Terrain(4).height_at(xy)
    bend = height[2:] - 2 * height[1:-1] + height[:-2]
    assert 1e-4 < np.abs(bend).max() < 0.01


def test_a_seed_gives_one_ground_and_another_seed_another() -> None:
    xy = np.random.default_rng(0).uniform(-100, 100, (50, 2))
    np.testing.assert_array_equal(Terrain(3).height_at(xy), Terrain(3).height_at(xy))
    assert np.abs(Terrain(3).height_at(xy) - Terrain(4).height_at(xy)).max() > 0.1


def test_flat_ground_is_flat() -> None:
    xy = np.random.default_rng(0).uniform(-100, 100, (50, 2))
    assert not Terrain(3, is_flat=True).height_at(xy).any()
    assert not Terrain(3, is_flat=True).gradient_at(xy).any()
