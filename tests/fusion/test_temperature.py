"""The temperature: found again where it was put in, and fitted on cells that are not the tried ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.config import ObservationConfig
from hdmap_tools.errors import ShapeError
from hdmap_tools.fusion.observation_model import observation_model
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.fusion.temperature import (
    checkerboard,
    fit_temperature,
    read_evidence,
    softmax,
)
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import MAP_CLASSES

from .builders import counts_of, frames_of, meta
from .test_intensity_likelihood import learned

RNG = np.random.default_rng(5)


def drawn(temperature: float, number: int = 40_000, classes: int = 4):
    """Evidence that is too sure by a known factor, and truth drawn from what it should have said."""
    rng = np.random.default_rng(int(temperature * 100))
    offset = np.log(np.array([0.5, 0.3, 0.15, 0.05]))[:classes, None]
    honest = rng.normal(0.0, 1.5, (classes, number))
    p = softmax(offset + honest)
    truth = (rng.random(number) > np.cumsum(p, axis=0)).sum(axis=0).clip(0, classes - 1)
    return honest * temperature, truth, offset


@pytest.mark.parametrize("temperature", [0.5, 1.0, 3.0, 40.0])
def test_the_factor_put_in_is_found(temperature):
    evidence, truth, offset = drawn(temperature)
    fit = fit_temperature(evidence, truth, offset)
    assert fit.temperature == pytest.approx(temperature, rel=0.06)
    assert fit.nll_after <= fit.nll_before + 1e-12
    assert fit.num_cells == len(truth)


def test_no_other_temperature_is_better():
    evidence, truth, offset = drawn(7.0, 5000)
    fit = fit_temperature(evidence, truth, offset)

    def nll(t):
        return -np.log(softmax(offset + evidence / t)[truth, np.arange(len(truth))]).mean()

    assert fit.nll_after == pytest.approx(nll(fit.temperature), abs=1e-12)
    others = [nll(t) for t in np.geomspace(1.0, 500, 200)]
    assert fit.nll_after <= min(others) + 1e-7


def test_truth_that_tells_only_unions_finds_it_too():
    evidence, truth, offset = drawn(5.0)
    members = np.array([[True, True, False, False], [False, False, True, True]])
    fit = fit_temperature(evidence, truth // 2, offset, members=members)
    assert fit.temperature == pytest.approx(5.0, rel=0.1)
    p = members @ softmax(offset + evidence / fit.temperature)
    expected = -np.log(p[truth // 2, np.arange(len(truth))]).mean()
    assert fit.nll_after == pytest.approx(expected, abs=1e-9)


def test_a_true_class_that_is_ruled_out_costs_but_breaks_nothing():
    evidence, truth, offset = drawn(3.0, 3000)
    offset = np.array(offset)
    offset[3] = -np.inf
    fit = fit_temperature(evidence, truth, offset)
    assert np.isfinite([fit.temperature, fit.nll_before, fit.nll_after]).all()


def test_what_does_not_fit_is_refused():
    with pytest.raises(ShapeError, match="at least one cell"):
        fit_temperature(np.zeros((3, 0)), np.zeros(0, int))
    with pytest.raises(ShapeError, match="at least one cell"):
        fit_temperature(np.zeros((3, 5)), np.zeros(4, int))
    with pytest.raises(ShapeError, match=r"0\.\.2"):
        fit_temperature(np.zeros((3, 2)), np.array([0, 3]))


@given(st.integers(-3, 3), st.integers(-3, 3))
@settings(max_examples=20)
def test_the_checkerboard_is_anchored_to_the_city(x, y):
    grid = BevGrid(0.5, x * 37, y * 41, x * 37 + 200, y * 41 + 160)
    board = checkerboard(grid, 20.0)
    xs, ys = np.meshgrid(grid.x_centres_m, grid.y_centres_m)
    for row, col in ((0, 0), (30, 99), (159, 199), (80, 40)):
        square = int(np.floor(xs[row, col] / 20)) + int(np.floor(ys[row, col] / 20))
        assert board[row, col] == (square % 2 == 0)
    assert 0.4 < board.mean() < 0.6


@pytest.mark.parametrize("with_intensity", [False, True])
def test_evidence_of_cells_gives_the_posterior_of_the_window(with_intensity):
    counts = counts_of(frames_of(2, 6))
    model = observation_model(
        ObservationConfig(model="vanilla", temperature=2.0), counts.meta, MAP_CLASSES, None
    )
    if with_intensity:
        model = model.with_intensity(learned(), 0.7)
    grid = BevGrid(0.2, -140, -120, 130, 140)
    mask = RNG.random(grid.shape) < 0.5
    for radius in (0, 1):
        window = read_window(counts, grid, model, radius)
        cells = read_evidence(counts, grid, model, mask, radius)
        rows, cols = cells.cells.T
        found = np.zeros(grid.shape, dtype=bool)
        found[rows, cols] = True
        np.testing.assert_array_equal(found, mask & window.is_known)
        expected = window.dataset["posterior"].values[:, rows, cols]
        np.testing.assert_allclose(cells.posterior(), expected, atol=1e-6)
    # A further temperature of 3 is the same as a model at 6.
    careful = observation_model(
        ObservationConfig(model="vanilla", temperature=6.0), counts.meta, MAP_CLASSES, None
    )
    if with_intensity:
        careful = careful.with_intensity(learned(), 0.7)
    expected = read_window(counts, grid, careful, 1).dataset["posterior"].values[:, rows, cols]
    np.testing.assert_allclose(cells.posterior(3.0), expected, atol=1e-6)
    some = cells[np.arange(5)]
    np.testing.assert_array_equal(some.posterior(), cells.posterior()[:, :5])


def test_no_cell_in_the_mask_gives_no_cells():
    counts = counts_of(frames_of(2, 1))
    model = observation_model(ObservationConfig(model="vanilla"), meta(), MAP_CLASSES, None)
    grid = BevGrid(0.2, 0, 0, 10, 10)
    cells = read_evidence(counts, grid, model, np.zeros(grid.shape, dtype=bool))
    assert cells.posterior().shape == (6, 0)
