import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate
from shapely.geometry import MultiPolygon, Polygon, box

from hdmap_tools.compare.rasterize import SCAN_LINES_PER_CELL, coverage_share, unit_coverage
from hdmap_tools.geometry.grid import BevGrid


def exact_share(area: shapely.Geometry, grid: BevGrid) -> np.ndarray:
    """The judge: GEOS cuts every single cell."""
    r = grid.resolution_m
    xs, ys = np.meshgrid(grid.x_centres_m, grid.y_centres_m)
    cells = shapely.box(xs - r / 2, ys - r / 2, xs + r / 2, ys + r / 2)
    return shapely.area(shapely.intersection(cells, area)) / r**2


def test_a_box_on_cell_edges_covers_its_cells_and_no_other() -> None:
    grid = BevGrid.from_bounds((-1.0, -1.0, 1.0, 1.0), 0.2)
    share = coverage_share([box(-0.4, 0.2, 0.6, 0.4)], grid)
    expected = np.zeros((10, 10))
    expected[6, 3:8] = 1.0  # row 6 is y 0.2..0.4, counted from the south
    np.testing.assert_allclose(share, expected, atol=1e-9)


def test_length_along_x_is_exact_for_any_position() -> None:
    grid = BevGrid(1.0, 0, 0, 4, 1)
    share = coverage_share([box(0.123, 0.0, 2.777, 1.0)], grid)
    np.testing.assert_allclose(share[0], [0.877, 1.0, 0.777, 0.0], atol=1e-12)


def test_holes_and_parts_and_overlaps() -> None:
    ring = box(0, 0, 3, 3).difference(box(1, 1, 2, 2))
    grid = BevGrid(1.0, 0, 0, 6, 3)
    share = coverage_share([ring, MultiPolygon([box(4, 0, 5, 1)]), box(4, 0, 5, 1)], grid)
    expected = np.ones((3, 6))
    expected[1, 1] = 0
    expected[:, 3:] = 0
    expected[0, 4] = 1
    np.testing.assert_allclose(share, expected, atol=1e-12)


def test_areas_that_stick_out_on_every_side_fill_the_grid() -> None:
    grid = BevGrid(0.5, -3, -3, 3, 3)
    np.testing.assert_array_equal(coverage_share([box(-99, -99, 99, 99)], grid), 1.0)


@pytest.mark.parametrize(
    "areas", [[], [Polygon()], [box(50, 50, 51, 51)], [shapely.LineString([(0, 0), (1, 1)])]]
)
def test_nothing_inside_gives_zero(areas: list[shapely.Geometry]) -> None:
    assert not coverage_share(areas, BevGrid(0.5, 0, 0, 4, 4)).any()


def test_an_empty_grid_gives_an_empty_array() -> None:
    assert coverage_share([box(0, 0, 1, 1)], BevGrid(0.5, 0, 0, 0, 4)).shape == (4, 0)
    assert unit_coverage(box(0, 0, 1, 1), (0, 0)).shape == (0, 0)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-1.5, 1.5),
    st.floats(-1.5, 1.5),
    st.floats(0.1, 3),
    st.floats(0.1, 3),
    st.floats(0, 180),
)
def test_any_turned_rectangle_matches_cutting_each_cell(
    x: float, y: float, w: float, h: float, angle: float
) -> None:
    area = rotate(box(x, y, x + w, y + h), angle)
    grid = BevGrid.from_bounds((-3.0, -3.0, 3.0, 3.0), 0.4)
    # The promise: edges sampled along y are off by half a scan line, and a cell has at most two.
    np.testing.assert_allclose(
        coverage_share([area], grid),
        exact_share(area, grid),
        atol=2 * 0.5 / SCAN_LINES_PER_CELL + 1e-9,
    )
