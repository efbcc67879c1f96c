"""The paper's measures against counts done by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from hdmap_tools.compare.paper import (
    ANY_PAINT,
    EVALUATED,
    NO_TRUTH,
    PAPER_TABLE,
    PaperScores,
    paper_scores,
    paper_table,
    true_classes,
)
from hdmap_tools.errors import LabelError, ShapeError
from hdmap_tools.fusion.observation_model import OTHER
from hdmap_tools.labels.label_set import MAP_CLASSES
from hdmap_tools.testing.scenes import coverage, street_scene, street_shapes

NAMES = tuple(str(c) for c in MAP_CLASSES)
ROAD, CROSSWALK, MARK, VEGETATION, SIDEWALK = range(5)


def shares_of(cells: list[dict[int, float]]) -> np.ndarray:
    """(class, 1, n) from shares by class."""
    shares = np.zeros((5, 1, len(cells)))
    for k, cell in enumerate(cells):
        for c, share in cell.items():
            shares[c, 0, k] = share
    return shares


def sure(classes: list[int], names=(*NAMES, OTHER)) -> np.ndarray:
    """(class, 1, n) posterior that is sure of one class each; -1 is unknown."""
    posterior = np.full((len(names), 1, len(classes)), 0.02)
    for k, c in enumerate(classes):
        posterior[c, 0, k] = 0.9
        if c < 0:
            posterior[:, 0, k] = np.nan
    return posterior


def test_the_true_class_of_a_cell():
    shares = shares_of(
        [
            {MARK: 0.35, ROAD: 0.65},
            {MARK: 0.34, ROAD: 0.66},
            {MARK: 0.34, ROAD: 0.3, SIDEWALK: 0.36},  # paint too little for a mark lies on road
            {CROSSWALK: 0.4, ROAD: 0.6},
            {CROSSWALK: 0.6, ROAD: 0.4},
            {CROSSWALK: 0.6, MARK: 0.4},
            {SIDEWALK: 0.3, VEGETATION: 0.2},
            {},
        ]
    )
    got = true_classes(shares, NAMES).ravel().tolist()
    assert got == [MARK, ROAD, ROAD, ROAD, CROSSWALK, MARK, 5, 5]
    got = true_classes(shares, NAMES, ANY_PAINT).ravel().tolist()
    assert got == [MARK, MARK, MARK, CROSSWALK, CROSSWALK, MARK, 5, 5]
    shares[:, 0, 0] = np.nan
    assert true_classes(shares, NAMES)[0, 0] == NO_TRUTH


def test_figures_by_hand():
    truth = shares_of([{ROAD: 1}] * 4 + [{MARK: 1}] * 3 + [{CROSSWALK: 1}] * 2 + [{SIDEWALK: 1}])
    said = sure([ROAD, ROAD, MARK, -1, MARK, MARK, ROAD, CROSSWALK, 5, ROAD])
    scores = paper_scores(said, (*NAMES, OTHER), truth, NAMES)
    road, mark, cross = (scores.classes[n] for n in ("road", "lane_mark", "crosswalk"))
    assert (road.true_positives, road.false_positives, road.false_negatives) == (2, 2, 2)
    assert road.iou == pytest.approx(2 / 6)
    assert road.accuracy == pytest.approx(2 / 4)
    assert (mark.iou, mark.accuracy, mark.precision) == pytest.approx((2 / 4, 2 / 3, 2 / 3))
    assert (cross.iou, cross.accuracy, cross.precision) == pytest.approx((1 / 2, 1 / 2, 1.0))
    assert scores.miou == pytest.approx((1 / 3 + 1 / 2 + 1 / 2) / 3)
    assert scores.coverage == pytest.approx(8 / 9)
    assert (scores.num_cells, scores.num_unknown) == (10, 1)
    masked = paper_scores(
        said, (*NAMES, OTHER), truth, NAMES, np.array([[True] * 3 + [False] + [True] * 6])
    )
    assert masked.coverage == 1.0
    assert masked.classes["road"].accuracy == pytest.approx(2 / 3)
    assert PaperScores.model_validate_json(scores.to_json()) == scores


def test_the_order_of_classes_does_not_matter():
    truth = shares_of([{ROAD: 1}, {MARK: 1}, {CROSSWALK: 1}, {VEGETATION: 1}])
    said = sure([ROAD, MARK, ROAD, VEGETATION])
    order = [2, 0, 4, 1, 3]
    one = paper_scores(said, (*NAMES, OTHER), truth, NAMES)
    other = paper_scores(said, (*NAMES, OTHER), truth[order], [NAMES[k] for k in order])
    assert one == other


@given(st.integers(0, 300))
@settings(max_examples=30)
def test_a_perfect_map_is_perfect_under_both_rules(seed):
    rng = np.random.default_rng(seed)
    shares = rng.dirichlet(np.full(6, 0.4), (6, 7)).transpose(2, 0, 1)[:5]
    for paint_share in (0.35, ANY_PAINT):
        truth = true_classes(shares, NAMES, paint_share)
        posterior = np.eye(6)[truth].transpose(2, 0, 1)
        scores = paper_scores(posterior, (*NAMES, OTHER), shares, NAMES, paint_share=paint_share)
        assert all(s.iou in (1.0, None) for s in scores.classes.values())
        assert all(s.iou is None for s in scores.classes.values()) or scores.miou == 1.0


def test_a_known_street_scores_as_it_was_made():
    window = street_scene()
    shapes = street_shapes()
    shares = np.zeros((5, *window.grid.shape))
    shares[VEGETATION] = 1.0
    for name, shape in shapes.items():
        covered = coverage(shape, window.grid)
        shares *= 1.0 - covered
        shares[NAMES.index(str(name))] += covered
    posterior = window.dataset["posterior"].values
    scores = paper_scores(posterior, window.classes, shares, NAMES)
    assert scores.miou > 0.95
    assert scores.num_unknown == (~window.is_known).sum() > 0
    # Its outer cells blank, and a mask that leaves them out: the same figures inside.
    inner = np.zeros(window.grid.shape, dtype=bool)
    inner[20:-20, 30:-30] = True
    blank = np.where(inner, posterior, np.nan)
    assert paper_scores(blank, window.classes, shares, NAMES, inner) == paper_scores(
        posterior, window.classes, shares, NAMES, inner
    )
    assert paper_scores(blank, window.classes, shares, NAMES).classes["road"].accuracy < 0.9


def test_any_paint_makes_the_truth_wider_than_the_paint():
    # Marks 0.2 m wide that lie 0.05 m off the cells: two cells across, one with the more of it.
    grid = street_scene().grid
    marks = affinity.translate(street_shapes()["lane_mark"], yoff=0.05)
    paint = coverage(marks, grid, oversampling=8)
    shares = np.zeros((5, *grid.shape))
    shares[MARK], shares[ROAD] = paint, 1.0 - paint
    said = np.eye(6)[np.where(paint > 0.5, MARK, ROAD)].transpose(2, 0, 1)
    by_share = paper_scores(said, (*NAMES, OTHER), shares, NAMES)
    any_paint = paper_scores(said, (*NAMES, OTHER), shares, NAMES, paint_share=ANY_PAINT)
    true = [s.classes["lane_mark"] for s in (by_share, any_paint)]
    widths = [m.true_positives + m.false_negatives for m in true]
    assert widths[1] > 1.8 * (paint > 0.5).sum()
    assert true[0].iou > 0.9
    assert true[1].iou < 0.6


def test_a_class_that_is_nowhere_is_neither_right_nor_wrong():
    scores = paper_scores(sure([ROAD]), (*NAMES, OTHER), shares_of([{ROAD: 1}]), NAMES)
    assert scores.classes["crosswalk"].iou is None
    assert scores.miou == 1.0
    nothing = paper_scores(
        sure([ROAD]), (*NAMES, OTHER), shares_of([{ROAD: 1}]), NAMES, np.array([[False]])
    )
    assert nothing.miou is None
    assert nothing.num_cells == 0
    assert "-" in paper_table({"Vanilla": nothing})


def test_what_does_not_fit_is_refused():
    truth = shares_of([{ROAD: 1}])
    with pytest.raises(LabelError, match="truth has no crosswalk"):
        paper_scores(sure([ROAD]), (*NAMES, OTHER), truth[[0, 2]], ("road", "lane_mark"))
    with pytest.raises(LabelError, match="map has no"):
        paper_scores(sure([ROAD])[:2], NAMES[:2], truth, NAMES)
    with pytest.raises(ShapeError, match="same cells"):
        paper_scores(sure([ROAD, ROAD]), (*NAMES, OTHER), truth, NAMES)
    with pytest.raises(ShapeError, match="mask"):
        paper_scores(sure([ROAD]), (*NAMES, OTHER), truth, NAMES, np.ones((2, 2), dtype=bool))
    with pytest.raises(ShapeError, match="paint_share"):
        true_classes(truth, NAMES, 1.5)


def test_the_table_stands_beside_the_papers():
    truth = shares_of([{ROAD: 1}, {MARK: 1}, {CROSSWALK: 1}])
    scores = paper_scores(sure([ROAD, MARK, ROAD]), (*NAMES, OTHER), truth, NAMES)
    lines = paper_table({"CFN": scores, "ours": scores}).splitlines()
    assert len(lines) == 5
    assert [float(v) for v in lines[3].split()[3:7]] == [0.671, 0.605, 0.301, 0.526]
    assert len({len(line) for line in lines}) == 1


def test_the_papers_figures_are_consistent():
    for row in PAPER_TABLE.values():
        assert np.mean(row.iou) == pytest.approx(row.miou, abs=0.001)
    assert len(EVALUATED) == 3
