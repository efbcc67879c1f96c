"""GeoJSON as RFC 7946 has it: longitude, latitude, height; right-hand rule; no CRS member.

Attributes are the feature's properties, with ``element_type`` beside them. Frame and
provenance are a foreign member ``hdmap_tools`` (RFC 7946, section 6.1), so that a map
written here comes back in its own frame.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon, mapping
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from hdmap_tools.errors import CRSMismatchError, FormatError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.formats.records import (
    Skipped,
    dump_metadata,
    element_fields,
    element_from_fields,
    frame_around,
    map_geometry,
    parse_metadata,
    require_same_elements,
)
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MapElement, element_type_by_name
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.types import NDArrayFloat

_log = logging.getLogger(__name__)

DECIMALS: Final = 9
"""Of longitude and latitude: 0.1 mm."""
HEIGHT_DECIMALS: Final = 4
ROUND_TRIP_M: Final = 1e-3


def write_geojson(
    vector_map: VectorMap, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write the map as one FeatureCollection, a feature a line.

    Exterior rings become counter-clockwise and holes clockwise.

    Raises:
        NoOriginError: If the map has no place on earth.
        OutputExistsError: If the file exists and overwrite is False.
        FormatError: If an element cannot be written, for example one smaller than 0.1 mm.
    """
    _ = vector_map.frame.crs
    oriented = VectorMap(
        vector_map.frame, tuple(_oriented(e) for e in vector_map), vector_map.provenance
    )
    lines = [
        json.dumps(_feature(element, vector_map.frame), separators=(",", ":"), allow_nan=False)
        for element in oriented
    ]
    body = ",\n".join(lines)
    text = (
        '{"type":"FeatureCollection",\n'
        f'"hdmap_tools":{dump_metadata(vector_map)},\n'
        f'"features":[\n{body}\n]}}\n'
    )

    def validate(temporary: Path) -> None:
        validate_geojson(_load(temporary), str(path))
        require_same_elements(oriented, read_geojson(temporary), ROUND_TRIP_M, str(path))

    with atomic_output(path, overwrite, validate=validate) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def read_geojson(path: str | os.PathLike[str], frame: MapFrame | None = None) -> VectorMap:
    """Read a FeatureCollection.

    Args:
        path: The file.
        frame: City frame of the result; by default the one in the file, or else one
            with its origin in the middle of the file.

    Returns:
        The map. Features without a known ``element_type`` are skipped, logged and
        counted in ``provenance["skipped"]``; positions without a height get 0.

    Raises:
        FormatError: If the file is not GeoJSON, or one of its elements is not valid.
    """
    source = str(path)
    document = _load(Path(path))
    validate_geojson(document, source)
    provenance: dict[str, Any] = {}
    if "hdmap_tools" in document:
        stored_frame, provenance = parse_metadata(document["hdmap_tools"], source)
        frame = frame or stored_frame
    skipped = Skipped()
    found: list[tuple[type[MapElement], dict[str, Any], BaseGeometry, str]] = []
    for number, feature in enumerate(document["features"]):
        name = f"{source}, feature {feature.get('id', number)!r}"
        properties = feature.get("properties") or {}
        element_type = element_type_by_name(str(properties.get("element_type")))
        geometry = feature.get("geometry")
        if element_type is None:
            skipped.add("feature without a known element_type", feature.get("id", number))
        elif geometry is None or geometry["type"] != element_type.geometry_type:
            kind = "no" if geometry is None else geometry["type"]
            skipped.add(
                f"{element_type.element_type} with {kind} geometry", feature.get("id", number)
            )
        else:
            found.append((element_type, properties, _geometry(geometry), name))
    if frame is None:
        frame = frame_around(
            np.concatenate([shapely.get_coordinates(g) for _, _, g, _ in found])
            if found
            else np.empty((0, 2))
        )
    elements = [
        element_from_fields(t, properties, map_geometry(g, frame.from_wgs84), name)
        for t, properties, g, name in found
    ]
    skipped.log(_log, source)
    if skipped.counts:
        provenance = {**provenance, **skipped.to_provenance()}
    return VectorMap(frame, with_stable_ids(elements), provenance)


def validate_geojson(document: Any, source: str = "GeoJSON") -> None:
    """Raise `FormatError` unless a parsed document follows RFC 7946.

    Checked: a FeatureCollection without ``crs``; known geometry types; positions of two or
    three finite numbers in range; lines of two or more positions; rings closed, of four or more.
    """

    def refuse(what: str) -> None:
        raise FormatError(f"{source} is not valid GeoJSON (RFC 7946): {what}.")

    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        found = document.get("type") if isinstance(document, dict) else type(document).__name__
        refuse(f"found {found!r}, expected a FeatureCollection")
    if "crs" in document:
        refuse("it has a 'crs' member; convert it to WGS84 longitude and latitude")
    if not isinstance(document.get("features"), list):
        refuse("'features' is not a list")
    for number, feature in enumerate(document["features"]):
        where = f"feature {number}"
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            refuse(f"{where} is not a Feature")
        if not isinstance(feature.get("properties"), dict | None):
            refuse(f"{where}: 'properties' is neither an object nor null")
        geometry = feature.get("geometry")
        if geometry is None:
            continue
        if not isinstance(geometry, dict):
            refuse(f"{where}: 'geometry' is neither an object nor null")
        kind, coordinates = geometry.get("type"), geometry.get("coordinates")
        if kind == "LineString":
            _check_positions(coordinates, 2, where, refuse)
        elif kind == "Polygon":
            if not isinstance(coordinates, list) or not coordinates:
                refuse(f"{where}: a Polygon needs at least one ring")
            for ring in coordinates:
                _check_positions(ring, 4, where, refuse)
                if ring[0] != ring[-1]:
                    refuse(f"{where}: a ring is not closed")
        elif kind not in _OTHER_GEOMETRIES:
            refuse(f"{where}: geometry type {kind!r} does not exist")


_OTHER_GEOMETRIES: Final = (
    "Point",
    "MultiPoint",
    "MultiLineString",
    "MultiPolygon",
    "GeometryCollection",
)


def _check_positions(positions: Any, at_least: int, where: str, refuse: Any) -> None:
    if not isinstance(positions, list) or len(positions) < at_least:
        refuse(f"{where}: expected a list of at least {at_least} positions")
    for position in positions:
        if not isinstance(position, list) or len(position) not in (2, 3):
            refuse(
                f"{where}: a position is [longitude, latitude] or has a height, found {position!r}"
            )
        for value in position:
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not _is_finite(value)
            ):
                refuse(f"{where}: {value!r} is not a finite number")
        if not (-180.0 <= position[0] <= 180.0 and -90.0 <= position[1] <= 90.0):
            refuse(f"{where}: {position[:2]} is not longitude -180..180, latitude -90..90")


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond any float
        return False


def _load(path: Path) -> Any:
    def refuse_constant(text: str) -> None:
        raise FormatError(
            f"{path} contains {text}, which JSON does not know; expected finite numbers."
        )

    try:
        return json.loads(path.read_bytes(), parse_constant=refuse_constant)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror or error}.") from error
    except RecursionError as error:
        raise FormatError(f"{path} is nested too deeply for GeoJSON.") from error
    except FormatError:
        raise
    except ValueError as error:  # malformed, not UTF-8, or a number of too many digits
        raise FormatError(f"{path} is not JSON: {error}.") from error


def _oriented(element: MapElement) -> MapElement:
    if not isinstance(element.geometry, Polygon):
        return element
    return element.model_copy(update={"geometry": orient(element.geometry, 1.0)})


def _feature(element: MapElement, frame: MapFrame) -> dict[str, Any]:
    try:
        geometry = map_geometry(element.geometry, lambda c: _rounded(frame.to_wgs84(c)))
    except CRSMismatchError as error:
        raise FormatError(f"{element.element_type} {element.id!r}: {error}") from error
    document = mapping(geometry)
    properties = {"element_type": element.element_type, **element_fields(element)}
    return {
        "type": "Feature",
        "id": element.id,
        "geometry": {"type": document["type"], "coordinates": document["coordinates"]},
        "properties": properties,
    }


def _rounded(lon_lat_height: NDArrayFloat) -> NDArrayFloat:
    rounded = np.column_stack(
        [
            np.round(lon_lat_height[:, :2], DECIMALS),
            np.round(lon_lat_height[:, 2], HEIGHT_DECIMALS),
        ]
    )
    return np.asarray(rounded + 0.0)  # no negative zero


def _geometry(document: dict[str, Any]) -> BaseGeometry:
    def positions(rows: Iterable[list[float]]) -> list[tuple[float, float, float]]:
        return [(float(r[0]), float(r[1]), float(r[2]) if len(r) > 2 else 0.0) for r in rows]

    coordinates = document["coordinates"]
    if document["type"] == "LineString":
        return LineString(positions(coordinates))
    return Polygon(positions(coordinates[0]), [positions(ring) for ring in coordinates[1:]])
