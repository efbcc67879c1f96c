"""One minus the soft overlap of prediction and truth: what is thin counts as much as what is large."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

from hdmap_tools.labels.label_set import IGNORE_ID


def overlap_loss(logits: Tensor, ids: Tensor) -> Tensor:
    """Mean of 1 - Dice over the labels that the batch holds.

    Dice is 2 * sum(p * t) / (sum(p) + sum(t)) over all judged pixels of the batch, with the
    probabilities p and the truth t, 0 or 1 (Milletari et al. 2016, V-Net).

    Args:
        logits: (N, labels, H, W).
        ids: (N, H, W) int64; `IGNORE_ID` is not judged. One pixel at least is.
    """
    judged = ids != IGNORE_ID
    target = ids.masked_fill(~judged, 0)
    probability = functional.softmax(logits, dim=1) * judged.unsqueeze(1)
    num_labels = logits.shape[1]
    right = probability.gather(1, target.unsqueeze(1)).squeeze(1)[judged]
    there = ids[judged]
    overlap = logits.new_zeros(num_labels).index_add(0, there, right)
    true = there.bincount(minlength=num_labels).to(logits.dtype)
    said = probability.sum((0, 2, 3))
    dice = 2 * overlap / (said + true).clamp_min(1e-6)
    return 1 - dice[true > 0].mean()
