"""The confusion matrix that a simulated network has unless another is given: assumed, not measured.

Recipe of ``confusions/simulated.json``: recalls and confusions in percent as one expects
of a network with 19 labels and a mean IoU of 60 to 70 percent (Paz et al. 2020 report
68.3): large areas are nearly always right, thin things (marks, kerbs, poles) are lost to
what surrounds them, and what looks alike is confused. No network was run for it. A row
weighs as much as its label is seen in street images, by the orders of magnitude below.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.confusion import ConfusionMatrix

LABEL_SET: Final = "paz2020"

SOURCE: Final = (
    "Assumed, not measured: what one expects of a network with these 19 labels and a mean IoU of "
    "60 to 70 percent. The simulated segmenter makes its errors by it unless another is given."
)

_PIXELS: Final = 100_000_000
"""That the image shares of the rows are taken of; divisible enough for whole counts."""

_ROWS: Final[Mapping[str, tuple[float, Mapping[str, float]]]] = {
    # label: percent of the pixels of street images; of those, percent taken for others
    "curb": (0.6, {"road": 18, "sidewalk": 16, "vegetation": 5, "lane marking": 1.5}),
    "crosswalk": (0.6, {"road": 18, "lane marking": 12, "sidewalk": 1.5, "curb": 0.5}),
    "road": (
        22.0,
        {
            "lane marking": 1.0,
            "sidewalk": 0.8,
            "crosswalk": 0.3,
            "curb": 0.3,
            "vegetation": 0.3,
            "car": 0.3,
            "manhole": 0.05,
        },
    ),
    "sidewalk": (
        4.0,
        {
            "road": 12,
            "vegetation": 5,
            "curb": 3,
            "building": 2,
            "crosswalk": 1,
            "car": 0.5,
            "lane marking": 0.3,
        },
    ),
    "building": (
        15.0,
        {
            "vegetation": 4,
            "sky": 1.2,
            "pole": 0.8,
            "car": 0.5,
            "traffic sign": 0.4,
            "sidewalk": 0.4,
        },
    ),
    "person": (
        0.4,
        {
            "building": 7,
            "vegetation": 4,
            "bicyclist": 3,
            "car": 2.5,
            "pole": 1.5,
            "sidewalk": 1.5,
            "road": 1.5,
        },
    ),
    "bicyclist": (
        0.1,
        {
            "person": 14,
            "bicycle": 8,
            "vegetation": 5,
            "building": 4,
            "motorcyclist": 3,
            "car": 2,
            "road": 1,
        },
    ),
    "motorcyclist": (
        0.05,
        {"person": 12, "motorcycle": 12, "bicyclist": 9, "car": 5, "building": 3, "road": 1},
    ),
    "lane marking": (
        1.5,
        {"road": 30, "crosswalk": 4, "sidewalk": 1, "curb": 0.7, "vegetation": 0.3},
    ),
    "sky": (27.0, {"vegetation": 0.8, "building": 0.6, "pole": 0.2}),
    "vegetation": (
        20.0,
        {
            "building": 2.5,
            "sidewalk": 1,
            "sky": 1,
            "road": 0.5,
            "pole": 0.5,
            "curb": 0.3,
            "car": 0.3,
        },
    ),
    "manhole": (0.05, {"road": 45, "lane marking": 3, "crosswalk": 1}),
    "pole": (1.0, {"building": 18, "vegetation": 16, "sky": 6, "traffic sign": 3}),
    "traffic sign": (0.5, {"building": 12, "vegetation": 7, "pole": 6, "sky": 3}),
    "bicycle": (
        0.1,
        {
            "vegetation": 8,
            "building": 8,
            "bicyclist": 6,
            "sidewalk": 5,
            "motorcycle": 5,
            "person": 3,
            "road": 3,
        },
    ),
    "bus": (0.5, {"truck": 7, "building": 6, "car": 6, "vegetation": 2}),
    "car": (
        5.5,
        {
            "truck": 1.2,
            "building": 1.2,
            "vegetation": 1.2,
            "road": 1.2,
            "bus": 0.3,
            "sidewalk": 0.2,
        },
    ),
    "motorcycle": (0.1, {"car": 9, "bicycle": 7, "building": 6, "person": 3, "road": 3}),
    "truck": (0.6, {"car": 11, "building": 8, "bus": 7, "vegetation": 3}),
}


def assumed_confusion() -> ConfusionMatrix:
    """The matrix, made from the recipe; `ConfusionMatrix.load("simulated")` is the same."""
    labels = load_label_set(LABEL_SET)
    counts = np.zeros((len(labels), len(labels)), dtype=np.int64)
    for label, (share, confused) in _ROWS.items():
        pixels, row = share / 100 * _PIXELS, labels.id_of(label)
        for other, percent in confused.items():
            counts[row, labels.id_of(other)] = round(pixels * percent / 100)
        counts[row, row] = round(pixels) - counts[row].sum()
    return ConfusionMatrix(labels, labels, counts, SOURCE)
