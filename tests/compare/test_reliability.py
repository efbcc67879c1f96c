"""Reliability: zero for honest probabilities, the known gap for others."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.compare.paper import NO_TRUTH
from hdmap_tools.compare.reference import Reference, ReferenceGroup
from hdmap_tools.compare.reliability import (
    ReliabilityReport,
    assess,
    reliability,
    truth_of_classes,
    truth_of_reference,
)
from hdmap_tools.errors import LabelError, ShapeError
from hdmap_tools.fusion.temperature import EvidenceCells, checkerboard, softmax
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MapClass

CLASSES = ("road", "crosswalk", "lane_mark", "other")


def honest(number: int = 60_000, classes: int = 4, seed: int = 0):
    rng = np.random.default_rng(seed)
    p = softmax(rng.normal(0.0, 1.5, (classes, number)))
    truth = (rng.random(number) > np.cumsum(p, axis=0)).sum(axis=0).clip(0, classes - 1)
    return p, truth


def test_honest_probabilities_have_no_gap():
    p, truth = honest()
    curve = reliability(p, truth, names=CLASSES)
    assert curve.ece < 0.01
    assert curve.ece_equal_mass < 0.01
    assert max(curve.class_ece.values()) < 0.01
    assert curve.accuracy == pytest.approx(curve.mean_confidence, abs=0.01)
    assert sum(b.count for b in curve.bins) == curve.num_cells == len(truth)
    confidences = [b.confidence for b in curve.bins]
    assert confidences == sorted(confidences)


def test_a_known_gap_is_found():
    # Claims 0.9 for the first class everywhere; is right in 60 of 100 cells.
    p = np.tile(np.array([[0.9], [0.1]]), 100)
    truth = np.array([0] * 60 + [1] * 40)
    curve = reliability(p, truth)
    assert curve.ece == pytest.approx(0.3)
    assert curve.ece_equal_mass == pytest.approx(0.3)
    assert curve.class_ece == pytest.approx({"0": 0.3, "1": 0.3})
    assert curve.accuracy == 0.6
    assert curve.brier == pytest.approx(0.6 * 2 * 0.01 + 0.4 * 2 * 0.81)
    assert curve.nll == pytest.approx(-0.6 * np.log(0.9) - 0.4 * np.log(0.1))
    assert [(b.count, b.accuracy) for b in curve.bins] == [(100, 0.6)]


def test_errors_that_cancel_in_wide_bins_do_not_cancel_between_bins():
    p = np.array([[0.95] * 50 + [0.65] * 50, [0.05] * 50 + [0.35] * 50])
    truth = np.array([0] * 40 + [1] * 10 + [0] * 40 + [1] * 10)
    assert reliability(p, truth).ece == pytest.approx((0.15 + 0.15) / 2)


@given(st.integers(0, 500), st.integers(2, 6), st.integers(1, 300))
@settings(max_examples=40)
def test_measures_stay_in_their_bounds(seed, classes, number):
    rng = np.random.default_rng(seed)
    p = rng.dirichlet(np.full(classes, 0.3), number).T
    truth = rng.integers(-1, classes, number)
    truth[0] = 0
    curve = reliability(p, truth)
    assert 0 <= curve.ece <= 1
    assert 0 <= curve.ece_equal_mass <= 1
    assert abs(curve.mean_confidence - curve.accuracy) <= curve.ece + 1e-9
    assert curve.num_cells == (truth >= 0).sum()
    # The order of cells does not matter.
    order = rng.permutation(number)
    again = reliability(p[:, order], truth[order])
    assert again.ece == pytest.approx(curve.ece, abs=1e-12)
    assert again.ece_equal_mass == pytest.approx(curve.ece_equal_mass, abs=1e-12)


def test_certainty_and_unknown_cells():
    p = np.array([[[1.0, 0.0, np.nan, 0.5]], [[0.0, 1.0, np.nan, 0.5]]])
    truth = np.array([[0, 0, 0, -1]])
    curve = reliability(p, truth)
    assert curve.num_cells == 2
    assert curve.accuracy == 0.5
    assert np.isfinite(curve.nll)
    assert reliability(p, truth, np.array([[True, False, True, True]])).accuracy == 1.0
    with pytest.raises(ShapeError, match="No cell"):
        reliability(p, np.full((1, 4), -1))
    with pytest.raises(ShapeError, match="same cells"):
        reliability(p, truth[0])
    with pytest.raises(ShapeError, match="names class 2"):
        reliability(p, np.array([[2, 0, 0, 0]]))


def overconfident(grid: BevGrid, factor: float):
    """Cells whose evidence is too sure by a factor, and their truth drawn from what it should be."""
    rng = np.random.default_rng(1)
    rows, cols = (a.ravel() for a in np.mgrid[0 : grid.shape[0], 0 : grid.shape[1]])
    evidence = rng.normal(0.0, 1.5, (4, len(rows)))
    p = softmax(evidence)
    truth = (rng.random(len(rows)) > np.cumsum(p, axis=0)).sum(axis=0).clip(0, 3)
    index = np.full(grid.shape, NO_TRUTH)
    index[rows, cols] = truth
    cells = EvidenceCells(evidence * factor, np.zeros((4, 1)), np.column_stack([rows, cols]))
    return cells, index


def test_the_report_judges_where_it_did_not_fit():
    grid = BevGrid(0.5, 0, 0, 240, 240)
    cells, index = overconfident(grid, 6.0)
    board = checkerboard(grid)
    truth = truth_of_classes(index, CLASSES, CLASSES, "drawn")
    report = assess(cells, truth, board, "squares", temperature=2.0)
    assert report.temperature == pytest.approx(12.0, rel=0.05)
    assert report.num_cells_fitted == board.sum()
    expected = np.bincount(index[board], minlength=4) / board.sum()
    assert list(report.class_shares.values()) == pytest.approx(expected.tolist())
    assert report.before.num_cells == report.after.num_cells == (~board).sum()
    assert report.before.ece > 0.15
    assert report.after.ece < 0.015
    assert report.after.accuracy == pytest.approx(report.before.accuracy)
    assert ReliabilityReport.model_validate_json(report.to_json()) == report
    # What lies in the black squares does not change what was fitted.
    changed = index.copy()
    changed[~board] = 0
    other = assess(
        cells, truth_of_classes(changed, CLASSES, CLASSES, ""), board, "", temperature=2.0
    )
    assert other.temperature == report.temperature
    assert other.before.accuracy != report.before.accuracy


def test_a_mask_of_a_union_finds_the_temperature_too():
    grid = BevGrid(0.5, 0, 0, 200, 200)
    cells, index = overconfident(grid, 4.0)
    drivable = ReferenceGroup("drivable", DRIVABLE_CLASSES, index < 3)
    everywhere = np.ones(grid.shape, dtype=bool)
    truth = truth_of_reference(Reference(grid, (drivable,), everywhere, "mask", "r"), CLASSES)
    assert sorted(truth.names) == ["other", "road+crosswalk+lane_mark"]
    report = assess(cells, truth, checkerboard(grid), "")
    assert report.temperature == pytest.approx(4.0, rel=0.15)
    assert report.after.ece < 0.02 < report.before.ece


def test_groups_that_overlap_are_told_apart_as_far_as_they_go():
    grid = BevGrid(1.0, 0, 0, 4, 1)
    groups = (
        ReferenceGroup("drivable", DRIVABLE_CLASSES, np.array([[True, True, False, False]])),
        ReferenceGroup("crosswalk", (MapClass.CROSSWALK,), np.array([[False, True, False, True]])),
    )
    covered = np.ones((1, 4), dtype=bool)
    truth = truth_of_reference(Reference(grid, groups, covered, "r", "r"), CLASSES)
    names = [truth.names[k] if k >= 0 else None for k in truth.index[0]]
    # The last cell is a crosswalk outside the road, which no class is.
    assert names == ["road+lane_mark", "crosswalk", "other", None]
    covered = np.array([[False, True, True, True]])
    truth = truth_of_reference(Reference(grid, groups, covered, "r", "r"), CLASSES)
    assert truth.index[0, 0] == NO_TRUTH
    with pytest.raises(LabelError, match="any two"):
        truth_of_reference(Reference(grid, groups[:1], covered, "r", "r"), ("road", "lane_mark"))


def test_truth_of_classes_that_the_map_lacks():
    index = np.array([[0, 1, 2, NO_TRUTH]])
    names = ("road", "vegetation", "other")
    truth = truth_of_classes(index, names, ("lane_mark", "road", "other"), "")
    assert truth.index.tolist() == [[1, 2, 2, NO_TRUTH]]
    truth = truth_of_classes(index, names, ("lane_mark", "road"), "")
    assert truth.index.tolist() == [[1, NO_TRUTH, NO_TRUTH, NO_TRUTH]]


def test_truth_of_another_place_is_said():
    grid = BevGrid(0.5, 0, 0, 60, 60)
    cells, index = overconfident(grid, 2.0)
    nothing = truth_of_classes(np.full_like(index, NO_TRUTH), CLASSES, CLASSES, "elsewhere")
    with pytest.raises(ShapeError, match="truth of this place"):
        assess(cells, nothing, checkerboard(grid), "squares")
