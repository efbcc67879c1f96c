"""Mapillary Vistas' 66 labels reduced to the paper's 19: what its network is trained and judged on."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Final

import numpy as np

from hdmap_tools.errors import LabelError
from hdmap_tools.labels.label_mapping import LabelMapping
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.types import NDArrayByte

VISTAS: Final = "mapillary-vistas-66"
PAZ2020: Final = "paz2020"

VISTAS_TO_PAZ2020: Final[Mapping[str, str | None]] = MappingProxyType(
    {
        "animal--bird": None,
        "animal--ground-animal": None,
        "construction--barrier--curb": "curb",
        "construction--barrier--fence": None,
        "construction--barrier--guard-rail": None,
        "construction--barrier--other-barrier": None,
        "construction--barrier--wall": None,
        "construction--flat--bike-lane": None,
        "construction--flat--crosswalk-plain": "crosswalk",
        "construction--flat--curb-cut": None,
        "construction--flat--parking": None,
        "construction--flat--pedestrian-area": None,
        "construction--flat--rail-track": None,
        "construction--flat--road": "road",
        "construction--flat--service-lane": None,
        "construction--flat--sidewalk": "sidewalk",
        "construction--structure--bridge": "building",
        "construction--structure--building": "building",
        "construction--structure--tunnel": None,
        "human--person": "person",
        "human--rider--bicyclist": "bicyclist",
        "human--rider--motorcyclist": "motorcyclist",
        "human--rider--other-rider": "person",
        "marking--crosswalk-zebra": "crosswalk",
        "marking--general": "lane marking",
        "nature--mountain": None,
        "nature--sand": None,
        "nature--sky": "sky",
        "nature--snow": None,
        "nature--terrain": "vegetation",
        "nature--vegetation": "vegetation",
        "nature--water": None,
        "object--banner": None,
        "object--bench": None,
        "object--bike-rack": None,
        "object--billboard": None,
        "object--catch-basin": None,
        "object--cctv-camera": None,
        "object--fire-hydrant": None,
        "object--junction-box": None,
        "object--mailbox": None,
        "object--manhole": "manhole",
        "object--phone-booth": None,
        "object--pothole": None,
        "object--street-light": None,
        "object--support--pole": "pole",
        "object--support--traffic-sign-frame": None,
        "object--support--utility-pole": None,
        "object--traffic-light": None,
        "object--traffic-sign--back": "traffic sign",
        "object--traffic-sign--front": "traffic sign",
        "object--trash-can": None,
        "object--vehicle--bicycle": "bicycle",
        "object--vehicle--boat": None,
        "object--vehicle--bus": "bus",
        "object--vehicle--car": "car",
        "object--vehicle--caravan": None,
        "object--vehicle--motorcycle": "motorcycle",
        "object--vehicle--on-rails": None,
        "object--vehicle--other-vehicle": None,
        "object--vehicle--trailer": None,
        "object--vehicle--truck": "truck",
        "object--vehicle--wheeled-slow": None,
        "void--car-mount": None,
        "void--ego-vehicle": None,
        "void--unlabeled": None,
    }
)
"""The fate of every Vistas label: a label of ``paz2020``, or None for dropped.

Source: Paz et al. 2020, on its training data: terrain joins vegetation, riders
without a label of their own join person, front and back of a sign become one,
bridge joins building, all crosswalks become one, what is not needed is dropped.
Labels that the paper does not name (utility pole, bike lane, parking) are
dropped, not guessed at.
"""


def remap_vistas_to_paz2020(
    label_image: NDArrayByte, what: str = "The Vistas label image"
) -> NDArrayByte:
    """Turn a Vistas label image into one of the paper's 19 labels.

    Args:
        label_image: (H, W) uint8, ids of ``mapillary-vistas-66`` or 255.
        what: Names the image in messages.

    Returns:
        (H, W) uint8, ids of ``paz2020``; 255 (ignore) where the label is dropped.

    Raises:
        LabelError: If the image is not uint8, or holds an id that Vistas has not.
    """
    label_image = np.asarray(label_image)
    if label_image.dtype != np.uint8:
        raise LabelError(
            f"{what} holds {label_image.dtype}, expected uint8 ids; of a 16-bit instance image "
            "take value // 256 first."
        )
    return _mapping().apply(label_image, what)


@lru_cache
def _mapping() -> LabelMapping:
    return LabelMapping(load_label_set(VISTAS), load_label_set(PAZ2020), VISTAS_TO_PAZ2020)
