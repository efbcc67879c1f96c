"""Which windows a map is cut into."""

import pytest

from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.plugin_api import Crosswalk, LaneMark, Vectorizer
from hdmap_tools.windowed.windows import OVERLAP_M, WHOLE_M, margin_of, windows_of

META = MapMeta(resolution_m=0.2, label_set=load_label_set("adas-0001"), count_mode="share", intensity_threshold=40, model="m")  # fmt: skip
TILE_M = 51.2


def windows(tiles, **changes):
    settings = {"window_m": TILE_M, "margin_m": 20.0, "fill_cells": 1, "whole_up_to": 0.0}
    return windows_of(tiles, META, **(settings | changes))


def test_a_small_map_is_one_window_of_all_of_it():
    (only,) = windows([(3, -1), (4, -1)], whole_up_to=1.0)
    assert only.core is None
    assert only.grid.bounds_m == pytest.approx((3 * TILE_M, -TILE_M, 5 * TILE_M, 0.0))


def test_an_empty_map_is_one_cell():
    (only,) = windows([])
    assert only.grid.shape == (1, 1)


def test_each_tile_is_in_one_core_and_cores_without_one_are_left_out():
    tiles = [(x, 0) for x in range(10)] + [(9, y) for y in range(1, 10)]
    cores = [w.core.bounds_m for w in windows(tiles, window_m=2 * TILE_M)]
    assert len(cores) == len(set(cores)) == 9
    for x, y in tiles:
        middle = (x + 0.5) * TILE_M, (y + 0.5) * TILE_M
        inside = [c for c in cores if c[0] < middle[0] < c[2] and c[1] < middle[1] < c[3]]
        assert len(inside) == 1


def test_cores_do_not_move_when_the_map_grows():
    tiles = [(x, 0) for x in range(10)]
    before = {w.core for w in windows(tiles)}
    after = {w.core for w in windows([*tiles, (-7, 3), (30, 2)])}
    assert before < after


def test_a_window_reads_its_margin_as_far_as_there_is_anything():
    tiles = [(x, y) for x in range(4) for y in range(4)]
    by_core = {w.core.bounds_m[:2]: w for w in windows(tiles)}
    corner, inner = by_core[0.0, 0.0], by_core[TILE_M, TILE_M]
    assert corner.grid.bounds_m == pytest.approx((0.0, 0.0, TILE_M + 20.0, TILE_M + 20.0))
    assert inner.grid.bounds_m == pytest.approx(
        (TILE_M - 20.0, TILE_M - 20.0, 2 * TILE_M + 20.0, 2 * TILE_M + 20.0)
    )
    assert corner.open_sides == (True, True, False, False)
    assert inner.open_sides == (False,) * 4


def test_a_window_does_not_read_what_nobody_saw():
    tiles = [(0, 0), (2, 0), (40, 0)]
    far = windows(tiles, margin_m=30.0)[2]
    # The rim keeps the edge of what is known apart from the window's.
    assert far.grid.bounds_m[0] == pytest.approx(40 * TILE_M - 17 * 0.2)
    assert far.grid.bounds_m[2] == pytest.approx(41 * TILE_M)


def plugin(name, kinds, halo, requires=()):
    fields = {"name": name, "element_types": kinds, "halo_m": halo, "requires": requires}
    return type(name, (Vectorizer,), fields)


def test_the_margin_holds_what_is_handed_over_and_its_context():
    marks = plugin("marks", (LaneMark,), 7.0)
    areas = plugin("areas", (Crosswalk,), 2.0)
    both = plugin("both", (LaneMark,), 5.0, ("marks",))
    assert margin_of([]) == 0.0
    assert margin_of([marks]) == 7.0 + OVERLAP_M
    assert margin_of([marks, areas]) == 2.0 + WHOLE_M
    # Its own context around what it reads, which was made with a context of its own.
    assert margin_of([marks, both]) == 12.0 + OVERLAP_M
