"""Elements and map metadata as plain documents, shared by the formats that have attributes."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

import numpy as np
import shapely
from pydantic import ValidationError
from shapely.geometry.base import BaseGeometry

from hdmap_tools.errors import FormatError, HDMapError, brief_problems
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.types import NDArrayFloat

METADATA_VERSION: Final = 1
"""Of the document that carries frame and provenance; a higher one is refused."""

MAX_LISTED_IDS: Final = 20
"""How many ids of skipped things are kept beside their count."""

MAX_LISTED_CHARACTERS: Final = 120
"""Of the kinds of skipped things in a warning."""


class Skipped:
    """Counts what a reader leaves out, by kind, and keeps the first ids of each."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.ids: dict[str, list[str]] = {}

    def add(self, kind: str, identifier: object) -> None:
        """Count one thing of that kind."""
        self.counts[kind] = self.counts.get(kind, 0) + 1
        listed = self.ids.setdefault(kind, [])
        if len(listed) < MAX_LISTED_IDS:
            listed.append(str(identifier))

    def to_provenance(self) -> dict[str, Any]:
        """``skipped`` (counts by kind) and, where any, ``skipped_ids``."""
        found: dict[str, Any] = {"skipped": dict(sorted(self.counts.items()))}
        if self.ids:
            found["skipped_ids"] = dict(sorted(self.ids.items()))
        return found

    def log(self, logger: logging.Logger, source: str) -> None:
        """Warn of it in one short line, if there is anything; all of it is for who asks."""
        if self.counts:
            logger.warning(
                "%s: skipped %s (-v or info --json lists them).",
                source,
                brief_counts(self.counts, MAX_LISTED_CHARACTERS),
            )
            logger.info("%s: skipped %s.", source, self.describe())

    def describe(self) -> str:
        """One line: ``3 way:arrow (ids 7, 8, 9), ...``."""
        return ", ".join(
            f"{count} {kind} ({', '.join(self.ids[kind][:3])}{', ...' if count > 3 else ''})"
            for kind, count in sorted(self.counts.items())
        )


def brief_counts(counts: Mapping[str, int], max_characters: int) -> str:
    """Counts by the first part of their kind, largest first: ``38 way, 19 node, ...``."""
    groups: Counter[str] = Counter()
    for kind, count in counts.items():
        groups[kind.partition(":")[0]] += count
    parts = [f"{n} {kind}" for kind, n in sorted(groups.items(), key=lambda g: (-g[1], g[0]))]
    text = ", ".join(parts)
    while len(text) > max_characters and len(parts) > 1:
        parts.pop()
        text = ", ".join([*parts, "..."])
    return text


def map_geometry(
    geometry: BaseGeometry, change: Callable[[NDArrayFloat], NDArrayFloat]
) -> BaseGeometry:
    """The geometry with its (N, 3) coordinates changed."""
    return shapely.transform(geometry, change, include_z=True)


def element_fields(element: MapElement) -> dict[str, Any]:
    """All attributes but the geometry, JSON-like, in the order of the model."""
    return element.model_dump(mode="json", exclude={"geometry"})


def element_from_fields(
    element_type: type[MapElement], fields: Mapping[str, Any], geometry: BaseGeometry, name: str
) -> MapElement:
    """An element of what `element_fields` gave; fields the model does not have are left out.

    Raises:
        FormatError: If it is not a valid element; the message starts with ``name``.
    """
    known = {k: v for k, v in fields.items() if k in element_type.model_fields and k != "geometry"}
    try:
        return element_type.model_validate({**known, "geometry": geometry})
    except ValidationError as error:
        raise FormatError(
            f"{name} is not a valid {element_type.element_type}: {brief_problems(error)}."
        ) from error


def dump_metadata(vector_map: VectorMap) -> str:
    """Frame and provenance as one line of JSON with sorted keys.

    Raises:
        FormatError: If the provenance is not JSON-like.
    """
    document = {
        "format_version": METADATA_VERSION,
        "frame": vector_map.frame.to_json(),
        "provenance": vector_map.provenance,
    }
    try:
        return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise FormatError(f"The map's provenance cannot be written as JSON: {error}.") from error


def parse_metadata(text: str | Mapping[str, Any], source: str) -> tuple[MapFrame, dict[str, Any]]:
    """Frame and provenance of what `dump_metadata` gave.

    Raises:
        FormatError: If it is damaged or from a newer version.
    """
    try:
        document = json.loads(text) if isinstance(text, str) else text
        version = document["format_version"]
        if not isinstance(version, int) or version > METADATA_VERSION:
            raise FormatError(
                f"{source} has metadata version {version}, this program reads up to "
                f"{METADATA_VERSION}; update hdmap-tools."
            )
        frame = MapFrame.from_json(document["frame"])
        if frame.is_georeferenced:
            _ = frame.crs
        return frame, dict(document["provenance"])
    except HDMapError:
        raise
    except Exception as error:  # pyproj raises many kinds for a damaged CRS
        raise FormatError(
            f"{source} has damaged hdmap_tools metadata ({type(error).__name__}: {error}); "
            "expected frame and provenance as written by this program."
        ) from error


def frame_around(lon_lat: NDArrayFloat) -> MapFrame:
    """A frame with its origin, height 0, in the middle of (N, 2+) longitudes and latitudes."""
    if len(lon_lat) == 0:
        return MapFrame()
    lon, lat = lon_lat[:, 0], lon_lat[:, 1]
    if np.ptp(lon) > 180.0:  # across the antimeridian
        lon = np.where(lon < 0.0, lon + 360.0, lon)
    middle = (lon.min() + lon.max()) / 2.0
    return MapFrame.from_origin(
        round(float(lat.min() + lat.max()) / 2.0, 7),
        round(float((middle + 180.0) % 360.0 - 180.0), 7),
    )


def require_same_elements(
    expected: VectorMap, found: VectorMap, tolerance_m: float, source: str
) -> None:
    """Raise `FormatError` unless both maps hold the same elements at the same places."""

    def key(elements: Iterable[MapElement]) -> list[tuple[str, str]]:
        return [(e.element_type, e.id) for e in elements]

    if key(expected) != key(found):
        lost = sorted(set(key(expected)) ^ set(key(found)))[:3]
        raise FormatError(f"{source} did not come back as it was written: {lost} differ.")
    for before, after in zip(expected, found, strict=True):
        a = shapely.get_coordinates(before.geometry, include_z=True)
        b = shapely.get_coordinates(after.geometry, include_z=True)
        if a.shape != b.shape or np.abs(a - b).max() > tolerance_m:
            raise FormatError(
                f"{source}: the geometry of {before.element_type} {before.id!r} did not come back "
                f"within {tolerance_m} m."
            )
        if element_fields(before) != element_fields(after):
            raise FormatError(
                f"{source}: the attributes of {before.element_type} {before.id!r} did not come back "
                "as they were written; remove unusual characters from them."
            )
