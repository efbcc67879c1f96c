import json
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import cKDTree
from shapely.geometry import box

from hdmap_tools.compare.raster import RasterComparison, cells_in_range, compare_raster
from hdmap_tools.compare.reference import Reference, ReferenceGroup, group_name
from hdmap_tools.errors import CRSMismatchError, LabelError, MapMismatchError, ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MAP_CLASSES, MapClass
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.testing.scenes import window_from_posterior, window_from_shapes

ROAD, CROSSWALK, LANE_MARK, VEGETATION, SIDEWALK = range(5)
UNKNOWN = -1


def window_of(classes: np.ndarray, grid: BevGrid | None = None, **layers: np.ndarray) -> MapWindow:
    """A window whose most probable class in each cell is given; -1 is unknown."""
    classes = np.asarray(classes)
    grid = grid or BevGrid(0.5, 0, 0, classes.shape[1], classes.shape[0])
    posterior = np.full((5, *classes.shape), 0.1, dtype=np.float32)
    for k in range(5):
        posterior[k][classes == k] = 0.6
    posterior[:, classes == UNKNOWN] = np.nan
    return window_from_posterior(posterior, grid, **layers)


def reference_of(
    grid: BevGrid, covered: np.ndarray | None = None, **truth: np.ndarray
) -> Reference:
    groups = []
    for name, cells in truth.items():
        classes = DRIVABLE_CLASSES if name == "drivable" else (MapClass(name),)
        groups.append(ReferenceGroup(group_name(classes), classes, np.asarray(cells, dtype=bool)))
    is_covered = np.ones(grid.shape, dtype=bool) if covered is None else covered
    return Reference(grid, tuple(groups), is_covered, "made", "by hand")


def test_scores_counted_by_hand() -> None:
    classes = np.array(
        [
            [ROAD, LANE_MARK, CROSSWALK, VEGETATION],
            [ROAD, SIDEWALK, UNKNOWN, ROAD],
            [VEGETATION, ROAD, UNKNOWN, SIDEWALK],
        ]
    )
    truth = np.array([[1, 1, 0, 1], [1, 1, 1, 0], [0, 1, 0, 0]])
    window = window_of(classes)
    result = compare_raster(window, reference_of(window.grid, drivable=truth))
    score = result.groups["drivable"]
    # Said and true: (0,0) (0,1) (1,0) (2,1). Said only: (0,2) (1,3). True only: (0,3) (1,1).
    assert (score.true_positives, score.false_positives) == (4, 2)
    assert (score.false_negatives, score.true_negatives) == (2, 2)
    assert (score.iou, score.recall, score.precision) == (4 / 8, 4 / 6, 4 / 6)
    assert (result.num_cells, result.area_m2, result.num_cells_not_observed) == (10, 2.5, 2)
    assert (score.truth_area_m2, score.predicted_area_m2) == (1.5, 1.5)
    assert score.truth_not_observed_m2 == 0.25
    assert result.miou is None  # a union is not a class
    assert result.compared is not None
    np.testing.assert_array_equal(result.compared, classes != UNKNOWN)


def test_single_classes_and_their_mean() -> None:
    classes = np.array([[ROAD, ROAD, CROSSWALK, VEGETATION]])
    window = window_of(classes)
    result = compare_raster(
        window,
        reference_of(
            window.grid,
            drivable=[[1, 1, 1, 1]],
            road=[[1, 1, 1, 0]],
            crosswalk=[[0, 0, 0, 1]],
            sidewalk=[[0, 0, 0, 0]],
        ),
    )
    assert result.groups["road"].iou == 2 / 3
    crosswalk = result.groups["crosswalk"]
    assert (crosswalk.iou, crosswalk.recall, crosswalk.precision) == (0.0, 0.0, 0.0)
    absent = result.groups["sidewalk"]
    assert (absent.iou, absent.recall, absent.precision) == (None, None, None)
    assert result.miou == pytest.approx((2 / 3 + 0) / 2)


def test_a_class_only_one_side_has() -> None:
    window = window_of(np.array([[ROAD, LANE_MARK]]))
    result = compare_raster(
        window, reference_of(window.grid, lane_mark=[[0, 0]], crosswalk=[[1, 0]])
    )
    only_map, only_reference = result.groups["lane_mark"], result.groups["crosswalk"]
    assert (only_map.iou, only_map.recall, only_map.precision) == (0.0, None, 0.0)
    assert (only_reference.iou, only_reference.recall, only_reference.precision) == (0.0, 0.0, None)


def test_a_union_takes_the_most_probable_class_not_the_sum() -> None:
    grid = BevGrid(0.5, 0, 0, 1, 1)
    posterior = np.array([0.25, 0.2, 0.15, 0.4, 0.0], dtype=np.float32).reshape(5, 1, 1)
    result = compare_raster(
        window_from_posterior(posterior, grid), reference_of(grid, drivable=[[1]])
    )
    assert result.groups["drivable"].false_negatives == 1


def test_only_covered_visible_and_near_cells_count() -> None:
    window = window_of(np.full((1, 8), ROAD))
    covered = np.array([[0, 1, 1, 1, 1, 1, 1, 1]], dtype=bool)
    visible = np.array([[1, 1, 1, 1, 1, 1, 1, 0]], dtype=bool)
    result = compare_raster(
        window,
        reference_of(window.grid, covered, drivable=np.ones((1, 8))),
        visible=visible,
        path_xy=np.array([[1.75, 0.25], [np.nan, 0.0]]),  # the centre of cell 3
        max_range_m=1.0,
    )
    assert result.compared is not None
    assert result.compared.tolist() == [[False, True, True, True, True, True, False, False]]
    assert result.max_range_m == 1.0


def test_range_counts_from_points_in_three_dimensions_too() -> None:
    grid = BevGrid(1.0, -3, -3, 3, 3)
    near = cells_in_range(grid, np.array([[0.5, 0.5, 99.0]]), 1.0)
    expected = np.zeros((6, 6), dtype=bool)
    expected[3, 2:5] = True
    expected[2:5, 3] = True
    np.testing.assert_array_equal(near, expected)


@pytest.mark.parametrize("reach_m", [0.2, 1.0, 7.3, 500.0])
def test_cells_in_range_are_those_that_a_tree_of_the_path_finds(reach_m: float) -> None:
    grid = BevGrid(0.1, -57, 300, 113, 417)
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.normal(0.03, 0.2, (40, 2)), axis=0) + (0.0, 35.0)
    path = np.concatenate([path, np.round(path, 1) + 0.05])  # also exactly on centres
    centres = np.stack(np.meshgrid(grid.x_centres_m, grid.y_centres_m), axis=-1)
    distance, _ = cKDTree(path).query(
        centres.reshape(-1, 2), distance_upper_bound=reach_m * (1 + 1e-9)
    )
    expected = np.isfinite(distance).reshape(grid.shape)
    np.testing.assert_array_equal(cells_in_range(grid, path, reach_m), expected)
    assert expected.any()


def test_filled_cells_are_counted_or_left_out() -> None:
    window = window_of(np.array([[ROAD, ROAD, UNKNOWN]]), observations=np.array([[3.0, 0.0, 0.0]]))
    reference = reference_of(window.grid, drivable=[[1, 1, 1]])
    with_filled = compare_raster(window, reference)
    assert (with_filled.num_cells, with_filled.num_cells_filled) == (2, 1)
    without = compare_raster(window, reference, count_filled=False)
    assert (without.num_cells, without.num_cells_filled, without.num_cells_not_observed) == (
        1,
        0,
        2,
    )


@pytest.mark.parametrize("shape", [(2, 3), (0, 3)])
def test_nothing_seen_gives_no_scores_and_says_so(shape: tuple[int, int]) -> None:
    window = window_of(np.full(shape, UNKNOWN))
    truth = np.ones(shape)
    result = compare_raster(window, reference_of(window.grid, drivable=truth, road=truth))
    assert result.num_cells == 0
    assert result.miou is None
    assert {s.iou for s in result.groups.values()} == {None}
    assert any("Nothing was compared" in note for note in result.notes)
    json.loads(result.to_json())


L_SHAPE = {"road": box(1, 1, 2, 9).union(box(1, 1, 6, 2)), "lane_mark": box(7, 1, 7.5, 4)}
L_GRID = BevGrid.from_bounds((0.0, 0.0, 10.0, 10.0), 0.25)


@pytest.mark.parametrize(
    ("moved", "lowest", "highest"),
    [
        pytest.param(lambda a: a, 1.0, 1.0, id="as it is"),
        pytest.param(lambda a: a[::-1], 0.0, 0.6, id="mirrored north-south"),
        pytest.param(lambda a: a[:, ::-1], 0.0, 0.6, id="mirrored east-west"),
        pytest.param(lambda a: a.T, 0.0, 0.6, id="transposed"),
        pytest.param(np.rot90, 0.0, 0.6, id="turned"),
        pytest.param(lambda a: a[::-1, ::-1], 0.0, 0.6, id="upside down"),
        # Road: 192 cells, of which so many overlap after the shift; the mark is 2 x 12 cells.
        pytest.param(
            lambda a: np.roll(a, 1, axis=1), *[(160 / 224 + 1 / 3) / 2] * 2, id="a cell east"
        ),
        pytest.param(
            lambda a: np.roll(a, -1, axis=0), *[(172 / 212 + 11 / 13) / 2] * 2, id="a cell south"
        ),
    ],
)
def test_only_the_right_orientation_and_place_agree(
    moved: Callable[[np.ndarray], np.ndarray], lowest: float, highest: float
) -> None:
    window = window_from_shapes(L_SHAPE, L_GRID)
    road = np.zeros(L_GRID.shape, dtype=bool)
    road[4:36, 4:8] = True  # the upright of the L, from y = 1 to 9 m
    road[4:8, 4:24] = True  # its foot, to the east
    mark = np.zeros(L_GRID.shape, dtype=bool)
    mark[4:16, 28:30] = True
    result = compare_raster(window, reference_of(L_GRID, road=moved(road), lane_mark=moved(mark)))
    assert result.miou is not None
    assert lowest - 1e-12 <= result.miou <= highest + 1e-12


labels = hnp.arrays(np.int8, (4, 5), elements=st.integers(-1, 4))
bits = hnp.arrays(np.bool_, (4, 5))


@settings(max_examples=80, deadline=None)
@given(labels, bits, bits)
def test_scores_are_shares_and_counts_add_up(
    classes: np.ndarray, truth: np.ndarray, covered: np.ndarray
) -> None:
    window = window_of(classes)
    result = compare_raster(window, reference_of(window.grid, covered, drivable=truth))
    score = result.groups["drivable"]
    total = (
        score.true_positives + score.false_positives + score.false_negatives + score.true_negatives
    )
    assert total == result.num_cells == int(((classes != UNKNOWN) & covered).sum())
    for value in (score.iou, score.recall, score.precision):
        assert value is None or 0.0 <= value <= 1.0
    if score.iou is not None and score.recall and score.precision:
        harmonic = 1 / (1 / score.recall + 1 / score.precision - 1)
        assert score.iou == pytest.approx(harmonic)
    assert RasterComparison.from_json(result.to_json()) == result


@settings(max_examples=50, deadline=None)
@given(bits, bits)
def test_iou_is_symmetric_one_for_the_same_and_zero_for_disjoint(
    a: np.ndarray, b: np.ndarray
) -> None:
    def iou(predicted: np.ndarray, truth: np.ndarray) -> float | None:
        window = window_of(np.where(predicted, ROAD, VEGETATION))
        return compare_raster(window, reference_of(window.grid, road=truth)).groups["road"].iou

    assert iou(a, b) == iou(b, a)
    assert iou(a, a) == (1.0 if a.any() else None)
    assert iou(a, ~a) == 0.0


def test_json_has_no_cells_and_fits_its_schema() -> None:
    import jsonschema

    window = window_of(np.array([[ROAD, UNKNOWN]]))
    result = compare_raster(window, reference_of(window.grid, road=[[1, 0]], sidewalk=[[0, 0]]))
    document = json.loads(result.to_json())
    jsonschema.validate(document, RasterComparison.model_json_schema(mode="serialization"))
    assert document["schema_version"] == 1
    assert document["groups"]["sidewalk"]["iou"] is None
    assert "compared" not in document
    assert "_compared" not in document
    read = RasterComparison.from_json(result.to_json())
    assert read == result
    assert read.compared is None


def test_refusals() -> None:
    window = window_of(np.full((2, 2), ROAD))
    good = reference_of(window.grid, road=np.ones((2, 2)))
    finer = BevGrid(0.25, 0, 0, 2, 2)
    with pytest.raises(MapMismatchError, match=r"0\.5 m and 0\.25 m"):
        compare_raster(window, reference_of(finer, road=np.ones((2, 2))))
    moved = BevGrid(0.5, 1, 0, 3, 2)
    with pytest.raises(MapMismatchError, match="own grid"):
        compare_raster(window, reference_of(moved, road=np.ones((2, 2))))
    elsewhere = BevGrid(0.5, 0, 0, 2, 2, MapFrame.from_origin(49.0, 8.4))
    with pytest.raises(CRSMismatchError):
        compare_raster(window, reference_of(elsewhere, road=np.ones((2, 2))))
    with pytest.raises(ShapeError, match="path_xy"):
        compare_raster(window, good, max_range_m=5.0)
    with pytest.raises(ShapeError, match="at least one finite"):
        compare_raster(window, good, max_range_m=5.0, path_xy=np.full((1, 2), np.nan))
    with pytest.raises(ShapeError, match="visible"):
        compare_raster(window, good, visible=np.ones((3, 2), dtype=bool))
    with pytest.raises(ShapeError, match="bool of the grid"):
        Reference(window.grid, good.groups, np.ones((3, 3), dtype=bool), "made", "by hand")


def test_a_map_without_the_class_is_refused() -> None:
    window = window_of(np.full((1, 1), ROAD))
    few = MapWindow(window.dataset.isel({"class": slice(0, 2)}), window.grid)
    with pytest.raises(LabelError, match="sidewalk"):
        compare_raster(few, reference_of(window.grid, sidewalk=[[1]]))
    assert len(MAP_CLASSES) == 5
