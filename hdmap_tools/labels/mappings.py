"""Which label sets can be brought onto which."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Final

from hdmap_tools.errors import LabelError
from hdmap_tools.labels import street
from hdmap_tools.labels.camvid import CAMVID, CAMVID_32, CAMVID_32_TO_PAZ2020, CAMVID_TO_PAZ2020
from hdmap_tools.labels.cityscapes import (
    CITYSCAPES,
    CITYSCAPES_IDS,
    CITYSCAPES_IDS_TO_PAZ2020,
    CITYSCAPES_TO_PAZ2020,
)
from hdmap_tools.labels.label_mapping import LabelMapping, identity_mapping
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.labels.street import STREET
from hdmap_tools.labels.vistas import PAZ2020, VISTAS, VISTAS_TO_PAZ2020
from hdmap_tools.labels.vistas_v2 import VISTAS_V2, VISTAS_V2_TO_PAZ2020

_FATES: Final[Mapping[tuple[str, str], Mapping[str, str | None]]] = {
    (VISTAS, PAZ2020): VISTAS_TO_PAZ2020,
    (VISTAS, STREET): street.VISTAS_TO_STREET,
    (VISTAS_V2, PAZ2020): VISTAS_V2_TO_PAZ2020,
    (VISTAS_V2, STREET): street.VISTAS_V2_TO_STREET,
    (CITYSCAPES_IDS, PAZ2020): CITYSCAPES_IDS_TO_PAZ2020,
    (CITYSCAPES_IDS, STREET): street.CITYSCAPES_IDS_TO_STREET,
    (CITYSCAPES, PAZ2020): CITYSCAPES_TO_PAZ2020,
    (CITYSCAPES, STREET): street.CITYSCAPES_TO_STREET,
    (CAMVID, PAZ2020): CAMVID_TO_PAZ2020,
    (CAMVID, STREET): street.CAMVID_TO_STREET,
    (CAMVID_32, PAZ2020): CAMVID_32_TO_PAZ2020,
    (CAMVID_32, STREET): street.CAMVID_32_TO_STREET,
    (PAZ2020, STREET): street.PAZ2020_TO_STREET,
}


def known_mappings() -> tuple[tuple[str, str], ...]:
    """Names (source set, target set) of all shipped mappings."""
    return tuple(sorted(_FATES))


@lru_cache
def shipped_mapping(source: str, target: str) -> LabelMapping:
    """The shipped mapping between two shipped label sets.

    Raises:
        LabelError: If there is none; the message lists those that there are.
    """
    try:
        fates = _FATES[source, target]
    except KeyError:
        known = ", ".join(f"{a} -> {b}" for a, b in known_mappings())
        raise LabelError(
            f"No mapping from label set {source!r} to {target!r} is known; there are {known}."
        ) from None
    return LabelMapping(load_label_set(source), load_label_set(target), fates)


def mapping_to(source: LabelSet, target: str | LabelSet) -> LabelMapping:
    """How a label set is brought onto another: a shipped mapping, or none if they are the same.

    A set that has a shipped set's name must have its labels too.

    Raises:
        LabelError: If there is no such mapping, or the names fit and the labels do not.
    """
    wanted = load_label_set(target) if isinstance(target, str) else target
    if source.names == wanted.names:
        return identity_mapping(wanted)
    mapping = shipped_mapping(source.name, wanted.name)
    for given, shipped in ((source, mapping.source), (wanted, mapping.target)):
        if given.names != shipped.names:
            raise LabelError(
                f"A label set calls itself {given.name!r} but has other labels than the shipped "
                "set of that name; give it a name of its own."
            )
    return mapping
