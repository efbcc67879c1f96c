"""Weights of the labels in the loss: what is rare shall not be learned last."""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.segmentation.training.image_pairs import ImagePairs
from hdmap_tools.types import NDArrayFloat

_MAX_SAMPLES: Final = 200


def class_weights(pairs: ImagePairs, power: float, seed: int) -> NDArrayFloat:
    """Weight (labels,) of each: its share of the pixels to minus the power.

    Scaled so that the mean over pixels is 1, which keeps the loss comparable between
    powers. A label that no sampled mask holds counts as the rarest that one does.

    Args:
        pairs: Of these, at most 200 masks are counted.
        power: 0 weighs all alike, 1 gives each label the same say.
        seed: Chooses the masks.
    """
    size = len(pairs.label_set)
    if power == 0:
        return np.ones(size)
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(pairs))[:_MAX_SAMPLES]
    counts = np.zeros(256)
    for index in chosen:
        counts += np.bincount(pairs.read(int(index))[1].ravel(), minlength=256)
    counts = counts[:size]
    if not counts.any():
        return np.ones(size)
    shares = np.maximum(counts, counts[counts > 0].min()) / counts.sum()
    weights: NDArrayFloat = shares**-power
    weights /= (weights * counts).sum() / counts.sum()
    return weights
