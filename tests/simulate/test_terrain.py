import numpy as np
import pytest

from hdmap_tools.simulate.road_area import WorldIndex
from hdmap_tools.simulate.road_crown import RoadCrown
from hdmap_tools.simulate.terrain import Terrain
from tests.simulate.small_worlds import bend, curved_street

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


def test_the_road_is_crowned_and_the_land_beside_it_is_not() -> None:
    crown = RoadCrown(WorldIndex(curved_street()))
    s = np.arange(60.0, 120.0, 0.5)
    profile = [crown(bend(s, left)).mean() for left in (-3.4, -2.0, 0.0, 2.0, 3.4)]
    # Two metres in from the edge at 2 %, a little rounded; highest in the middle, and even.
    assert 0.02 < profile[1] < 0.04
    assert profile[0] < profile[1] < profile[2] < 0.07
    np.testing.assert_allclose(profile, profile[::-1], atol=0.002)
    assert not crown(bend(s, 6.0)).any()
    steps = np.abs(np.diff(crown(bend(np.full(800, 90.0), np.linspace(-8, 8, 800)))))
    assert steps.max() < 0.05 * 16 / 800  # no step anywhere, no slope above 5 %
    bare, crowned = Terrain(3), Terrain(3, crown=crown)
    xy = bend(s, 1.0)
    np.testing.assert_allclose(crowned.height_at(xy), bare.height_at(xy) + crown(xy))
    np.testing.assert_array_equal(crowned.bare_height_at(xy), bare.height_at(xy))
