"""Lane marks of scenes whose truth is known exactly.

The scenes sample each cell 4 x 4: a line parallel to the axes is drawn exactly when
its edges lie on quarters of a cell.
"""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import LineString, Polygon, box

from hdmap_plugins.lane_mark_skeleton import LaneMarkSkeleton, LaneMarkSkeletonOptions
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import LaneMark, MapWindow, MarkStyle, VectorMap
from hdmap_tools.testing.scenes import window_from_posterior, window_from_shapes

ROAD = box(-100, -100, 200, 200)
RESOLUTIONS = [0.1, 0.2]


def marks(window: MapWindow, **options: object) -> list[LaneMark]:
    found = LaneMarkSkeleton().vectorize(
        window,
        VectorMap(window.frame),
        LaneMarkSkeletonOptions(**options),
        rng=np.random.default_rng(0),
    )
    assert all(isinstance(m, LaneMark) for m in found)
    bounds = box(*window.grid.bounds_m).buffer(1e-6)
    assert all(bounds.contains(m.geometry) for m in found)
    return found


def painted(*lines: LineString, width_m: float = 0.15) -> shapely.Geometry:
    return shapely.union_all([x.buffer(width_m / 2, cap_style="flat") for x in lines])


def scene(paint: shapely.Geometry, bounds, resolution_m: float, **extra: object) -> MapWindow:
    grid = BevGrid.from_bounds(bounds, resolution_m)
    return window_from_shapes({"road": ROAD, "lane_mark": paint}, grid, **extra)


def stations(mark: LaneMark) -> np.ndarray:
    return shapely.get_coordinates(mark.geometry.segmentize(0.1))


def rms_to(mark: LaneMark, truth: shapely.Geometry) -> float:
    """RMS distance of the mark's stations from a line, metres."""
    return float(np.sqrt(np.mean(shapely.distance(shapely.points(stations(mark)), truth) ** 2)))


def end_error(mark: LaneMark, truth: LineString) -> float:
    """Largest distance of an end from the truth's, metres, in the better direction."""
    ends = shapely.get_coordinates(mark.geometry)[[0, -1]]
    true = shapely.get_coordinates(truth)[[0, -1]]
    both = [np.hypot(*(ends - t).T).max() for t in (true, true[::-1])]
    return float(min(both))


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
@pytest.mark.parametrize("angle_deg", [0, 17, 45, 90, 128])
@pytest.mark.parametrize("width_m", [0.15, 0.3])
def test_straight_lines_lie_on_the_paint(resolution_m, angle_deg, width_m):
    quarter = resolution_m / 4
    truth = [
        affinity.rotate(
            LineString([(4, y + width_m / 2), (20, y + width_m / 2)]), angle_deg, origin=(12, 12)
        )
        for y in (8 + quarter, 12 + 2 * quarter, 16 + 3 * quarter)
    ]
    found = marks(scene(painted(*truth, width_m=width_m), (0, 0, 24, 24), resolution_m))
    assert len(found) == 3
    for line in truth:
        mark = min(found, key=lambda m: m.geometry.distance(line.centroid))
        assert rms_to(mark, line) <= 0.25 * resolution_m + 1e-9
        assert end_error(mark, line) <= 0.5 * resolution_m
        assert mark.style == MarkStyle.SOLID
        # The scene believes covered cells with 0.95, so the mass is 6 % short.
        assert mark.width_m == pytest.approx(width_m, rel=0.2)
        assert 0.0 < mark.sigma_m < 0.3 * resolution_m
        assert mark.num_observations == 10


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_curve_of_20_m_is_not_pulled_inwards(resolution_m):
    angles = np.linspace(0.1, 1.4, 300)
    truth = LineString(np.column_stack([2 + 20 * np.sin(angles), 22 - 20 * np.cos(angles)]))
    (mark,) = marks(scene(painted(truth), (0, 0, 24, 24), resolution_m))
    assert rms_to(mark, truth) <= 0.25 * resolution_m
    assert end_error(mark, truth) <= 0.5 * resolution_m
    # Chords of the simplified line are inside by less than the tolerance.
    radii = np.hypot(stations(mark)[:, 0] - 2, stations(mark)[:, 1] - 22)
    assert -0.02 <= radii.mean() - 20 <= 0.25 * resolution_m


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_split_gives_a_through_line_and_a_branch_that_meets_it(resolution_m):
    straight = LineString([(1, 5.05), (30, 5.05)])
    branch = LineString([(12, 5.05), (24, 11.05)])
    found = marks(scene(painted(straight, branch), (0, 0, 31, 13), resolution_m))
    assert len(found) == 2
    through = max(found, key=lambda m: m.geometry.length)
    other = min(found, key=lambda m: m.geometry.length)
    assert rms_to(through, straight) <= 0.25 * resolution_m
    assert end_error(through, straight) <= resolution_m
    assert rms_to(other, branch) <= 0.5 * resolution_m
    # They meet but for the tolerance of leaving out vertices.
    assert other.geometry.distance(through.geometry) <= LaneMarkSkeletonOptions().simplify_m
    assert end_error(other, branch) <= 2 * resolution_m


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_crossing_lines_run_straight_through(resolution_m):
    truth = [LineString([(1, 1), (15, 12)]), LineString([(1, 12), (15, 2)])]
    found = marks(scene(painted(*truth), (0, 0, 16, 14), resolution_m))
    assert len(found) == 2
    for line in truth:
        assert min(rms_to(m, line) for m in found) <= 0.25 * resolution_m
        assert min(end_error(m, line) for m in found) <= resolution_m


def dash_row(start: float, count: int, dash: float, gap: float, slope: float) -> list[LineString]:
    period = dash + gap
    return [
        LineString([(start + period * k + s, 3.4 + slope * (period * k + s)) for s in (0, dash)])
        for k in range(count)
    ]


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
@pytest.mark.parametrize(("dash", "gap"), [(3, 6), (1, 1), (6, 12), (0.75, 1.5)])
def test_dashes_make_one_dashed_mark(resolution_m, dash, gap):
    dashes = dash_row(1.03, 4, dash, gap, 0.1)
    truth = LineString([dashes[0].coords[0], dashes[-1].coords[-1]])
    bounds = (0, 0, truth.bounds[2] + 2, 12)
    (mark,) = marks(scene(painted(*dashes), bounds, resolution_m))
    assert mark.style == MarkStyle.DASHED
    assert rms_to(mark, truth) <= 0.25 * resolution_m
    assert end_error(mark, truth) <= resolution_m
    assert mark.geometry.length == pytest.approx(truth.length, abs=2 * resolution_m)


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_dashes_follow_a_curve(resolution_m):
    def arc(s0, s1):
        return LineString(
            [(2 + 20 * np.sin(s / 20), 22 - 20 * np.cos(s / 20)) for s in np.linspace(s0, s1, 40)]
        )

    window = scene(
        painted(*(arc(1 + 9 * k, 4 + 9 * k) for k in range(3))), (0, 0, 24, 24), resolution_m
    )
    (mark,) = marks(window)
    assert mark.style == MarkStyle.DASHED
    # Between the dashes the curve is a guess.
    assert rms_to(mark, arc(1, 22)) <= 0.5 * resolution_m
    assert end_error(mark, arc(1, 22)) <= resolution_m


def test_a_dash_hidden_by_unknown_cells_is_bridged_only_in_rhythm():
    dashes = dash_row(1.03, 5, 3, 6, 0.0)
    hidden = box(18, 0, 24, 8)  # the third dash
    (mark,) = marks(scene(painted(*dashes), (0, 0, 44, 8), 0.2, unknown=hidden))
    assert mark.style == MarkStyle.DASHED
    assert mark.geometry.length == pytest.approx(39, abs=0.4)

    # A solid line is not drawn where nobody saw it.
    line = LineString([(1, 3.4), (43, 3.4)])
    found = marks(scene(painted(line), (0, 0, 44, 8), 0.2, unknown=hidden))
    assert len(found) == 2
    for mark in found:
        assert mark.geometry.intersection(hidden).length <= 0.2
        assert mark.style == MarkStyle.SOLID


def test_wear_is_bridged_and_long_known_gaps_are_not():
    gaps = box(10, 0, 10.6, 8).union(box(20, 0, 23, 8))
    paint = painted(LineString([(1, 3.4), (43, 3.4)])).difference(gaps)
    found = marks(scene(paint, (0, 0, 44, 8), 0.1))
    assert sorted(round(m.geometry.length) for m in found) == [19, 20]
    assert {m.style for m in found} == {MarkStyle.SOLID}


def test_two_strokes_are_no_rhythm():
    window = scene(painted(*dash_row(1.03, 2, 3, 6, 0.0)), (0, 0, 20, 8), 0.1)
    assert marks(window) == []
    found = marks(window, keep_lone_strokes=True)
    assert [m.style for m in found] == [MarkStyle.UNKNOWN] * 2


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
@pytest.mark.parametrize("angle_deg", [0, 17, 45])
def test_shafts_of_arrows_are_lines_only_when_asked_for(resolution_m, angle_deg):
    """Three lanes of arrows abreast, one more ahead, beside a dashed and a solid line."""
    shafts = [LineString([(x, y), (x + 5, y)]) for x, y in ((4, 5), (4, 8.5), (4, 12), (24, 8.5))]
    dashes = [LineString([(x, 6.75), (x + 3, 6.75)]) for x in (1, 10, 19, 28)]
    solid = LineString([(1, 10.25), (31, 10.25)])

    def turned(line):
        return affinity.rotate(line, angle_deg, origin=(16, 16))

    paint = shapely.union_all(
        [painted(*map(turned, shafts), width_m=0.3), painted(*map(turned, [*dashes, solid]))]
    )
    window = scene(paint, (-8, -8, 40, 40), resolution_m)
    found = marks(window)
    assert {m.style for m in found} == {MarkStyle.DASHED, MarkStyle.SOLID}
    assert len(found) == 2
    lone = [m for m in marks(window, keep_lone_strokes=True) if m.style == MarkStyle.UNKNOWN]
    assert len(lone) == len(shafts)
    for shaft in shafts:
        assert min(end_error(m, turned(shaft)) for m in lone) <= 2 * resolution_m


@pytest.mark.parametrize("hidden", [True, False])
def test_pieces_of_a_line_keep_one_another(hidden):
    """Worn, or cut by what was not seen: no piece is long enough for a line by itself."""
    line = LineString([(1, 3.4), (26, 3.4)])
    gaps = box(7.5, 0, 10, 8).union(box(17, 0, 24, 8))
    if hidden:
        window = scene(painted(line), (0, 0, 27, 8), 0.1, unknown=gaps)
    else:
        window = scene(painted(line.difference(gaps)), (0, 0, 27, 8), 0.1)
    # The last one is shorter than the gap before it.
    assert sorted(round(m.geometry.length, 1) for m in marks(window)) == [6.5, 7.0]
    assert len(marks(window, keep_lone_strokes=True)) == 3


def test_a_dash_beyond_a_missing_one_belongs_to_its_row():
    dashes = dash_row(1.03, 6, 3, 6, 0.0)
    found = marks(scene(painted(*dashes[:4], dashes[5]), (0, 0, 52, 8), 0.2))
    assert sorted(m.style for m in found) == [MarkStyle.DASHED, MarkStyle.UNKNOWN]
    # As long as a dash, but out of step; in step, but no dash.
    for stroke in ([(42, 3.4), (45, 3.4)], [(46, 3.4), (51.5, 3.4)]):
        (mark,) = marks(scene(painted(*dashes[:4], LineString(stroke)), (0, 0, 54, 8), 0.2))
        assert mark.style == MarkStyle.DASHED


def sharpest_turn_deg(mark: LaneMark, within_m: float) -> float:
    """Largest turn between two segments that begin no farther apart along the line."""
    xy = shapely.get_coordinates(mark.geometry)
    steps = np.diff(xy, axis=0)
    lengths = np.hypot(*steps.T)
    starts = np.concatenate([[0.0], np.cumsum(lengths)])
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    return max(
        (
            float(np.degrees(abs(heading[j] - heading[i])))
            for i in range(len(steps))
            for j in range(i + 1, len(steps))
            if starts[j] - starts[i + 1] <= within_m
        ),
        default=0.0,
    )


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
@pytest.mark.parametrize("slit_m", [0.8, 1.4, 2.2, 3.0])
@pytest.mark.parametrize("angle_deg", [0, 25, 45, 70])
def test_no_line_folds_back_on_itself(resolution_m, slit_m, angle_deg):
    """A double line that runs together: around the slit between its two the skeleton is a loop."""
    c = 2 * resolution_m
    slit = Polygon([(4, 8 - c), (4 + slit_m, 8 - c), (4 + slit_m, 8 + c), (4, 8 + c)]).exterior
    paint = painted(LineString([(4 + slit_m, 8), (16, 8)]), slit, width_m=1.5 * resolution_m)
    paint = affinity.rotate(paint, angle_deg, origin=(8, 8))
    options = {"keep_lone_strokes": True, "min_length_m": 0.0, "min_stroke_m": 0.0}
    found = marks(scene(paint, (0, 0, 20, 20), resolution_m), **options)
    assert max(m.geometry.length for m in found) >= 11.5 - slit_m
    for mark in found:
        assert sharpest_turn_deg(mark, 1.0) <= 125.0
        assert mark.geometry.is_simple


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), resolution_m=st.sampled_from(RESOLUTIONS))
def test_scribbles_do_not_fold_either(seed, resolution_m):
    rng = np.random.default_rng(seed)
    starts = rng.uniform(1, 11, (12, 2))
    paint = painted(
        *(LineString([a, a + rng.normal(0, 1.5, 2), a + rng.normal(0, 1.5, 2)]) for a in starts)
    )
    options = {"keep_lone_strokes": True, "min_length_m": 0.0, "min_stroke_m": 0.0}
    for mark in marks(scene(paint, (0, 0, 12, 12), resolution_m), **options):
        assert sharpest_turn_deg(mark, 1.0) <= 125.0


def test_confidence_is_the_posterior_on_the_paint():
    """Not what stands out of the ground: that is 0.19 less where the road is doubtful."""
    line = LineString([(2, 3.15), (18, 3.15)])
    window = scene(painted(line, width_m=0.3), (0, 0, 20, 6), 0.1)
    (sure,) = marks(window)
    assert sure.confidence == pytest.approx(0.95, abs=0.01)
    posterior = window.dataset["posterior"].values.copy()
    posterior[2] = np.where(posterior[2] > 0.5, 0.6, 0.25)
    posterior[0] = 1.0 - posterior[[1, 2, 3, 4]].sum(axis=0)
    (doubtful,) = marks(window_from_posterior(posterior, window.grid))
    assert doubtful.confidence == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize("angle_deg", [0, 17, 45])
def test_double_line_is_two_lines_at_a_tenth(angle_deg):
    truth = [
        affinity.rotate(LineString([(2, y), (18, y)]), angle_deg, origin=(10, 10))
        for y in (9.875, 10.175)
    ]
    found = marks(scene(painted(*truth), (0, 0, 20, 20), 0.1))
    assert len(found) == 2
    for line in truth:
        assert min(rms_to(m, line) for m in found) <= 0.025
        assert min(end_error(m, line) for m in found) <= 0.1


@pytest.mark.parametrize("angle_deg", [0, 17, 45])
def test_double_line_is_one_line_at_two_tenths(angle_deg):
    """A gap of 0.75 cells cannot be seen; what comes out must still lie on the pair."""
    pair = affinity.rotate(LineString([(2, 10), (18, 10)]), angle_deg, origin=(10, 10))
    paint = painted(pair.parallel_offset(0.15), pair.parallel_offset(-0.15))
    (mark,) = marks(scene(paint, (0, 0, 20, 20), 0.2))
    assert rms_to(mark, pair) <= 0.15


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_arrows_and_areas_are_no_lines(resolution_m):
    arrow = Polygon([(5, 5), (8, 5), (8, 4.7), (9.5, 5.1), (8, 5.5), (8, 5.2), (5, 5.2)])
    area = box(12, 4, 14, 6)
    line = LineString([(1, 2.2), (19, 2.5)])
    paint = shapely.union_all([arrow, area, painted(line)])
    (mark,) = marks(scene(paint, (0, 0, 20, 8), resolution_m))
    assert rms_to(mark, line) <= 0.25 * resolution_m


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_noise_neither_breaks_nor_invents_lines(resolution_m):
    line = LineString([(1, 2.2), (29, 6.1)])
    for seed in range(3):
        window = scene(
            painted(line),
            (0, 0, 30, 10),
            resolution_m,
            noise=0.5,
            rng=np.random.default_rng(seed),
        )
        (mark,) = marks(window)
        assert rms_to(mark, line) <= 0.25 * resolution_m
        assert end_error(mark, line) <= 2 * resolution_m


def test_nothing_comes_of_nothing():
    grid = BevGrid.from_bounds((0, 0, 10, 10), 0.2)
    assert marks(window_from_shapes({"road": ROAD}, grid)) == []
    assert marks(window_from_shapes({"road": ROAD}, grid, unknown=ROAD)) == []
    assert marks(window_from_shapes({"lane_mark": ROAD}, grid)) == []
    specks = shapely.union_all([box(x, x, x + 0.2, x + 0.2) for x in (2.0, 4.0, 6.0)])
    assert marks(window_from_shapes({"road": ROAD, "lane_mark": specks}, grid)) == []


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (1, 1), (1, 7), (2, 3), (3, 1)])
@pytest.mark.parametrize("fill", ["paint", "none", "mixed"])
def test_tiny_grids(shape, fill):
    rows, cols = shape
    posterior = np.full((5, rows, cols), 0.2, dtype=np.float32)
    posterior[2] = {"paint": 1.0, "none": 0.0, "mixed": 0.2}[fill]
    if fill == "none":
        posterior[:] = np.nan
    for mark in marks(window_from_posterior(posterior, BevGrid(0.2, 3, 4, 3 + cols, 4 + rows))):
        assert mark.geometry.length > 0


def test_same_input_same_bytes_and_whole_cells_move_exactly():
    truth = [LineString([(1, 2.2), (15, 9.7)]), *dash_row(1.0, 3, 1, 1, 0.0)]
    grid = BevGrid.from_bounds((0, 0, 16, 12), 0.2)
    window = window_from_shapes(
        {"road": ROAD, "lane_mark": painted(*truth)},
        grid,
        noise=0.5,
        rng=np.random.default_rng(7),
    )
    first, again = marks(window), marks(window)
    assert first
    assert [m.model_dump() for m in first] == [m.model_dump() for m in again]
    assert [m.geometry.wkb for m in first] == [m.geometry.wkb for m in again]

    moved_grid = BevGrid(0.2, grid.x_min + 50, grid.y_min - 35, grid.x_max + 50, grid.y_max - 35)
    moved = marks(window_from_posterior(window.dataset["posterior"].values, moved_grid))
    assert len(moved) == len(first)
    for a, b in zip(first, moved, strict=True):
        shift = np.array([10.0, -7.0])
        np.testing.assert_allclose(
            shapely.get_coordinates(b.geometry) - shift,
            shapely.get_coordinates(a.geometry),
            atol=1e-9,
        )
        assert (a.style, a.width_m, a.confidence) == (b.style, b.width_m, b.confidence)


def test_height_comes_from_the_ground():
    line = LineString([(1, 3.05), (19, 3.05)])
    window = scene(painted(line), (0, 0, 20, 6), 0.1)
    x = window.grid.x_centres_m
    height = np.tile(7.0 + 0.05 * x, (window.grid.shape[0], 1))
    height[::7] = np.nan
    height[30, 50] = 90.0  # one wild cell
    posterior = window.dataset["posterior"].values
    sloped = window_from_posterior(posterior, window.grid, height=height.astype(np.float32))
    (mark,) = marks(sloped)
    xyz = shapely.get_coordinates(mark.geometry, include_z=True)
    np.testing.assert_allclose(xyz[:, 2], 7.0 + 0.05 * xyz[:, 0], atol=0.06)

    unknown = np.full(window.grid.shape, np.nan, dtype=np.float32)
    (flat,) = marks(window_from_posterior(posterior, window.grid, height=unknown))
    assert set(shapely.get_coordinates(flat.geometry, include_z=True)[:, 2]) == {0.0}


@settings(max_examples=25, deadline=None)
@given(
    angle_deg=st.floats(0, 180),
    offset_m=st.floats(-0.2, 0.2),
    width_m=st.floats(0.16, 0.35),
    resolution_m=st.sampled_from(RESOLUTIONS),
)
def test_any_straight_line(angle_deg, offset_m, width_m, resolution_m):
    truth = affinity.rotate(
        LineString([(3, 8 + offset_m), (13, 8 + offset_m)]), angle_deg, origin=(8, 8)
    )
    (mark,) = marks(scene(painted(truth, width_m=width_m), (0, 0, 16, 16), resolution_m))
    # A line within one cell may lie anywhere in it, and the scene draws quarters of cells.
    hidden = max(resolution_m - width_m, 0.0) / 2 + resolution_m / 8
    assert rms_to(mark, truth) <= hidden + 0.1 * resolution_m
    assert end_error(mark, truth) <= resolution_m


def test_a_doubtful_network_makes_no_lines_of_bare_road():
    """Road cells hold 0.2 of lane mark when a network often misses paint."""
    line = LineString([(2, 3.1), (18, 4.3)])
    window = scene(painted(line), (0, 0, 20, 8), 0.2)
    posterior = window.dataset["posterior"].values.copy()
    _, y = np.meshgrid(window.grid.x_centres_m, window.grid.y_centres_m)
    strip = (np.abs(y - 6) < 0.4) | (np.abs(y - 3) < 2)
    posterior[2] = np.where(strip, 0.2 + 0.8 * posterior[2], 0.01)
    posterior[0] = 1.0 - posterior[[1, 2, 3, 4]].sum(axis=0)
    (mark,) = marks(window_from_posterior(posterior, window.grid))
    assert rms_to(mark, line) <= 0.05
    assert end_error(mark, line) <= 0.2
    assert mark.width_m == pytest.approx(0.15, rel=0.2)


def test_a_line_ends_where_the_paint_grows_faint():
    window = scene(painted(LineString([(2, 3.1), (18, 3.1)])), (0, 0, 20, 6), 0.1)
    posterior = window.dataset["posterior"].values.copy()
    faint = window.grid.x_centres_m > 12
    posterior[2][:, faint] *= 0.3
    posterior[0] = 1.0 - posterior[[1, 2, 3, 4]].sum(axis=0)
    (mark,) = marks(window_from_posterior(posterior, window.grid))
    assert end_error(mark, LineString([(2, 3.1), (12, 3.1)])) <= 0.1


def test_a_short_gap_is_bridged_only_where_the_ground_was_seen():
    line = LineString([(1, 3.4), (31, 3.4)])
    unseen = box(15, 0, 15.6, 8)
    worn = marks(scene(painted(line).difference(unseen), (0, 0, 32, 8), 0.1))
    hidden = marks(scene(painted(line), (0, 0, 32, 8), 0.1, unknown=unseen))
    assert len(worn) == 1
    assert len(hidden) == 2
    # Stripes up to fill_gap_m count as seen: that is what the option is for.
    assert len(marks(scene(painted(line), (0, 0, 32, 8), 0.1, unknown=unseen), fill_gap_m=0.7)) == 1


def test_a_dash_missing_on_seen_ground_ends_the_mark():
    dashes = dash_row(1.03, 7, 3, 6, 0.0)
    found = marks(scene(painted(*dashes[:3], *dashes[4:]), (0, 0, 60, 8), 0.2))
    assert [m.style for m in found] == [MarkStyle.DASHED] * 2
    assert all(m.geometry.length == pytest.approx(21, abs=0.4) for m in found)
