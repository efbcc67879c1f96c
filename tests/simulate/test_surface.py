from dataclasses import replace

import numpy as np
import pytest
import shapely

from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.road_area import WorldIndex
from hdmap_tools.simulate.road_paint import line_quads
from hdmap_tools.simulate.scan_fill import fill_area, fill_quads, only_on
from hdmap_tools.simulate.settings import Difficulty, SimulationSettings
from hdmap_tools.simulate.surface import CELL_M, TILE_M, SurfaceTiles
from hdmap_tools.simulate.world_map import LineKind, Paint, WorldLine, WorldMap
from tests.simulate.small_worlds import LANE_M, LENGTH_M, bend, curved_street

CELL_AREA = CELL_M**2
SETTINGS = SimulationSettings(seed=3)


def tiles_of(world: WorldMap, settings: SimulationSettings = SETTINGS) -> SurfaceTiles:
    return SurfaceTiles(WorldIndex(world), settings)


def tiles_along(first_m: float, last_m: float) -> set[tuple[int, int]]:
    places = bend(np.arange(first_m, last_m, 3.0), 0.0)
    near = np.concatenate([places + [dx, dy] for dx in (-8, 8) for dy in (-8, 8)])
    return {(int(x), int(y)) for x, y in np.floor(near / TILE_M)}


@pytest.fixture(scope="module")
def street():
    """The whole of the curved street."""
    return tiles_of(curved_street()).raster(tiles_along(0, LENGTH_M))


def codes_at(raster, xy):
    rows, cols = raster.grid.rows_cols_of(xy).T
    return raster.codes[rows, cols]


@pytest.mark.parametrize("seed", range(5))
def test_a_cell_is_filled_exactly_if_its_centre_is_inside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    blobs = shapely.union_all(
        [
            shapely.Point(p).buffer(r)
            for p, r in zip(rng.uniform(0, 6, (6, 2)), rng.uniform(0.3, 2, 6), strict=True)
        ]
    )
    area = blobs.difference(shapely.Point(3, 3).buffer(0.7))
    cells = np.zeros((300, 250), dtype=np.uint8)
    fill_area(cells, area, (0.3, 0.1), CELL_M, 7)
    rows, cols = np.indices(cells.shape)
    x, y = (cols + 0.5) * CELL_M + 0.3, (rows + 0.5) * CELL_M + 0.1
    np.testing.assert_array_equal(cells == 7, shapely.contains_xy(area, x, y))


def test_filling_respects_what_it_may_cover() -> None:
    cells = np.zeros((10, 10), dtype=np.uint8)
    cells[:, 5:] = 3
    fill_quads(cells, np.array([[[0, 0], [1, 0], [1, 1], [0, 1]]]), (0.0, 0.0), 0.1, 9, only_on(3))
    assert (cells[:, :5] == 0).all()
    assert (cells[:, 5:] == 9).all()


def test_a_solid_line_is_as_wide_as_the_map_says(street) -> None:
    # Between 110 and 190 m nothing else is painted on the right.
    s = np.arange(110.0, 190.0, 0.1)
    across = np.arange(-LANE_M + 0.05, -1.0, 0.005)
    painted = [(codes_at(street, bend(s, left)) == Mat.PAINT_WHITE).mean() for left in across]
    assert sum(painted) * 0.005 == pytest.approx(0.15, abs=0.004)
    middle = np.average(across, weights=painted)
    assert middle == pytest.approx(-LANE_M + 0.4, abs=0.003)


def test_dashes_have_their_length_and_phase(street) -> None:
    s = np.arange(0.0, 90.0, 0.02)
    is_paint = codes_at(street, bend(s, 0.0)) == Mat.PAINT_WHITE
    assert is_paint.mean() == pytest.approx(1 / 3, abs=0.01)
    starts = s[1:][is_paint[1:] & ~is_paint[:-1]]
    np.testing.assert_allclose(starts, 9.0 * np.arange(1, 10), atol=0.05)


def test_dashes_go_on_in_step_where_a_line_goes_on_as_another() -> None:
    world = curved_street()
    middle = world.lines[0]
    cut = 23
    parts = (
        WorldLine("b", middle.xy[cut:], middle.kind, middle.paint),
        WorldLine("a", middle.xy[: cut + 1], middle.kind, middle.paint),
    )
    tiles = tiles_along(20, 80)
    whole = tiles_of(world).raster(tiles)
    split = tiles_of(replace(world, lines=(*parts, *world.lines[1:]))).raster(tiles)
    # The mitre at the cut may move single cells, a dash out of step moves thousands.
    assert (whole.codes != split.codes).sum() < 20


@pytest.mark.parametrize(
    ("style", "left_share", "right_share"),
    [
        (MarkStyle.SOLID_SOLID, 1.0, 1.0),
        (MarkStyle.DASHED_SOLID, 0.5, 1.0),
        (MarkStyle.SOLID_DASHED, 1.0, 0.5),
    ],
)
def test_double_lines_are_two_stripes(style, left_share: float, right_share: float) -> None:
    paint = Paint(style, MarkColor.YELLOW, 0.1, 2.0, 2.0)
    quads = line_quads(np.array([[0.0, 0.0], [40.0, 0.0]]), paint)
    shapes = shapely.polygons(quads)
    left = shapely.union_all(shapes[quads[..., 1].mean(axis=1) > 0])
    right = shapely.union_all(shapes[quads[..., 1].mean(axis=1) < 0])
    assert left.area == pytest.approx(40 * 0.1 * left_share)
    assert right.area == pytest.approx(40 * 0.1 * right_share)
    assert left.distance(right) == pytest.approx(0.12)


def test_yellow_paint_is_yellow() -> None:
    world = curved_street()
    yellow = Paint(MarkStyle.SOLID, MarkColor.YELLOW, 0.12)
    line = WorldLine("middle", world.lines[0].xy, LineKind.PAINT, yellow)
    raster = tiles_of(replace(world, lines=(line,))).raster(tiles_along(20, 60))
    assert set(codes_at(raster, bend(np.arange(20.0, 60.0), 0.0))) == {Mat.PAINT_YELLOW}


def test_a_zebra_fills_its_crossing_half_with_stripes_along_the_lane(street) -> None:
    s, left = (
        a.ravel() for a in np.meshgrid(np.arange(100.1, 103.9, 0.02), np.arange(-3.4, 3.4, 0.02))
    )
    found = codes_at(street, bend(s, left))
    assert set(np.unique(found)) == {Mat.ZEBRA_PAINT, Mat.ZEBRA_GAP}
    assert (found == Mat.ZEBRA_PAINT).mean() == pytest.approx(0.5, abs=0.06)
    # Along the lane the code does not change (but where a line grazes a stripe's edge), across
    # it changes every half metre.
    grid = (found == Mat.ZEBRA_PAINT).reshape(len(np.unique(left)), -1)
    changes_along = np.median((grid[:, 1:] != grid[:, :-1]).sum(axis=1))
    changes_across = (grid[1:] != grid[:-1]).sum(axis=0).mean()
    assert changes_along == 0
    assert changes_across == pytest.approx(6.8 / 0.5, abs=1.5)


def test_beside_the_road_are_kerb_and_pavement_and_no_paint(street) -> None:
    s = np.arange(20.0, 240.0, 0.5)
    for side in (-1, 1):
        assert (codes_at(street, bend(s, side * (LANE_M + 0.07))) == Mat.KERB).mean() > 0.99
        assert (codes_at(street, bend(s, side * (LANE_M + 0.6))) == Mat.SIDEWALK).mean() > 0.99
    inside = codes_at(street, bend(s, LANE_M - 0.05))
    assert not np.isin(inside, [Mat.KERB, Mat.SIDEWALK, Mat.GRASS]).any()
    rows, cols = np.nonzero(np.isin(street.codes, [Mat.PAINT_WHITE, Mat.STOP_PAINT, Mat.ZEBRA_GAP]))
    xy = street.grid.to_city(np.column_stack([rows, cols]).astype(float))
    road = WorldIndex(curved_street()).rough_road(shapely.box(*street.grid.bounds_m))
    assert shapely.contains_xy(road.buffer(0.02), xy).all()


def test_tiles_are_the_same_whatever_was_made_before() -> None:
    tiles = sorted(tiles_along(60, 140))
    one, other = tiles_of(curved_street()), tiles_of(curved_street())
    forward = {t: one.tile(*t) for t in tiles}
    for t in reversed(tiles):
        np.testing.assert_array_equal(other.tile(*t).codes, forward[t].codes)
        np.testing.assert_array_equal(other.tile(*t).wear, forward[t].wear)


def test_harder_drives_have_less_paint_left() -> None:
    left = {}
    for difficulty in Difficulty:
        settings = SimulationSettings(seed=3, difficulty=difficulty)
        raster = tiles_of(curved_street(), settings).raster(tiles_along(60, 140))
        left[difficulty] = (
            raster.wear[np.isin(raster.codes, [Mat.PAINT_WHITE, Mat.ZEBRA_PAINT])].mean() / 255
        )
    assert left[Difficulty.EASY] > 0.9
    assert 0.6 < left[Difficulty.DEFAULT] < left[Difficulty.EASY]
    assert left[Difficulty.HARD] < left[Difficulty.DEFAULT] - 0.1
