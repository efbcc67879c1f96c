"""Rays against analytic shapes."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toy_scene import CAR, CAR_MPS, CAR_Y, HOUSE, ORIGIN, street

from hdmap_tools.errors import ShapeError
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.ray_caster import RayCaster


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(street(with_car=True))


def test_rays_meet_the_plane_where_it_is(caster: RayCaster) -> None:
    rng = np.random.default_rng(0)
    origins = ORIGIN + rng.uniform((-10, -3, 1), (10, 3, 3), (500, 3))
    directions = rng.normal(size=(500, 3)) * (1, 1, 0.2)
    directions[:, 2] = -np.abs(directions[:, 2]) - 0.02
    hits = caster.cast(origins, directions, -100.0)
    expected = (origins[:, 2] - ORIGIN[2]) / -directions[:, 2]
    points = origins + expected[:, None] * directions - ORIGIN
    free = (np.abs(points[:, :2]) < 190).all(axis=1) & (hits.material != Mat.BUILDING_PLASTER)
    free &= ~hits.on_actor
    assert free.sum() > 300
    np.testing.assert_allclose(hits.t[free], expected[free], rtol=2e-5)
    np.testing.assert_allclose(hits.normal[free], np.tile((0, 0, 1), (free.sum(), 1)), atol=1e-6)


def test_the_ground_has_the_material_of_its_cell(caster: RayCaster) -> None:
    grid, codes = caster.scene.surface.grid, caster.scene.surface.codes
    rng = np.random.default_rng(1)
    cells = np.column_stack([rng.integers(0, n, 20_000) for n in codes.shape])
    # A tenth of a cell from its edges: float32 is not asked which side an edge is on.
    xy = grid.to_city(cells + rng.uniform(-0.4, 0.4, cells.shape))
    x, y = (xy - ORIGIN[:2]).T
    in_house = (x > HOUSE[0][0]) & (x < HOUSE[1][0]) & (y > HOUSE[0][1]) & (y < HOUSE[1][1])
    origins = np.column_stack([xy, np.full(len(xy), ORIGIN[2] + 50)])
    hits = caster.cast(origins, np.tile((0.0, 0.0, -1.0), (len(xy), 1)), -100.0)
    ours = ~in_house & ~hits.on_actor
    assert ours.sum() > 15_000
    np.testing.assert_array_equal(hits.material[ours], codes[tuple(cells[ours].T)])
    assert (hits.material[in_house] == Mat.BUILDING_PLASTER).all()


def test_outside_the_raster_is_grass_and_above_is_sky(caster: RayCaster) -> None:
    directions = np.array([(0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
    hits = caster.cast(ORIGIN + (-150.0, 100.0, 10.0), directions, 0.0)
    assert hits.material.tolist() == [Mat.GRASS, Mat.SKY]
    assert np.isinf(hits.t[1])


@pytest.mark.parametrize("time_s", [-1.0, 0.0, 0.25, 3.0])
def test_actors_are_where_their_time_puts_them(caster: RayCaster, time_s: float) -> None:
    x = CAR_MPS * time_s
    # From 30 m behind, along the road, at half the car's height.
    hits = caster.cast(ORIGIN + (x - 30.0, CAR_Y, 0.7), np.array([(2.0, 0.0, 0.0)]), time_s)
    assert hits.material[0] == Mat.CAR_BODY_RED
    assert hits.on_actor[0]
    assert hits.t[0] == pytest.approx((30.0 + CAR[0][0]) / 2, abs=1e-4)
    np.testing.assert_allclose(hits.normal[0], (-1, 0, 0), atol=1e-6)


def test_what_is_nearer_hides_the_actor(caster: RayCaster) -> None:
    # The house stands between this point and the car at second 2.6.
    origin = ORIGIN + (26.0, 20.0, 0.7)
    hits = caster.cast(origin, np.array([(0.0, -1.0, 0.0)]), 2.6)
    assert hits.material[0] == Mat.BUILDING_PLASTER


def test_the_house_and_the_car_keep_the_sun_off(caster: RayCaster) -> None:
    up_south = np.array([0.0, -1.0, 1.0]) / np.sqrt(2)
    points = np.array(
        [
            (26.0, 16.0, 0.01),
            (26.0, 22.0, 0.01),
            (0.0, CAR_Y + 1.5, 0.01),
            (10.0, CAR_Y + 1.5, 0.01),
        ],
        np.float32,
    )
    assert caster.is_hidden(points, up_south, 0.0).tolist() == [True, False, True, False]


def test_directions_of_the_wrong_shape_are_refused(caster: RayCaster) -> None:
    with pytest.raises(ShapeError, match=r"\(N, 3\)"):
        caster.cast(ORIGIN, np.zeros(3), 0.0)


@pytest.mark.parametrize("width", [0.0, 0.003, 0.3, 3.0])
@pytest.mark.parametrize("spread", [0.0, 0.5, 20.0])
def test_no_sphere_that_a_ray_meets_is_left_out_for_its_bundle(width: float, spread: float) -> None:
    from hdmap_tools.simulate.ray_kernels import near_spheres

    rng = np.random.default_rng(3)
    count = 5000
    rays = np.empty((count, 6), np.float32)
    rays[:, :3] = rng.normal(0, 1, 3) * 10 + rng.uniform(-spread, spread, (count, 3))
    drift = np.cumsum(rng.normal(0, 0.01, (count, 3)), axis=0)
    rays[:, 3:] = (1.0, 0.2, 0.1) + drift + rng.normal(0, width, (count, 3))
    reach = rng.choice(np.array([3.0, 40.0, np.inf], np.float32), count)
    spheres = np.column_stack([rng.uniform(-60, 60, (60, 3)), rng.uniform(0.5, 6, 60)])
    spheres = spheres.astype(np.float32)

    origins, directions = rays[:, :3].astype(np.float64), rays[:, 3:].astype(np.float64)
    lengths = np.linalg.norm(directions, axis=1)
    to_centre = spheres[None, :, :3] - origins[:, None]
    along = np.einsum("nkd,nd->nk", to_centre, directions / lengths[:, None])
    # From the nearest point of the ray as far as it reaches, not of its line.
    within = np.clip(along, 0.0, (reach * lengths)[:, None])
    within = np.where(np.isfinite(within), within, 0.0)
    nearest = within[..., None] * (directions / lengths[:, None])[:, None]
    meets = (np.linalg.norm(to_centre - nearest, axis=2) < spheres[:, 3] * 0.999).any(axis=1)

    found = np.empty(count, np.bool_)
    near_spheres(0, count, rays, reach, spheres, found)
    assert 50 < meets.sum() < count  # there is something to leave out, and to find
    assert found[meets].all()
    line = to_centre - along[..., None] * (directions / lengths[:, None])[:, None]
    passes = (np.linalg.norm(line, axis=2) < spheres[:, 3] * 1.001).any(axis=1)
    assert not found[~passes].any()


def test_actors_are_the_same_for_many_threads_at_many_times(caster: RayCaster) -> None:
    directions = np.column_stack([np.cos(a := np.linspace(0, 6, 3000)), np.sin(a), -0.1 + 0 * a])
    times = np.linspace(0.0, 4.0, 40)

    def look(time_s: float) -> bytes:
        hits = caster.cast(ORIGIN + (0.0, 0.0, 1.5), directions, time_s)
        return hits.t.tobytes() + hits.material.tobytes() + hits.on_actor.tobytes()

    expected = [look(t) for t in times]
    assert len(set(expected)) > 3
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            assert list(pool.map(look, times)) == expected
