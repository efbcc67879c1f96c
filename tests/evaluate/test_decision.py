"""Deciding for classes: the weights that a made case asks for, and none where nothing is to learn."""

import numpy as np
import pytest

from hdmap_tools.compare.paper import NO_TRUTH
from hdmap_tools.evaluate.decision import fit_decision, weighted

CLASSES = ("road", "crosswalk", "lane_mark", "other")


def posterior_of(rows: list[tuple[float, ...]]) -> np.ndarray:
    return np.array(rows).T[:, None, :]


def test_marks_that_are_always_second_are_decided_for() -> None:
    """A mark has 0.3 where it is one and 0.05 where it is none: any weight above 2.3 parts them."""
    rows = [(0.7, 0.0, 0.3, 0.0)] * 5 + [(0.95, 0.0, 0.05, 0.0)] * 95
    truth = np.array([[2] * 5 + [0] * 95])
    posterior = posterior_of(rows)
    weights = fit_decision(posterior, truth, CLASSES)
    assert 0.7 / 0.3 < weights["lane_mark"] < 0.95 / 0.05
    chosen = weighted(posterior, CLASSES, weights).argmax(axis=0)
    assert (chosen == truth).all()
    assert weights["crosswalk"] == 1.0  # nothing speaks for another


def test_good_probabilities_keep_their_weights() -> None:
    rows = [(0.9, 0.05, 0.05, 0.0)] * 50 + [(0.1, 0.0, 0.9, 0.0)] * 5 + [(0.1, 0.9, 0.0, 0.0)] * 5
    truth = np.array([[0] * 50 + [2] * 5 + [1] * 5])
    assert fit_decision(posterior_of(rows), truth, CLASSES) == {"crosswalk": 1.0, "lane_mark": 1.0}


@pytest.mark.parametrize("truth_value", [NO_TRUTH, 3])
def test_a_truth_without_these_classes_teaches_nothing(truth_value: int) -> None:
    posterior = posterior_of([(0.4, 0.2, 0.2, 0.2)] * 4)
    weights = fit_decision(posterior, np.full((1, 4), truth_value), CLASSES)
    assert weights == {}
    assert (weighted(posterior, CLASSES, weights) == posterior).all()
