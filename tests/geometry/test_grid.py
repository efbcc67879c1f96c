"""BevGrid: one lattice for all maps of a resolution."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdmap_tools.errors import CRSMismatchError, MapMismatchError, ShapeError
from hdmap_tools.geometry.grid import BevGrid, cells_of, to_picture
from hdmap_tools.geometry.map_frame import MapFrame

from .strategies import points

resolutions = st.sampled_from([0.05, 0.1, 0.2, 0.25, 0.5, 1.0])
cell_numbers = st.integers(-50_000, 50_000)


@st.composite
def grids(draw: st.DrawFn, resolution_m: float | None = None) -> BevGrid:
    x, y = draw(cell_numbers), draw(cell_numbers)
    width, height = draw(st.integers(1, 400)), draw(st.integers(1, 400))
    resolution_m = resolution_m or draw(resolutions)
    return BevGrid(resolution_m, x, y, x + width, y + height)


def test_negative_positions_floor_instead_of_folding_into_cell_zero() -> None:
    xy = np.array([[-0.01, -0.01], [0.0, 0.0], [0.19, 0.19], [-0.2, -0.2], [-0.21, 0.2]])
    assert cells_of(xy, 0.2).tolist() == [[-1, -1], [0, 0], [0, 0], [-1, -1], [-2, 1]]


def test_cell_zero_is_at_city_zero_whatever_the_window() -> None:
    for grid in (BevGrid(0.5, 0, 0, 4, 4), BevGrid(0.5, -100, 7, 3, 90)):
        assert grid.cells_of(np.array([[0.25, 0.25, 9.0]])).tolist() == [[0, 0]]


def test_rows_go_north_and_columns_east() -> None:
    grid = BevGrid(1.0, 10, 20, 14, 23)
    assert grid.shape == (3, 4)
    assert grid.rows_cols_of(np.array([[10.5, 20.5]])).tolist() == [[0, 0]]  # south-west
    assert grid.rows_cols_of(np.array([[10.5, 22.5]])).tolist() == [[2, 0]]  # north-west
    assert grid.rows_cols_of(np.array([[13.5, 20.5]])).tolist() == [[0, 3]]  # south-east
    np.testing.assert_array_equal(grid.y_centres_m, [20.5, 21.5, 22.5])
    np.testing.assert_array_equal(grid.x_centres_m, [10.5, 11.5, 12.5, 13.5])
    assert grid.bounds_m == (10.0, 20.0, 14.0, 23.0)


def test_a_picture_has_north_at_the_top() -> None:
    array = np.zeros((3, 4))
    array[2, 0] = 1.0  # north-west
    assert to_picture(array)[0, 0] == 1.0
    np.testing.assert_array_equal(to_picture(to_picture(array)), array)
    assert to_picture(np.zeros((3, 4, 3))).shape == (3, 4, 3)


@given(grids(), points(2, elements=st.floats(-400.0, 400.0)))
def test_to_city_undoes_to_grid(grid: BevGrid, rows_cols) -> None:
    np.testing.assert_allclose(grid.to_grid(grid.to_city(rows_cols)), rows_cols, atol=1e-6, rtol=0)
    city = rows_cols  # any pairs will do as city points
    np.testing.assert_allclose(grid.to_city(grid.to_grid(city)), city, atol=1e-9, rtol=0)


@given(grids())
def test_whole_positions_are_cell_centres(grid: BevGrid) -> None:
    rows, cols = grid.shape
    corners = np.array([[0, 0], [rows - 1, cols - 1]])
    centres = grid.to_city(corners)
    np.testing.assert_allclose(centres[0], [grid.x_centres_m[0], grid.y_centres_m[0]])
    np.testing.assert_allclose(centres[1], [grid.x_centres_m[-1], grid.y_centres_m[-1]])
    np.testing.assert_array_equal(grid.rows_cols_of(centres), corners)
    assert grid.contains(grid.rows_cols_of(centres)).all()


@given(resolutions.flatmap(lambda r: st.tuples(grids(r), grids(r))))
def test_a_union_covers_both_on_the_same_cell_edges(pair: tuple[BevGrid, BevGrid]) -> None:
    a, b = pair
    both = a.union(b)
    assert both == b.union(a)
    for grid in pair:
        row, col = grid.y_min - both.y_min, grid.x_min - both.x_min
        rows, cols = grid.shape
        # Bit-equal, so that merging is slicing and never resampling.
        np.testing.assert_array_equal(both.x_centres_m[col : col + cols], grid.x_centres_m)
        np.testing.assert_array_equal(both.y_centres_m[row : row + rows], grid.y_centres_m)
    assert both.shape[0] <= a.shape[0] + b.shape[0] + abs(a.y_min - b.y_min)


@given(grids(), points(2, elements=st.floats(-3e3, 3e3)))
def test_a_point_has_one_cell_in_every_window(grid: BevGrid, xy) -> None:
    moved = BevGrid(
        grid.resolution_m, grid.x_min - 3, grid.y_min + 5, grid.x_max + 1, grid.y_max + 9
    )
    np.testing.assert_array_equal(grid.cells_of(xy), moved.cells_of(xy))
    shift = np.tile([5, -3], (len(xy), 1))
    np.testing.assert_array_equal(grid.rows_cols_of(xy) - moved.rows_cols_of(xy), shift)


@given(
    st.tuples(*[st.floats(-1e4, 1e4)] * 2),
    st.tuples(*[st.floats(0.0, 500.0)] * 2),
    resolutions,
)
def test_from_bounds_covers_and_is_tight(corner, size, resolution_m: float) -> None:
    x0, y0 = corner
    x1, y1 = x0 + size[0], y0 + size[1]
    grid = BevGrid.from_bounds((x0, y0, x1, y1), resolution_m)
    gx0, gy0, gx1, gy1 = grid.bounds_m
    slack = 1e-8 * resolution_m + 1e-9
    assert gx0 <= x0 + slack
    assert gy0 <= y0 + slack
    assert gx1 >= x1 - slack
    assert gy1 >= y1 - slack
    assert max(x0 - gx0, y0 - gy0, gx1 - x1, gy1 - y1) < resolution_m + slack


def test_from_bounds_keeps_whole_cells_whole() -> None:
    # 0.3 / 0.1 is 2.9999999999999996.
    assert BevGrid.from_bounds((0.3, -0.3, 0.6, 0.7), 0.1) == BevGrid(0.1, 3, -3, 6, 7)


def test_contains_ends_before_the_far_edge() -> None:
    grid = BevGrid(0.2, -5, -5, 5, 5)
    inside = grid.contains(np.array([[0, 0], [9, 9], [10, 0], [0, 10], [-1, 0], [0, -1]]))
    assert inside.tolist() == [True, True, False, False, False, False]


def test_expand() -> None:
    grid = BevGrid(0.2, 0, 0, 10, 10)
    assert grid.expand(3) == BevGrid(0.2, -3, -3, 13, 13)
    assert grid.expand(3).expand(-3) == grid
    with pytest.raises(ShapeError, match="reversed"):
        grid.expand(-6)


def test_other_resolutions_and_frames_do_not_mix() -> None:
    grid = BevGrid(0.2, 0, 0, 10, 10)
    with pytest.raises(MapMismatchError, match=r"0.2 m and 0.1 m"):
        grid.union(BevGrid(0.1, 0, 0, 10, 10))
    with pytest.raises(CRSMismatchError, match="Two frames were mixed"):
        grid.union(BevGrid(0.2, 0, 0, 10, 10, MapFrame.from_origin(49.0, 8.4)))


@pytest.mark.parametrize("resolution_m", [0.0, -0.2, np.nan, np.inf])
def test_an_impossible_resolution_is_refused(resolution_m: float) -> None:
    with pytest.raises(ShapeError, match="resolution must be positive"):
        BevGrid(resolution_m, 0, 0, 1, 1)
    with pytest.raises(ShapeError, match="resolution must be positive"):
        BevGrid.from_bounds((0, 0, 1, 1), resolution_m)


def test_impossible_bounds_are_refused() -> None:
    with pytest.raises(ShapeError, match="reversed"):
        BevGrid(0.2, 5, 0, 4, 1)
    with pytest.raises(ShapeError, match="finite"):
        BevGrid.from_bounds((0.0, 0.0, np.nan, 1.0), 0.2)
    with pytest.raises(ShapeError, match="reversed"):
        BevGrid.from_bounds((5.0, 0.0, 1.0, 1.0), 0.2)


def test_an_empty_grid_is_allowed() -> None:
    grid = BevGrid(0.2, 3, 3, 3, 3)
    assert grid.shape == (0, 0)
    assert grid.x_centres_m.shape == (0,)
