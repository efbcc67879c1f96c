"""The paper's 19 labels brought down to the eleven of `street`, for a small network."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

STREET: Final = "street"

PAZ2020_TO_STREET: Final[Mapping[str, str | None]] = MappingProxyType(
    {
        "curb": "curb",
        "crosswalk": "crosswalk",
        "road": "road",
        "sidewalk": "sidewalk",
        "building": "building",
        "person": "person",
        "bicyclist": "person",
        "motorcyclist": "person",
        "lane marking": "lane marking",
        "sky": "sky",
        "vegetation": "vegetation",
        "manhole": "road",
        "pole": "pole",
        "traffic sign": "pole",
        "bicycle": "vehicle",
        "bus": "vehicle",
        "car": "vehicle",
        "motorcycle": "vehicle",
        "truck": "vehicle",
    }
)
"""The fate of every label of ``paz2020``; none is dropped.

Kinds that the map reads alike become one: a manhole cover is driven on, all that
moves hides the ground, and a sign is part of what stands at the roadside on a pole.
"""
