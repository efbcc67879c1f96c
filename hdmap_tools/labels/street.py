"""Labels brought down to the eleven of `street`, for a small network."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from hdmap_tools.labels.camvid import CAMVID_32_TO_PAZ2020, CAMVID_TO_PAZ2020
from hdmap_tools.labels.cityscapes import CITYSCAPES_IDS_TO_PAZ2020, CITYSCAPES_TO_PAZ2020
from hdmap_tools.labels.vistas import VISTAS_TO_PAZ2020
from hdmap_tools.labels.vistas_v2 import VISTAS_V2_TO_PAZ2020

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

_VISTAS_BEYOND_THE_PAPER: Final[Mapping[str, str]] = {
    "construction--flat--bike-lane": "road",
    "construction--flat--parking": "road",
    "construction--flat--service-lane": "road",
    "construction--flat--pedestrian-area": "sidewalk",
    "construction--flat--curb-cut": "curb",
    "construction--structure--tunnel": "building",
    "object--catch-basin": "road",
    "object--pothole": "road",
    "object--street-light": "pole",
    "object--support--traffic-sign-frame": "pole",
    "object--support--utility-pole": "pole",
    "object--vehicle--caravan": "vehicle",
    "object--vehicle--on-rails": "vehicle",
    "object--vehicle--other-vehicle": "vehicle",
    "object--vehicle--trailer": "vehicle",
    "object--vehicle--wheeled-slow": "vehicle",
}

_VISTAS_V2_BEYOND_THE_PAPER: Final[Mapping[str, str]] = {
    **_VISTAS_BEYOND_THE_PAPER,
    "construction--flat--parking-aisle": "road",
    "construction--flat--road-shoulder": "road",
    "marking--discrete--ambiguous": "lane marking",
    "object--traffic-light--cyclists": "pole",
    "object--traffic-light--general-horizontal": "pole",
    "object--traffic-light--general-single": "pole",
    "object--traffic-light--general-upright": "pole",
    "object--traffic-light--other": "pole",
    "object--traffic-light--pedestrians": "pole",
    "object--traffic-sign--ambiguous": "pole",
    "object--vehicle--vehicle-group": "vehicle",
    "object--water-valve": "road",
}

_CITYSCAPES_BEYOND_THE_PAPER: Final[Mapping[str, str]] = {
    "parking": "road",
    "tunnel": "building",
    "traffic light": "pole",
    "rider": "person",
    "caravan": "vehicle",
    "trailer": "vehicle",
    "train": "vehicle",
}


def _through_paz2020(
    to_paz2020: Mapping[str, str | None], beyond: Mapping[str, str]
) -> Mapping[str, str | None]:
    """Onto street as by way of ``paz2020``, and what that drops, where street has a place for it."""
    fates = {
        name: beyond.get(name) if fate is None else PAZ2020_TO_STREET[fate]
        for name, fate in to_paz2020.items()
    }
    return MappingProxyType(fates)


VISTAS_TO_STREET: Final = _through_paz2020(
    VISTAS_TO_PAZ2020, {**_VISTAS_BEYOND_THE_PAPER, "object--traffic-light": "pole"}
)
"""The fate of every label of Vistas, version 1.

What the paper drops, though the map has a place for it, is kept here: other pavement
that is driven on is road, utility poles, lamps and traffic lights are pole.
"""

VISTAS_V2_TO_STREET: Final = _through_paz2020(VISTAS_V2_TO_PAZ2020, _VISTAS_V2_BEYOND_THE_PAPER)
"""The fate of every label of Vistas, version 2.0."""

CITYSCAPES_IDS_TO_STREET: Final = _through_paz2020(
    CITYSCAPES_IDS_TO_PAZ2020, _CITYSCAPES_BEYOND_THE_PAPER
)
"""The fate of every label of ``cityscapes-ids``; riders are person, whatever they ride."""

CITYSCAPES_TO_STREET: Final = _through_paz2020(CITYSCAPES_TO_PAZ2020, _CITYSCAPES_BEYOND_THE_PAPER)
"""The fate of every label of ``cityscapes``."""

CAMVID_TO_STREET: Final = _through_paz2020(CAMVID_TO_PAZ2020, {})
"""The fate of every label of ``camvid-11``; fences have no place."""

CAMVID_32_TO_STREET: Final = _through_paz2020(
    CAMVID_32_TO_PAZ2020,
    {
        "OtherMoving": "vehicle",
        "TrafficLight": "pole",
        "Train": "vehicle",
        "Truck_Bus": "vehicle",
        "Tunnel": "building",
    },
)
"""The fate of every label of ``camvid-32``."""
