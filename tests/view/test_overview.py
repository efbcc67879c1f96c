from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Polygon, box

from hdmap_tools.errors import CRSMismatchError, ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.map_model.elements import Crosswalk, LaneMark, MarkColor, MarkStyle, RoadBoundary
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.testing.scenes import window_from_posterior, window_from_shapes
from hdmap_tools.view.overview import (
    CameraPicture,
    Panel,
    class_colors,
    fitting_scale,
    known_bounds,
    map_legend,
    overview_page,
    overview_picture,
    render_panel,
)
from hdmap_tools.view.page import TitledPicture, compose, text_scale
from hdmap_tools.view.palette import CLASS_COLORS, PAPER, stroke_of

GRID = BevGrid.from_bounds((-10.0, -10.0, 10.0, 10.0), 0.5)
SCENE = {
    "road": box(-10, -3, 10, 3),
    "crosswalk": box(5, -3, 7, 3),  # in the east
    "sidewalk": box(-10, 5, 10, 7),  # in the north
}


def distance(pixel: np.ndarray, color: tuple[int, int, int]) -> float:
    return float(np.abs(pixel.astype(float) - color).max())


def at(picture: np.ndarray, x: float, y: float, scale: float = 10.0) -> np.ndarray:
    """The pixel of a city point in a picture of GRID's bounds."""
    return picture[int((10.0 - y) * scale), int((x + 10.0) * scale)]


def test_north_is_up_and_east_is_right() -> None:
    window = window_from_shapes(SCENE, GRID, accuracy=0.999)
    picture = render_panel(Panel("a", window), GRID.bounds_m, 10.0)
    assert picture.shape == (200, 200, 3)
    assert distance(at(picture, 6, 0), CLASS_COLORS["crosswalk"]) < 4
    assert distance(at(picture, -6, 0), CLASS_COLORS["road"]) < 4
    assert distance(at(picture, 0, 6), CLASS_COLORS["sidewalk"]) < 4
    assert distance(at(picture, 0, -6), CLASS_COLORS["vegetation"]) < 4


def test_cells_end_where_they_end_in_the_city() -> None:
    window = window_from_shapes(SCENE, GRID, accuracy=0.999)
    picture = render_panel(Panel("a", window), GRID.bounds_m, 10.0)
    row = picture[105]
    is_crosswalk = np.abs(row.astype(float) - CLASS_COLORS["crosswalk"]).max(axis=1) < 4
    assert is_crosswalk.nonzero()[0].tolist() == list(range(150, 170))  # x 5..7 m


def test_a_vector_on_a_cell_edge_is_drawn_on_the_edge_between_the_cells() -> None:
    window = window_from_shapes(SCENE, GRID, accuracy=0.999)
    mark = LaneMark(geometry=LineString([(5, -9, 0), (5, 9, 0)]), style=MarkStyle.SOLID)
    north = RoadBoundary(geometry=LineString([(-9, 3, 0), (4, 3, 0)]))
    drawn = VectorMap(GRID.frame, with_stable_ids([mark, north]))
    bare = render_panel(Panel("a", window), GRID.bounds_m, 20.0).astype(float)
    lined = render_panel(Panel("a", window, drawn), GRID.bounds_m, 20.0).astype(float)
    # x = 5 m is the edge between pixel columns 299 and 300; y = 3 m between rows 139 and 140.
    for changed, edge, stroke in [
        (np.abs(lined - bare)[230].sum(axis=1), 300, stroke_of(mark)),
        (np.abs(lined - bare)[:, 100].sum(axis=1), 140, stroke_of(north)),
    ]:
        touched = changed.nonzero()[0]
        assert touched.min() + touched.max() + 1 == 2 * edge
        assert len(touched) <= stroke.width_px + 4
    stroke = stroke_of(mark)
    share = stroke.width_px / 2 * stroke.opacity  # half the line in each of the two
    for column in (299, 300):
        mixed = bare[230, column] * (1 - share) + np.array(stroke.color) * share
        assert distance(lined[230, column], mixed) <= 1
    for row in (139, 140):
        assert distance(lined[row, 100], stroke_of(north).color) <= 1


def test_each_kind_of_element_has_its_own_colour() -> None:
    line = LineString([(0, 0, 0), (5, 0, 0)])
    strokes = {
        stroke_of(LaneMark(geometry=line, style=style, color=MarkColor.WHITE))
        for style in (MarkStyle.SOLID, MarkStyle.DASHED, MarkStyle.SOLID_SOLID, MarkStyle.UNKNOWN)
    }
    strokes.add(stroke_of(RoadBoundary(geometry=line)))
    strokes.add(stroke_of(Crosswalk(geometry=Polygon([(0, 0, 0), (1, 0, 0), (1, 1, 0)]))))
    assert len({s.color for s in strokes}) == len({s.name for s in strokes}) == 6


def test_unsure_cells_are_paler_and_unknown_ones_white() -> None:
    grid = BevGrid(1.0, 0, 0, 3, 1)
    posterior = np.full((5, 1, 3), np.nan, dtype=np.float32)
    posterior[:, 0, 0] = [0.96, 0.01, 0.01, 0.01, 0.01]
    posterior[:, 0, 1] = [0.24, 0.19, 0.19, 0.19, 0.19]
    sure, unsure, unknown = class_colors(window_from_posterior(posterior, grid))[0]
    assert tuple(unknown) == PAPER
    assert distance(sure, CLASS_COLORS["road"]) < 8
    assert (sure < unsure).all()
    assert (unsure < 250).any()


def test_the_arrow_points_where_the_vehicle_points() -> None:
    window = window_from_shapes({}, GRID)
    for yaw, ahead in [(0.0, (2, 0)), (np.pi / 2, (0, 2)), (np.pi, (-2, 0))]:
        pose = SE3.from_yaw(yaw)
        picture = render_panel(Panel("a", window), GRID.bounds_m, 10.0, city_SE3_ego=pose)
        assert at(picture, *ahead).max() < 60  # the tip, 2.4 m ahead, is dark
        assert at(picture, -ahead[0], -ahead[1]).max() > 60


def test_the_path_is_drawn_and_bad_points_are_left_out() -> None:
    window = window_from_shapes({}, GRID)
    path = np.array([(-8.0, -5.0, 0.0), (np.nan, 0.0, 0.0), (8.0, -5.0, 0.0)])
    picture = render_panel(Panel("a", window), GRID.bounds_m, 10.0, trajectory_xy=path)
    assert at(picture, 0, -5).max() < 110
    empty = render_panel(Panel("a", window), GRID.bounds_m, 10.0, trajectory_xy=np.zeros((0, 2)))
    assert (empty == render_panel(Panel("a", window), GRID.bounds_m, 10.0)).all()


def test_a_whole_page(tmp_path: Path) -> None:
    window = window_from_shapes(SCENE, GRID, unknown=box(-10, -10, -5, 10))
    mark = LaneMark(geometry=LineString([(-5, 0, 0), (9, 0, 0)]), style=MarkStyle.DASHED)
    vector_map = VectorMap(GRID.frame, with_stable_ids([mark]))
    panels = [Panel("sparse", window, vector_map), Panel("planar", window, note="0.2 m")]
    photo = np.full((90, 160, 3), (10, 200, 30), dtype=np.uint8)
    first, second = tmp_path / "a.png", tmp_path / "b.png"
    for path in (first, second):
        overview_picture(
            path,
            panels,
            images=[CameraPicture("front", photo)],
            trajectory_xy=np.array([(0.0, -2.0), (3.0, -2.0)]),
            city_SE3_ego=SE3.from_yaw(0.0, (3.0, -2.0, 0.0)),
            title="A drive",
            panel_px=300,
            image_height_px=180,
        )
    assert first.read_bytes() == second.read_bytes()
    page = cv2.imread(str(first))[..., ::-1]
    green = (np.abs(page.astype(int) - (10, 200, 30)).max(axis=2) < 3).sum()
    assert green == 180 * 320
    names = [e.name for e in map_legend(panels, has_path=True)]
    assert names[:3] == ["road", "crosswalk", "lane mark"]
    assert "lane mark, dashed" in names
    assert names[-1] == "vehicle and its path"


def test_all_panels_show_the_same_ground_at_the_same_scale() -> None:
    west = window_from_shapes(SCENE, GRID, unknown=box(-5, -10, 10, 10))
    east = window_from_shapes(SCENE, GRID, unknown=box(-10, -10, 5, 10))
    assert known_bounds([west]) == (-12.0, -12.0, -3.0, 12.0)
    assert known_bounds([west, east]) == (-12.0, -12.0, 12.0, 12.0)
    nothing = window_from_shapes({}, GRID, unknown=box(-10, -10, 10, 10))
    assert known_bounds([nothing]) == GRID.bounds_m


def test_images_are_as_wide_as_the_maps_unless_told_otherwise() -> None:
    panel = Panel("a", window_from_shapes(SCENE, GRID))
    photo = CameraPicture("front", np.full((90, 160, 3), (10, 200, 30), dtype=np.uint8))
    page = overview_page([panel, panel], images=[photo], bounds_m=GRID.bounds_m, panel_px=400)
    green = (np.abs(page.astype(int) - (10, 200, 30)).max(axis=2) < 3).any(axis=0)
    assert green.sum() == 800


def test_a_map_without_any_cell_still_gives_a_page() -> None:
    grid = BevGrid(0.5, 0, 0, 0, 0)
    window = window_from_posterior(np.zeros((5, 0, 0), dtype=np.float32), grid)
    assert overview_page([Panel("empty", window)], panel_px=100).shape[2] == 3


def test_scale_is_a_whole_number_of_pixels_a_cell() -> None:
    assert fitting_scale((0, 0, 84, 84), 0.2, 900) * 0.2 == pytest.approx(2)
    assert fitting_scale((0, 0, 84, 40), 0.2, 700) * 0.2 == pytest.approx(2)
    assert fitting_scale((0, 0, 5000, 10), 0.2, 900) == pytest.approx(0.18)


def test_refusals() -> None:
    window = window_from_shapes({}, GRID)
    with pytest.raises(ShapeError, match="at least one map"):
        overview_page([])
    bad = CameraPicture("front", np.zeros((3, 3), dtype=np.uint8))
    with pytest.raises(ShapeError, match=r"'front' must be .* RGB"):
        overview_page([Panel("a", window)], images=[bad])
    frame = MapFrame.from_origin(49.0, 8.4)
    with pytest.raises(CRSMismatchError):
        Panel("a", window, VectorMap(frame))
    there = BevGrid.from_bounds((-10.0, -10.0, 10.0, 10.0), 0.5, frame)
    with pytest.raises(CRSMismatchError):
        overview_page([Panel("a", window), Panel("b", window_from_shapes({}, there))])


def test_a_page_of_many_large_maps_fits_a_screen() -> None:
    grid = BevGrid.from_bounds((0.0, 0.0, 110.0, 108.0), 0.1)
    window = window_from_shapes({"road": box(0, 40, 110, 60)}, grid)
    photo = CameraPicture("front", np.full((563, 1000, 3), 90, dtype=np.uint8))
    panels = [Panel(name, window) for name in "abcd"]
    page = overview_page(panels, images=[photo, photo], bounds_m=grid.bounds_m)
    assert 2000 < page.shape[1] <= 2400
    # Two rows of maps, a pixel a cell.
    is_road = (np.abs(page.astype(int) - CLASS_COLORS["road"]).max(axis=2) < 6).sum(axis=1)
    assert (is_road >= 2 * 1000).sum() == 2 * 200


@pytest.mark.parametrize("size_m", [30, 84, 113, 135, 140, 170, 400])
def test_no_map_is_much_larger_than_asked(size_m: float) -> None:
    size_px = fitting_scale((0, 0, size_m, size_m), 0.1, 900) * size_m
    assert 450 <= size_px <= 900 * 1.3 + 1e-9


def test_the_paint_under_a_lane_mark_stays_visible() -> None:
    """Its dashes can be counted along the line that is drawn over them."""
    dashes = shapely.MultiPolygon([box(x, -0.1, x + 3, 0.1) for x in (-9, -3, 3)])
    grid = BevGrid.from_bounds((-10.0, -10.0, 10.0, 10.0), 0.1)
    window = window_from_shapes({"road": box(-10, -3, 10, 3), "lane_mark": dashes}, grid)
    mark = LaneMark(geometry=LineString([(-9, 0, 0), (6, 0, 0)]), style=MarkStyle.DASHED)
    drawn = VectorMap(grid.frame, with_stable_ids([mark]))
    picture = render_panel(Panel("a", window, drawn), grid.bounds_m, 10.0).astype(float)
    line = picture[[99, 100], 12:158].mean(axis=0)
    yellow = line[:, 0] - line[:, 2]
    assert np.ptp(yellow) > 40
    is_painted = yellow > (yellow.min() + yellow.max()) / 2
    assert np.count_nonzero(np.diff(is_painted.astype(int)) == 1) + is_painted[0] == 3
    assert stroke_of(mark).dash_px is None


def test_text_grows_with_the_page() -> None:
    assert text_scale(640) == 1.0
    assert text_scale(2100) == pytest.approx(1.5)
    narrow, wide = (
        compose([[TitledPicture("x", np.full((10, n, 3), 255, np.uint8))]], title="T")
        for n in (600, 2400)
    )
    assert wide.shape[0] > narrow.shape[0]
