"""CamVid's labels, in the eleven classes of SegNet, brought onto the paper's 19 and `street`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

CAMVID: Final = "camvid-11"
CAMVID_VOID_ID: Final = 11
"""In the label images: not one of the eleven classes."""

CAMVID_TO_PAZ2020: Final[Mapping[str, str | None]] = MappingProxyType(
    {
        "sky": "sky",
        "building": "building",
        "pole": "pole",
        "road": "road",
        "pavement": "sidewalk",
        "tree": "vegetation",
        "sign symbol": "traffic sign",
        "fence": None,
        "car": "car",
        "pedestrian": "person",
        "bicyclist": "bicyclist",
    }
)
"""The fate of every label of ``camvid-11``.

Its classes are wider than the names they get: car holds lorries and buses too, building
walls and bridges, sign symbol traffic lights, bicyclist motorcyclists and the cycles
themselves. Road includes the paint, as in Cityscapes.
"""
