from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Polygon

from hdmap_tools.compare.raster import compare_raster
from hdmap_tools.compare.reference import load_reference
from hdmap_tools.compare.vector_reference import reference_from_vector_map
from hdmap_tools.errors import CRSMismatchError, FormatError
from hdmap_tools.formats.by_name import read_vector_map, write_vector_map
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import (
    Centerline,
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    MarkStyle,
    RoadBoundary,
    SidewalkArea,
    StopLine,
    VirtualBoundary,
)
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.testing.scenes import window_from_posterior

GRID = BevGrid(0.2, 0, 0, 50, 50)  # 10 m x 10 m
ORIGIN = (49.0, 8.4)


def line(*xy: tuple[float, float]) -> LineString:
    return LineString([(x, y, 0.0) for x, y in xy])


def ring(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float]]:
    return [(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0), (x0, y0, 0.0)]


def map_of(*elements: MapElement, frame: MapFrame = GRID.frame) -> VectorMap:
    return VectorMap(frame, with_stable_ids(elements))


def cells(x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    truth = np.zeros(GRID.shape, dtype=bool)
    truth[y0:y1, x0:x1] = True
    return truth


def test_crosswalk_cells_are_where_the_polygon_is() -> None:
    reference = reference_from_vector_map(
        map_of(Crosswalk(geometry=Polygon(ring(2, 5, 6, 5.8)))), GRID
    )
    assert [g.name for g in reference.groups] == ["crosswalk"]
    np.testing.assert_array_equal(reference.groups[0].truth, cells(10, 25, 30, 29))
    assert any("no road area" in note for note in reference.notes)


def test_min_share_decides_about_half_covered_cells() -> None:
    half = map_of(Crosswalk(geometry=Polygon(ring(2, 5, 6, 5.5))))  # covers half of row 27
    for share, last in [(0.0, 28), (0.5, 28), (0.51, 27)]:
        truth = reference_from_vector_map(half, GRID, min_share=share).groups[0].truth
        np.testing.assert_array_equal(truth, cells(10, 25, 30, last))


@pytest.mark.parametrize("y", [5.0, 5.04, 5.08, 5.1, 5.14, 5.2])
@pytest.mark.parametrize("width_m", [None, 0.1, 0.15, 0.3])
def test_no_lane_mark_vanishes_wherever_it_lies_in_its_cells(
    y: float, width_m: float | None
) -> None:
    mark = LaneMark(geometry=line((1, y), (9, y)), width_m=width_m, style=MarkStyle.SOLID)
    truth = reference_from_vector_map(map_of(mark), GRID).group("lane_mark").truth
    painted = truth[:, 5:45]
    assert painted.any(axis=0).all()
    assert not truth[:, :5].any()
    assert not truth[:, 45:].any()
    rows = np.flatnonzero(painted.any(axis=1))
    centre = (rows + 0.5).mean() * 0.2
    assert len(rows) <= 2
    assert abs(centre - y) <= 0.1 + 1e-9


def test_paint_ends_where_its_line_ends() -> None:
    mark = LaneMark(geometry=line((2, 5.1), (4, 5.1)), width_m=0.2)
    truth = reference_from_vector_map(map_of(mark), GRID).group("lane_mark").truth
    np.testing.assert_array_equal(truth, cells(10, 25, 20, 26))


def test_road_is_the_closed_boundary_without_islands_and_paint() -> None:
    reference = reference_from_vector_map(
        map_of(
            RoadBoundary(geometry=LineString(ring(1, 1, 9, 9))),
            RoadBoundary(geometry=LineString(ring(4, 4, 6, 6)), is_island=True),
            StopLine(geometry=line((2, 3.1), (3, 3.1)), width_m=0.2),
            RoadBoundary(geometry=line((0, 9.5), (9, 9.5))),  # open: encloses nothing
        ),
        GRID,
    )
    drivable = cells(5, 5, 45, 45) & ~cells(20, 20, 30, 30)
    paint = cells(10, 15, 15, 16)
    np.testing.assert_array_equal(reference.group("drivable").truth, drivable)
    np.testing.assert_array_equal(reference.group("lane_mark").truth, paint)
    np.testing.assert_array_equal(reference.group("road").truth, drivable & ~paint)


def test_lanelets_make_the_road_whichever_way_their_bounds_run() -> None:
    left = LaneMark(id="l", geometry=line((1, 6), (9, 6)), style=MarkStyle.SOLID)
    right = LaneMark(id="r", geometry=line((9, 3), (1, 3)), style=MarkStyle.SOLID)
    lane = {"geometry": line((1, 4.5), (9, 4.5)), "left_id": "l", "right_id": "r"}
    driven = map_of(left, right, Lanelet(id="a", is_right_reversed=True, **lane))
    reference = reference_from_vector_map(driven, GRID)
    np.testing.assert_array_equal(reference.group("drivable").truth, cells(5, 15, 45, 30))
    walked = map_of(left, right, Lanelet(id="a", is_right_reversed=True, subtype="walkway", **lane))
    names = [g.name for g in reference_from_vector_map(walked, GRID).groups]
    assert names == ["lane_mark"]


def test_closed_kerbs_of_a_map_with_lanelets_are_not_road() -> None:
    bounds = [
        VirtualBoundary(id="l", geometry=line((1, 6), (9, 6))),
        VirtualBoundary(id="r", geometry=line((1, 3), (9, 3))),
    ]
    lane = Lanelet(id="a", geometry=line((1, 4.5), (9, 4.5)), left_id="l", right_id="r")
    parking = RoadBoundary(geometry=LineString(ring(2, 7, 8, 9)))
    reference = reference_from_vector_map(map_of(*bounds, lane, parking), GRID)
    np.testing.assert_array_equal(reference.group("drivable").truth, cells(5, 15, 45, 30))


def test_areas_beside_the_road_are_groups_of_their_own() -> None:
    reference = reference_from_vector_map(
        map_of(SidewalkArea(geometry=Polygon(ring(0, 8, 10, 10)))), GRID
    )
    np.testing.assert_array_equal(reference.group("sidewalk").truth, cells(0, 40, 50, 50))


def test_another_frame_on_earth_is_brought_over() -> None:
    here = MapFrame.from_origin(*ORIGIN)
    lon, lat, _ = here.to_wgs84(np.array([[1000.0, 500.0, 0.0]]))[0]
    there = MapFrame.from_origin(lat, lon)
    corners = here.from_wgs84(there.to_wgs84(np.array(ring(2, 5, 6, 5.8))))
    grid = BevGrid(0.2, 5000, 2500, 5050, 2550, here)
    own = map_of(Crosswalk(geometry=Polygon(corners)), frame=here)
    other = map_of(Crosswalk(geometry=Polygon(ring(2, 5, 6, 5.8))), frame=there)
    brought = reference_from_vector_map(other, grid, min_share=0.3)
    truth = reference_from_vector_map(own, grid, min_share=0.3).groups[0].truth
    assert truth.sum() in range(70, 110)
    np.testing.assert_array_equal(brought.groups[0].truth, truth)
    assert any("WGS84" in note for note in brought.notes)


def test_one_side_without_a_place_on_earth() -> None:
    crosswalk = Crosswalk(geometry=Polygon(ring(2, 5, 6, 5.8)))
    placed = map_of(crosswalk, frame=MapFrame.from_origin(*ORIGIN))
    with pytest.raises(CRSMismatchError, match="no origin on earth"):
        reference_from_vector_map(placed, GRID)
    assert reference_from_vector_map(placed, GRID, assume_same_frame=True).groups[0].truth.any()


def test_nothing_to_draw_and_another_place() -> None:
    with pytest.raises(FormatError, match="no elements"):
        reference_from_vector_map(map_of(), GRID)
    with pytest.raises(FormatError, match="1 centerline"):
        reference_from_vector_map(map_of(Centerline(geometry=line((0, 0), (1, 1)))), GRID)
    with pytest.raises(FormatError, match="does not overlap"):
        reference_from_vector_map(map_of(Crosswalk(geometry=Polygon(ring(200, 5, 206, 6)))), GRID)


def test_a_twisted_lanelet_is_drawn_not_raised() -> None:
    left = LaneMark(id="l", geometry=line((1, 6), (9, 6)))
    right = LaneMark(id="r", geometry=line((9, 3), (1, 3)))  # runs backwards, and does not say so
    lane = Lanelet(id="a", geometry=line((1, 4.5), (9, 4.5)), left_id="l", right_id="r")
    drivable = reference_from_vector_map(map_of(left, right, lane), GRID).group("drivable").truth
    assert 0 < drivable.sum() < cells(5, 15, 45, 30).sum()
    assert shapely.box(1, 3, 9, 6).area > 0.04 * drivable.sum()


@pytest.mark.parametrize("suffix", [".gpkg", ".osm", ".geojson"])
def test_a_map_file_is_read_and_drawn_where_it_lies(suffix: str, tmp_path: Path) -> None:
    frame = MapFrame.from_origin(*ORIGIN)
    grid = BevGrid(0.2, 0, 0, 50, 50, frame)
    crosswalk = Crosswalk(geometry=Polygon(ring(2, 5, 6, 5.78)))
    path = tmp_path / f"map{suffix}"
    write_vector_map(map_of(crosswalk, frame=frame), path)
    reference = load_reference(path, grid)
    np.testing.assert_array_equal(reference.group("crosswalk").truth, cells(10, 25, 30, 29))
    assert reference.source == path.name


@pytest.mark.parametrize("name", ["map.txt", "nothing.gpkg", "."])
def test_what_is_no_map_file_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "map.txt").write_text("hello")
    with pytest.raises(FormatError, match="expected"):
        load_reference(tmp_path / name, GRID)


@pytest.mark.realdata
def test_a_real_map_agrees_with_itself_and_not_with_itself_moved(data_root: Path) -> None:
    path = data_root / "lanelet2" / "mapping_example.osm"
    x0, y0, x1, y1 = read_vector_map(path).bounds_m or (0.0, 0.0, 1.0, 1.0)
    frame = read_vector_map(path).frame
    grid = BevGrid.from_bounds((x0, y0, x1, y1), 0.5, frame)
    reference = load_reference(path, grid)
    assert {"drivable", "road", "crosswalk", "lane_mark"} <= {g.name for g in reference.groups}
    drivable = reference.group("drivable").truth
    # The judge: shapely's own area of all vehicle lanelets.
    lines = {e.id: e.geometry for e in read_vector_map(path)}
    lanes = [
        Polygon(
            [
                *list(lines[lane.left_id].coords)[:: -1 if lane.is_left_reversed else 1],
                *list(lines[lane.right_id].coords)[:: 1 if lane.is_right_reversed else -1],
            ]
        )
        for lane in read_vector_map(path).of_type(Lanelet)
        if lane.subtype in ("road", "highway", "bus_lane", "bicycle_lane", "exit", "play_street")
    ]
    area = shapely.union_all([shapely.make_valid(shapely.force_2d(lane)) for lane in lanes]).area
    assert drivable.sum() * 0.25 == pytest.approx(area, rel=0.01)
    window = window_from_posterior(
        np.where(drivable, 0.6, 0.1)[None].repeat(5, axis=0).astype(np.float32)
        * np.array([1, 0, 0, 0, 0], dtype=np.float32)[:, None, None]
        + np.where(drivable, 0.1, 0.3)[None].astype(np.float32)
        * np.array([0, 0, 0, 1, 0], dtype=np.float32)[:, None, None],
        grid,
    )
    assert compare_raster(window, reference).groups["drivable"].iou == 1.0
    moved = BevGrid(0.5, grid.x_min + 10, grid.y_min, grid.x_max + 10, grid.y_max, frame)
    shifted = window_from_posterior(window.dataset["posterior"].values.copy(), moved)
    score = compare_raster(shifted, load_reference(path, moved)).groups["drivable"]
    assert score.iou is not None
    assert score.iou < 0.8
