import stat
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from shapely.geometry import box

from hdmap_tools.errors import FormatError, OutputExistsError, ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.view.canvas import (
    Viewport,
    draw_lines,
    draw_north_arrow,
    draw_scale_bar,
    fill,
    fitting_text,
    paint_cells,
    put_text,
    text_width,
    write_png,
)

BLACK, RED = (0, 0, 0), (255, 0, 0)


def white(height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), 255, dtype=np.uint8)


def ink(picture: np.ndarray) -> np.ndarray:
    """Share of black in each pixel."""
    return 1.0 - picture[..., 0] / 255.0


@pytest.mark.parametrize("width_px", [1, 2, 3, 4])
@pytest.mark.parametrize("is_upright", [True, False])
def test_a_line_on_the_edge_between_pixels_covers_both_sides_alike(
    width_px: int, is_upright: bool
) -> None:
    picture = white(20, 20)
    line = np.array([(10.0, -5.0), (10.0, 25.0)])
    draw_lines(picture, [line if is_upright else line[:, ::-1]], BLACK, width_px)
    across = ink(picture)[7] if is_upright else ink(picture)[:, 7]
    expected = np.zeros(20)
    whole, part = divmod(width_px / 2, 1)
    expected[10 - int(whole) : 10 + int(whole)] = 1.0
    expected[[9 - int(whole), 10 + int(whole)]] = part
    np.testing.assert_allclose(across, expected, atol=1 / 255)


def test_a_slanted_line_lies_where_it_is_at_sub_pixel_accuracy() -> None:
    picture = white(40, 40)
    draw_lines(picture, [np.array([(3.3, 40.0), (17.9, 0.0)])], BLACK, 2.0)
    share = ink(picture)
    columns = np.arange(40) + 0.5
    rows = np.arange(2, 38)
    found = (share[rows] * columns).sum(axis=1) / share[rows].sum(axis=1)
    np.testing.assert_allclose(found, 3.3 + (40 - (rows + 0.5)) / 40 * 14.6, atol=0.03)


def test_dashes_start_at_the_line_s_start() -> None:
    picture = white(3, 30)
    draw_lines(picture, [np.array([(2.0, 1.5), (28.0, 1.5)])], BLACK, 1.0, dash_px=(6.0, 4.0))
    expected = np.zeros(30)
    for start in (2, 12, 22):
        expected[start : start + 6] = 1.0
    np.testing.assert_allclose(ink(picture)[1], expected, atol=1 / 255)


def test_casing_is_white_beside_the_line() -> None:
    picture = np.full((9, 9, 3), 100, dtype=np.uint8)
    draw_lines(picture, [np.array([(0.0, 4.5), (9.0, 4.5)])], RED, 1.0, casing_px=1.0)
    assert picture[4, 4].tolist() == [255, 0, 0]
    assert picture[3, 4, 0] == picture[5, 4, 0] > 200
    assert picture[1, 4].tolist() == [100, 100, 100]


@pytest.mark.parametrize(
    "lines",
    [
        [],
        [np.zeros((1, 2))],
        [np.full((3, 2), 4.0)],
        [np.array([(1e7, 1e7), (2e7, 1e7)])],
    ],
)
def test_lines_without_length_or_far_away_draw_nothing(lines: list[np.ndarray]) -> None:
    picture = white(8, 8)
    draw_lines(picture, lines, BLACK, 2.0, dash_px=(2.0, 2.0))
    assert (picture == 255).all()


def test_a_line_of_a_thousand_kilometres_costs_only_what_is_seen() -> None:
    picture = white(8, 8)
    draw_lines(picture, [np.array([(-1e9, 4.0), (1e9, 4.0)])], BLACK, 2.0, dash_px=(2.0, 2.0))
    assert 0.3 < ink(picture)[3:5].mean() < 0.7


def test_fill_blends_by_covered_share_and_opacity() -> None:
    picture = white(4, 4)
    fill(picture, box(1.0, 1.0, 2.5, 2.0), BLACK)
    np.testing.assert_allclose(ink(picture)[1], [0, 1, 0.5, 0], atol=1 / 255)
    picture = white(4, 4)
    fill(picture, box(-9, -9, 9, 9), BLACK, 0.25)
    np.testing.assert_allclose(ink(picture), 0.25, atol=1 / 255)
    fill(picture, shapely.Polygon(), BLACK)
    fill(picture, box(20, 20, 30, 30), BLACK)


def test_cells_are_painted_north_up_and_east_right_with_hard_edges() -> None:
    grid = BevGrid(0.5, -1, -1, 2, 1)  # 3 columns, 2 rows
    colors = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    view = Viewport((-1.0, -0.5, 1.0, 0.5), 8.0)
    picture = paint_cells(colors, grid, view, RED)
    assert picture.shape == (8, 16, 3)
    expected = np.repeat(np.repeat(colors[::-1], 4, axis=0), 4, axis=1)
    np.testing.assert_array_equal(picture[:, 4:], expected)
    assert (picture[:, :4] == RED).all()  # x -1..-0.5 lies west of the grid


def test_cells_smaller_than_a_pixel_are_averaged_not_dropped() -> None:
    grid = BevGrid(0.25, 0, 0, 40, 40)
    colors = np.zeros((40, 40, 3), dtype=np.uint8)
    colors[:, ::4] = 255  # every fourth column
    picture = paint_cells(colors, grid, Viewport((0.0, 0.0, 10.0, 10.0), 1.0), BLACK)
    np.testing.assert_allclose(picture, 255 / 4, atol=1)


def test_points_go_to_the_pixels_that_cover_them() -> None:
    view = Viewport((10.0, 20.0, 30.0, 40.0), 5.0)
    assert view.shape == (100, 100)
    corners = np.array([(10.0, 40.0), (30.0, 20.0), (20.0, 40.0)])
    np.testing.assert_allclose(view.to_pixels(corners), [(0, 0), (100, 100), (50, 0)])


@pytest.mark.parametrize(
    ("bounds", "scale"),
    [((0, 0, 0, 1), 1), ((0, 0, 1, np.nan), 1), ((0, 0, 1, 1), 0), ((0, 0, 1, 1), np.inf)],
)
def test_a_view_of_nothing_is_refused(bounds: tuple[float, ...], scale: float) -> None:
    with pytest.raises(ShapeError):
        Viewport(bounds, scale)  # type: ignore[arg-type]


@pytest.mark.parametrize(("pixels_per_metre", "length_px"), [(10.0, 50), (7.0, 70), (0.02, 100)])
def test_the_scale_bar_has_the_length_it_says(pixels_per_metre: float, length_px: int) -> None:
    """5 m at 10 px/m, 10 m at 7 px/m, 5 km at 0.02 px/m: the longest round length below 0.3 of 330."""
    picture = white(120, 330 if length_px != 50 else 240)
    if pixels_per_metre == 0.02:
        picture = white(120, 340)
    draw_scale_bar(picture, pixels_per_metre)
    dark = (picture[120 - 13, :, 0] < 128).nonzero()[0]
    assert dark.max() - dark.min() + 1 == length_px


def test_marks_leave_tiny_pictures_alone() -> None:
    picture = white(30, 30)
    draw_scale_bar(picture, 10.0)
    draw_north_arrow(picture)
    assert (picture == 255).all()


def test_text_outside_ascii_is_written_as_question_marks_and_long_text_is_cut() -> None:
    first, second = white(30, 200), white(30, 200)
    put_text(first, "Straße", (5, 20))
    put_text(second, "Stra?e", (5, 20))
    np.testing.assert_array_equal(first, second)
    assert (first < 128).any()
    cut = fitting_text("a very long title indeed", 80)
    assert cut.endswith("...")
    assert text_width(cut) <= 80
    assert fitting_text("short", 80) == "short"


def test_png_keeps_rgb_is_repeatable_and_needs_leave_to_overwrite(tmp_path: Path) -> None:
    picture = white(3, 4)
    picture[0, 0] = (250, 100, 5)
    path = tmp_path / "a.png"
    write_png(picture, path)
    assert cv2.imread(str(path))[0, 0].tolist() == [5, 100, 250]
    first = path.read_bytes()
    with pytest.raises(OutputExistsError):
        write_png(picture, path)
    write_png(picture, path, overwrite=True)
    assert path.read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert path.stat().st_mode & stat.S_IRUSR
    with pytest.raises(FormatError, match="does not exist"):
        write_png(picture, tmp_path / "no" / "a.png")


@pytest.mark.parametrize(
    "picture", [np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3)), np.zeros((0, 2, 3), np.uint8)]
)
def test_what_is_no_picture_is_not_written(picture: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="uint8"):
        write_png(picture, tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
