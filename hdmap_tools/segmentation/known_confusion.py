"""The confusion matrix that came with a network, in its file or beside its label images."""

from __future__ import annotations

from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.network import NetworkSegmenter
from hdmap_tools.segmentation.precomputed import PrecomputedSegmenter
from hdmap_tools.segmentation.segmenter import Segmenter


def confusion_of(segmenter: Segmenter) -> ConfusionMatrix | None:
    """The matrix that came with a segmenter, or None.

    That of the simulated network is what it errs by, not what is known of it: a map of it
    is read with the matrix known by its name.
    """
    if isinstance(segmenter, NetworkSegmenter | PrecomputedSegmenter):
        return segmenter.confusion
    return None
