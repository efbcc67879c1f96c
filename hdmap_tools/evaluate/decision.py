"""Which class to decide for: the most probable one is best for the share of right cells, not for IoU.

A lane mark found is worth more to its IoU than a road cell lost is to the road's: marks are
one cell in a hundred. The class with the largest weight times probability is decided for,
with weights that did best on another drive. Probabilities stay as they are.
Source: Koyejo, Natarajan, Ravikumar, Dhillon, Consistent Binary Classification with
Generalized Performance Metrics, 2014: the best decision for IoU is a threshold on the probability.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np

from hdmap_tools.compare.paper import EVALUATED, NO_TRUTH
from hdmap_tools.labels.label_set import MapClass
from hdmap_tools.types import NDArrayFloat, NDArrayInt

WEIGHTS: Final = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.7, 8.0, 11.3, 16.0)
"""What is tried, for crosswalk and for lane mark."""


def fit_decision(
    posterior: NDArrayFloat, truth: NDArrayInt, classes: Sequence[str]
) -> dict[str, float]:
    """Weights of crosswalk and lane mark that give the largest mIoU of road, crosswalk, lane mark.

    Args:
        posterior: (class, y, x), NaN where unknown.
        truth: (y, x) index into classes, negative where nothing is known.
        classes: Of the posterior.
    """
    use = np.isfinite(posterior).all(axis=0) & (truth != NO_TRUTH)
    p, t = posterior[:, use].astype(np.float64), truth[use]
    at = [list(classes).index(str(c)) for c in EVALUATED]
    # Of classes that this truth does not have nothing can be learned.
    at = [k for k in at if (t == k).any()]
    best: tuple[float, dict[str, float]] = (-1.0, {})
    if not at:
        return best[1]
    for crosswalk, mark in itertools.product(WEIGHTS, WEIGHTS):
        weights = {str(MapClass.CROSSWALK): crosswalk, str(MapClass.LANE_MARK): mark}
        chosen = weighted(p, classes, weights).argmax(axis=0)
        ious = [((chosen == k) & (t == k)).sum() / ((chosen == k) | (t == k)).sum() for k in at]
        # Ties go to the weights nearest to 1, which change least.
        score = float(np.mean(ious)) - 1e-6 * (abs(np.log(crosswalk)) + abs(np.log(mark)))
        if score > best[0]:
            best = score, weights
    return best[1]


def weighted(
    posterior: NDArrayFloat, classes: Sequence[str], weights: dict[str, float]
) -> NDArrayFloat:
    """(class, ...) probabilities times the weights of their classes; those without one have 1."""
    factors = np.array([weights.get(str(name), 1.0) for name in classes])
    return np.asarray(posterior * factors.reshape(-1, *[1] * (posterior.ndim - 1)))
