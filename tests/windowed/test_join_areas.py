"""Areas cut by windows and put together again."""

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import Point, Polygon, box

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.map_model.elements import Crosswalk, SidewalkArea
from hdmap_tools.windowed.join_areas import join_areas
from hdmap_tools.windowed.pieces import pieces_of
from hdmap_tools.windowed.windows import Window

SIDE = 40
CORES = [(x, y) for x in range(-2, 3) for y in range(-2, 3)]
SEAMS = (np.arange(-2, 4) * float(SIDE), np.arange(-2, 4) * float(SIDE))


def windows():
    for x, y in CORES:
        core = BevGrid(1.0, x * SIDE, y * SIDE, (x + 1) * SIDE, (y + 1) * SIDE)
        yield Window(core, core.expand(42), (x == -2, y == -2, x == 2, y == 2))


def rejoined(elements, jitter_m=0.0, seed=0):
    """Each window sees what of the elements lies in what it reads, a little off."""
    rng = np.random.default_rng(seed)
    found = []
    for window in windows():
        seen = []
        for element in elements:
            clipped = element.geometry.intersection(box(*window.grid.bounds_m))
            for part in shapely.get_parts(clipped):
                if part.geom_type == "Polygon" and not part.is_empty:
                    shift = rng.uniform(-jitter_m, jitter_m, 2)
                    moved = affinity.translate(part, *shift)
                    seen.append(element.model_copy(update={"geometry": moved}))
        found.append(pieces_of(seen, window))
    return join_areas(found, SEAMS)


def area(polygon, kind=SidewalkArea, **fields):
    return kind(geometry=shapely.force_3d(polygon, 2.0), **fields)


@pytest.mark.parametrize("jitter_m", [0.0, 0.03])
def test_an_area_with_a_hole_over_several_cores_is_one_again(jitter_m):
    whole = area(Polygon(Point(20, 20).buffer(70).exterior, [Point(30, 25).buffer(35).exterior]))
    (found,) = rejoined([whole], jitter_m)
    assert len(found.geometry.interiors) == 1
    assert found.geometry.symmetric_difference(whole.geometry).area < 1.0 + 700 * 2 * jitter_m
    assert found.geometry.hausdorff_distance(whole.geometry) < 0.01 + 3 * jitter_m
    assert np.allclose(shapely.get_coordinates(found.geometry, include_z=True)[:, 2], 2.0)


@pytest.mark.parametrize("jitter_m", [0.0, 0.03])
def test_no_vertices_stay_at_seams(jitter_m):
    (found,) = rejoined([area(box(-70.0, 5.0, 110.0, 33.0))], jitter_m)
    xy = shapely.get_coordinates(found.geometry)
    # Where the outline crosses a seam one vertex may stay, no step.
    assert len(xy) <= 5 + 2 * 4
    steps = np.hypot(*np.diff(xy, axis=0).T)
    assert steps.min() > 1.0


@pytest.mark.parametrize("centre", [(40.0, 40.0), (40.0, 20.0), (39.99, 0.01), (20.0, 20.0)])
@pytest.mark.parametrize("seed", range(4))
def test_a_crosswalk_on_a_seam_is_handed_over_once_and_whole(centre, seed):
    crossing = area(affinity.rotate(box(-2, -6, 2, 6), 30), Crosswalk)
    moved = affinity.translate(crossing.geometry, *centre)
    crossing = crossing.model_copy(update={"geometry": moved})
    (found,) = rejoined([crossing], 0.03, seed)
    assert len(found.geometry.exterior.coords) == 5
    assert found.geometry.hausdorff_distance(crossing.geometry) < 0.05


def test_neighbouring_crosswalks_stay_apart():
    both = [area(box(35, 0, 39.9, 10), Crosswalk), area(box(40.3, 0, 44, 10), Crosswalk)]
    assert len(rejoined(both)) == 2


def test_areas_that_share_a_corner_alone_stay_apart():
    both = [area(box(0, 0, 40, 40)), area(box(40, 40, 80, 80))]
    assert len(rejoined(both)) == 2


def test_nothing_gives_nothing():
    assert rejoined([]) == []


def test_attributes_are_weighted_by_area():
    whole = area(box(0.0, 0.0, 80.0, 40.0), confidence=0.8)
    found = [pieces_of([whole], window) for window in windows()]
    lower = [
        [type(piece)(piece.element.model_copy(update={"confidence": 0.4}), piece.geometry, piece.is_cut)
         for piece in pieces] if k == CORES.index((1, 0)) else pieces
        for k, pieces in enumerate(found)
    ]  # fmt: skip
    (joined,) = join_areas(lower, SEAMS)
    assert joined.confidence == pytest.approx(0.6)
