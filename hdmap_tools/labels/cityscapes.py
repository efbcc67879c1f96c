"""Cityscapes' labels brought onto the paper's 19 and onto `street`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

CITYSCAPES_IDS: Final = "cityscapes-ids"
CITYSCAPES: Final = "cityscapes"

CITYSCAPES_IDS_TO_PAZ2020: Final[Mapping[str, str | None]] = MappingProxyType(
    {
        "unlabeled": None,
        "ego vehicle": None,
        "rectification border": None,
        "out of roi": None,
        "static": None,
        "dynamic": None,
        "ground": None,
        "road": "road",
        "sidewalk": "sidewalk",
        "parking": None,
        "rail track": None,
        "building": "building",
        "wall": None,
        "fence": None,
        "guard rail": None,
        "bridge": "building",
        "tunnel": None,
        "pole": "pole",
        "polegroup": "pole",
        "traffic light": None,
        "traffic sign": "traffic sign",
        "vegetation": "vegetation",
        "terrain": "vegetation",
        "sky": "sky",
        "person": "person",
        "rider": None,
        "car": "car",
        "truck": "truck",
        "bus": "bus",
        "caravan": None,
        "trailer": None,
        "train": None,
        "motorcycle": "motorcycle",
        "bicycle": "bicycle",
    }
)
"""The fate of every label of ``cityscapes-ids``, by what the paper does with Vistas' like of it.

A rider may sit on a bicycle or a motorcycle, which ``paz2020`` parts: dropped. Cityscapes
has no paint, no crosswalks and no kerbs: its road includes the paint, its sidewalk the
kerb. A network that learns from it alone never answers with them, and one that learns from
it beside other data is told that paint is road: give it a small share, or none.
"""

CITYSCAPES_TO_PAZ2020: Final[Mapping[str, str | None]] = MappingProxyType(
    {
        name: CITYSCAPES_IDS_TO_PAZ2020[name]
        for name in (
            *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light"),
            *("traffic sign", "vegetation", "terrain", "sky", "person", "rider", "car"),
            *("truck", "bus", "train", "motorcycle", "bicycle"),
        )
    }
)
"""The same of the 19 training labels, ``cityscapes``."""
