"""A score more or less for each label, so that labels are neither said too often nor too seldom.

A network that was trained with weights for rare labels says these too often. What each
label's score must be raised or lowered by for the best mean IoU is found on the validation
images, and becomes part of the last convolution: the network costs no more for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
import torch
from torch import nn

from hdmap_tools.labels.label_set import IGNORE_ID
from hdmap_tools.segmentation.training.augmentation import Augmentation
from hdmap_tools.segmentation.training.image_pairs import ImagePairs
from hdmap_tools.segmentation.training.validation import normalized
from hdmap_tools.types import NDArrayFloat, NDArrayFloat32, NDArrayInt

_STEP_PX: Final = 5
"""Every so many rows and columns are looked at; which ones changes from image to image."""
_STEPS: Final = (-0.8, -0.4, -0.2, 0.2, 0.4, 0.8)
_ROUNDS: Final = 3
_LEAST_GAIN: Final = 1e-5


def sampled_scores(
    model: nn.Module,
    pairs: ImagePairs,
    indices: Iterable[int],
    augmentation: Augmentation,
    device: torch.device,
) -> tuple[NDArrayFloat32, NDArrayInt]:
    """Scores (N, labels) and true ids (N,) of the labelled pixels of a coarse lattice.

    Args:
        model: Gives logits at the input's size; is left in evaluation mode.
        pairs: Images and labels.
        indices: Which of them.
        augmentation: Only its normalization is used.
        device: Where the model is.
    """
    scores, truth = [], []
    model.eval()
    with torch.inference_mode():
        for number, index in enumerate(indices):
            rgb, ids = pairs.read(index)
            logits = model(normalized(rgb, augmentation).to(device))[0].float().cpu().numpy()
            row, column = number % _STEP_PX, number // _STEP_PX % _STEP_PX
            found = ids[row::_STEP_PX, column::_STEP_PX].ravel()
            picked = logits[:, row::_STEP_PX, column::_STEP_PX].reshape(len(logits), -1).T
            known = found != IGNORE_ID
            # Half the memory; a thousandth of a score decides nothing.
            scores.append(picked[known].astype(np.float16))
            truth.append(found[known])
    return np.concatenate(scores), np.concatenate(truth).astype(np.int64)


def fit_offsets(scores: NDArrayFloat32, truth: NDArrayInt) -> NDArrayFloat:
    """Offsets (labels,) of the scores that raise the mean IoU, found one label after the other.

    Args:
        scores: (N, labels).
        truth: (N,) true ids; labels that are not there stay as they are.
    """
    num_labels = scores.shape[1]
    there = np.flatnonzero(np.bincount(truth, minlength=num_labels))
    offsets = np.zeros(num_labels)
    best = _mean_iou(scores, truth, there)
    for _ in range(_ROUNDS):
        before = best
        for label in there:
            for step in _STEPS:
                tried = offsets.copy()
                tried[label] += step
                iou = _mean_iou(scores + tried.astype(np.float32), truth, there)
                if iou > best + _LEAST_GAIN:
                    best, offsets = iou, tried
        if best - before < _LEAST_GAIN:
            break
    return offsets


def _mean_iou(scores: NDArrayFloat32, truth: NDArrayInt, there: NDArrayInt) -> float:
    num_labels = scores.shape[1]
    counts = np.bincount(truth * num_labels + scores.argmax(axis=1), minlength=num_labels**2)
    counts = counts.reshape(num_labels, num_labels)
    hits = counts.diagonal()
    either = counts.sum(axis=0) + counts.sum(axis=1) - hits
    return float((hits[there] / either[there]).mean())
