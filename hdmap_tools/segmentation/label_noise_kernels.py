"""The inner loops of `label_noise`: how likely each pixel is to be taken for what else."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayByte, NDArrayFloat, NDArrayFloat32

EVERYWHERE = 0.1
BESIDE = 1.0
AROUND = 0.3
"""Weights of a wrong label: anywhere, where the true label beside it is that one, and further around."""


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def _total(
    true: int,
    reach: float,
    beside: NDArrayByte,
    around: NDArrayByte,
    scale: NDArrayFloat,
    likely: NDArrayFloat,
) -> float:
    """Fill how likely each wrong label is for one pixel; gives their sum, at most 1."""
    total = 0.0
    for label in range(scale.shape[1]):
        likely[label] = 0.0
        if scale[true, label] > 0.0:
            weight = EVERYWHERE + (BESIDE * beside[label] + AROUND * around[label]) / 255.0
            likely[label] = scale[true, label] * reach * weight
            total += likely[label]
    if total > 1.0:
        for label in range(scale.shape[1]):
            likely[label] /= total
        total = 1.0
    return total


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def expected_confusion(
    true: NDArrayByte,
    reach: NDArrayFloat32,
    beside: NDArrayByte,
    around: NDArrayByte,
    scale: NDArrayFloat,
) -> NDArrayFloat:
    """(T, P) expected number of pixels of each true label taken for each wrong one.

    Args:
        true: (N,) true ids; 255 is left out.
        reach: (N,) factor of each pixel's error rate.
        beside: (N, P) 0..255, whether other true labels are within a few pixels.
        around: (N, P) 0..255, whether they are within some twenty.
        scale: (T, P) what the weights are multiplied with.
    """
    sums = np.zeros(scale.shape)
    likely = np.zeros(scale.shape[1])
    for i in range(len(true)):
        if true[i] < scale.shape[0]:
            _total(true[i], reach[i], beside[i], around[i], scale, likely)
            sums[true[i]] += likely
    return sums


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def confused(
    true: NDArrayByte,
    reach: NDArrayFloat32,
    beside: NDArrayByte,
    around: NDArrayByte,
    scale: NDArrayFloat,
    whether: NDArrayFloat32,
    which: NDArrayFloat32,
) -> NDArrayByte:
    """(N,) labels drawn for pixels.

    Args:
        true: As in `expected_confusion`.
        reach: The same.
        beside: The same.
        around: The same.
        scale: The same.
        whether: (N,) standard normal: a low value is an error.
        which: (N,) standard normal: chooses among the wrong labels.
    """
    drawn = true.copy()
    likely = np.zeros(scale.shape[1])
    # Most pixels are so far from an error that what lies around them need not be asked.
    most_likely = scale.sum(axis=1) * (EVERYWHERE + BESIDE + AROUND)
    for i in range(len(true)):
        if true[i] >= scale.shape[0]:
            continue
        chance = _uniform(whether[i])
        if chance >= most_likely[true[i]] * reach[i]:
            continue
        total = _total(true[i], reach[i], beside[i], around[i], scale, likely)
        if chance >= total:
            continue
        left = _uniform(which[i]) * total
        for label in range(scale.shape[1]):
            if likely[label] > 0.0:
                drawn[i] = label
                left -= likely[label]
                if left < 0.0:
                    break
    return drawn


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def _uniform(normal: float) -> float:
    return 0.5 * math.erfc(-normal * 0.7071067811865476)
