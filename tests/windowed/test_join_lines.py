"""Lines cut by windows and put together again."""

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.map_model.elements import LaneMark, RoadBoundary
from hdmap_tools.windowed.join_lines import join_lines
from hdmap_tools.windowed.pieces import parts_inside, pieces_of
from hdmap_tools.windowed.windows import Window

SIDE = 40
CORES = [(x, y) for x in range(-2, 3) for y in range(-2, 3)]


def windows():
    for x, y in CORES:
        core = BevGrid(1.0, x * SIDE, y * SIDE, (x + 1) * SIDE, (y + 1) * SIDE)
        open_sides = (x == -2, y == -2, x == 2, y == 2)
        yield Window(core, core.expand(30), open_sides)


def line(points, kind=LaneMark, **fields):
    points = np.asarray(points, dtype=float)
    return kind(geometry=LineString(np.column_stack([points, np.zeros(len(points))])), **fields)


def seen_by(element, window, rng, jitter_m=0.0, turn=False):
    """What a window makes of a line: all of it near the window, its vertices a little off."""
    points = shapely.get_coordinates(element.geometry, include_z=True)
    x0, y0, x1, y1 = window.grid.bounds_m
    seen = []
    for part in parts_inside(points, (x0, y0, x1, y1)):
        shift = np.append(rng.uniform(-jitter_m, jitter_m, 2), 0.0)
        is_ring = np.array_equal(part[0], part[-1])
        moved = part + shift
        if turn and rng.random() < 0.5:
            moved = moved[::-1]
        if is_ring:
            moved[-1] = moved[0]
        seen.append(element.model_copy(update={"geometry": LineString(moved)}))
    return seen


def rejoined(elements, *, jitter_m=0.0, turn=False, seed=0):
    rng = np.random.default_rng(seed)
    found = [
        pieces_of([s for e in elements for s in seen_by(e, w, rng, jitter_m, turn)], w)
        for w in windows()
    ]
    return join_lines(found)


def require_same(found, expected, within_m):
    assert len(found) == len(expected)
    for element in expected:
        distances = [
            shapely.hausdorff_distance(element.geometry, other.geometry, densify=0.01)
            for other in found
        ]
        assert min(distances) <= within_m
        best = found[int(np.argmin(distances))].geometry
        assert best.length == pytest.approx(element.geometry.length, rel=0.02, abs=8 * within_m)
        assert best.is_simple


ARC = np.linspace(0.0, 1.9 * np.pi, 200)
LINES = {
    "along x": [(-70.0, 13.0), (110.0, 13.0)],
    "on a seam": [(-70.0, 40.0), (110.0, 40.0)],
    "to and fro over a seam": [(x, 40.0 + 0.4 * (-1) ** k) for k, x in enumerate(range(-70, 110, 9))],
    "through a corner": [(-70.0, -70.0), (110.0, 110.0)],
    "past a corner": [(-30.0, -31.0), (110.0, 109.0)],
    "ends at a seam": [(-70.0, 25.0), (40.0, 25.0)],
    "ends just over a seam": [(-70.0, 25.0), (40.3, 25.0)],
    "there and back": [(-20.0, 5.0), (41.0, 30.0), (20.0, 35.0), (95.0, 36.0)],
    "a curve": np.column_stack([40.0 + 60.0 * np.cos(ARC), 40.0 + 60.0 * np.sin(ARC)]),
}  # fmt: skip


@pytest.mark.parametrize("points", LINES.values(), ids=LINES)
@pytest.mark.parametrize("jitter_m", [0.0, 0.03])
def test_a_line_is_one_again(points, jitter_m):
    element = line(points)
    require_same(
        rejoined([element], jitter_m=jitter_m, turn=jitter_m > 0), [element], 0.01 + 2 * jitter_m
    )


@pytest.mark.parametrize("radius_m", [3.0, 15.0, 35.0, 70.0])
@pytest.mark.parametrize("centre", [(40.0, 40.0), (20.0, 20.0), (40.0, 20.0)])
@pytest.mark.parametrize("jitter_m", [0.0, 0.03])
def test_a_ring_closes_again(radius_m, centre, jitter_m):
    angles = np.linspace(0.0, 2 * np.pi, 181)
    points = np.column_stack([np.cos(angles), np.sin(angles)]) * radius_m + centre
    points[-1] = points[0]
    ring = line(points, RoadBoundary, is_island=True)
    found = rejoined([ring], jitter_m=jitter_m)
    require_same(found, [ring], 0.01 + 2 * jitter_m)
    assert found[0].geometry.is_closed
    assert found[0].is_island
    assert shapely.is_ccw(found[0].geometry)


def test_the_line_around_a_road_is_no_island_when_it_closes():
    angles = np.linspace(0.0, -2 * np.pi, 181)
    points = np.column_stack([np.cos(angles), np.sin(angles)]) * 70.0 + 20.0
    points[-1] = points[0]
    (found,) = rejoined([line(points, RoadBoundary)])
    assert found.geometry.is_closed
    assert not found.is_island


@pytest.mark.parametrize("y", [39.9, 40.0, 12.0])
def test_double_lines_stay_two(y):
    both = [line([(-70.0, y + d), (110.0, y + d)]) for d in (0.0, 0.3)]
    require_same(rejoined(both, jitter_m=0.03), both, 0.08)


def test_the_two_sides_of_a_thin_island_stay_two():
    sides = [
        line([(-70.0, 20.0), (110.0, 20.0)], RoadBoundary),
        line([(110.0, 20.2), (-70.0, 20.2)], RoadBoundary),
    ]
    found = rejoined(sides, jitter_m=0.02)
    require_same(found, sides, 0.06)
    eastward = {bool(e.geometry.coords[-1][0] > e.geometry.coords[0][0]) for e in found}
    assert eastward == {True, False}


def test_branches_stay_with_the_line_that_they_leave():
    main = line([(-70.0, 10.0), (110.0, 10.0)])
    branch = line([(41.0, 10.0), (60.0, 13.0), (110.0, 33.0)])
    require_same(rejoined([main, branch], jitter_m=0.02), [main, branch], 0.35)


def test_what_one_window_alone_saw_whole_is_left_as_it_is():
    element = line([(5.0, 5.0), (12.3456789, 7.0), (30.0, 30.0)], confidence=0.7, sigma_m=0.04)
    (found,) = rejoined([element])
    assert found == element


def test_a_stretch_that_two_windows_see_apart_is_there_once():
    window = list(windows())
    west, east = window[CORES.index((0, 0))], window[CORES.index((1, 0))]
    straight = line([(5.0, 20.0), (75.0, 20.0)])
    bent = line([(5.0, 20.0), (36.0, 20.0), (38.0, 20.5), (42.0, 20.5), (44.0, 20.0), (75.0, 20.0)])
    for first, second in ((straight, bent), (bent, straight)):
        (found,) = join_lines([pieces_of([first], west), pieces_of([second], east)])
        assert found.geometry.length == pytest.approx(70.0, abs=0.5)


def test_a_line_seen_whole_after_a_part_of_it_is_left_as_it_is():
    window = list(windows())
    west, east = window[CORES.index((0, 0))], window[CORES.index((1, 0))]
    part, whole = line([(35.0, 20.01), (41.0, 20.01)]), line([(31.0, 20.0), (70.0, 20.0)])
    (found,) = join_lines([pieces_of([part], west), pieces_of([whole], east)])
    assert found == whole


def test_numbers_are_weighted_by_length_and_kinds_are_of_the_longest():
    window = list(windows())
    west, east = window[CORES.index((0, 0))], window[CORES.index((1, 0))]
    parts = [
        line([(0.0, 20.0), (60.0, 20.0)], style="solid", confidence=0.6, sigma_m=0.03, width_m=0.1,
             num_observations=10, plugin="p", plugin_version="1"),
        line([(20.0, 20.0), (60.0, 20.0)], style="unknown", confidence=0.9, sigma_m=0.06,
             num_observations=30, plugin="p", plugin_version="1"),
    ]  # fmt: skip
    (found,) = join_lines([pieces_of(parts[:1], west), pieces_of(parts[1:], east)])
    # The change is where both saw it, between 30 and 50 m.
    share = 40.0 / 60.0
    assert found.confidence == pytest.approx(0.6 * share + 0.9 * (1 - share), abs=0.03)
    expected = np.sqrt(0.03**2 * share + 0.06**2 * (1 - share))
    assert found.sigma_m == pytest.approx(expected, abs=0.004)
    assert (found.style, found.width_m, found.plugin) == ("solid", 0.1, "p")
    assert found.num_observations in range(15, 19)


def test_the_order_of_lines_in_a_window_changes_nothing():
    rng = np.random.default_rng(1)
    elements = [line(rng.uniform(-75, 115, (2, 2))) for _ in range(12)]
    first, second = rejoined(elements), rejoined(elements[::-1])
    key = sorted(e.geometry.normalize().wkb for e in first)
    assert key == sorted(e.geometry.normalize().wkb for e in second)


def test_a_cut_ring_is_opened_at_the_cut():
    ring = np.array([(0.0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0), (0, 0, 0)])
    (part,) = parts_inside(ring, (-1.0, -1.0, 2.0, 5.0))
    assert part[:, :2].tolist() == [[2, 4], [0, 4], [0, 0], [2, 0]]


def test_a_line_that_only_touches_a_rectangle_leaves_no_part():
    assert parts_inside(np.array([(0.0, 0, 0), (4, 4, 0)]), (0.0, 4.0, 1.0, 5.0)) == []
    assert parts_inside(np.array([(4.0, 0, 0), (4, 4, 0)]), (0.0, 0.0, 3.0, 5.0)) == []
