"""GeoPackage: the working file, which QGIS opens as it is.

One layer an element type (all of them, also those without elements), 3D, in the
CRS of the map: coordinates are the city's plus ``MapFrame.offset_m``. Frame and
provenance are a GeoPackage metadata item, so reading gives back the same map.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Final, get_args, get_origin

import numpy as np
import shapely

from hdmap_tools.errors import CRSMismatchError, FormatError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.formats.records import (
    Skipped,
    dump_metadata,
    element_fields,
    element_from_fields,
    map_geometry,
    parse_metadata,
    require_same_elements,
)
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import ELEMENT_TYPES, MapElement, element_type_by_name
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.types import NDArrayAny

if TYPE_CHECKING:
    from pyproj import CRS

_log = logging.getLogger(__name__)

ROUND_TRIP_M: Final = 1e-9
"""What adding and taking away an offset of up to 10 000 km costs in float64."""

_METADATA_KEY: Final = "hdmap_tools"
_GDAL_SETTINGS: Final = {
    "OGR_CURRENT_DATE": "2000-01-01T00:00:00.000Z",  # written in place of the time of day
    "GDAL_PAM_ENABLED": "NO",  # or reading leaves FILE.aux.xml beside a file
    "OGR_SQLITE_SYNCHRONOUS": "OFF",  # the finished file is synced once, before its rename
}
_gdal_lock = threading.Lock()  # GDAL's configuration is one for the whole process


def write_gpkg(
    vector_map: VectorMap, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write the map as a GeoPackage; the CRS is undefined if the map has no origin.

    Raises:
        OutputExistsError: If the file exists and overwrite is False.
        FormatError: If an attribute or the provenance cannot be kept, or writing failed.
    """
    metadata = dump_metadata(vector_map)

    def validate(temporary: Path) -> None:
        require_same_elements(vector_map, read_gpkg(temporary), ROUND_TRIP_M, str(path))

    with atomic_output(path, overwrite, validate=validate) as temporary, _pyogrio_errors(path):
        for element_type in ELEMENT_TYPES:
            _write_layer(vector_map, element_type, temporary, metadata)


def read_gpkg(path: str | os.PathLike[str]) -> VectorMap:
    """Read a GeoPackage that `write_gpkg` wrote, edited in QGIS or not.

    Layers that are no element type are skipped and counted in ``provenance["skipped"]``.
    A file of someone else is read if its layers carry the names and one projected CRS.

    Raises:
        FormatError: If the file is damaged or an element in it is not valid.
        CRSMismatchError: If a layer has another CRS than the map.
    """
    import pyogrio
    from pyogrio.raw import read

    source = str(path)
    if not Path(path).is_file():
        raise FormatError(f"{source} does not exist; expected a GeoPackage.")
    with _pyogrio_errors(path):
        names = sorted(str(name) for name, _ in pyogrio.list_layers(path))
        skipped = Skipped()
        frame: MapFrame | None = None
        provenance: dict[str, Any] = {}
        if names:
            stored = (pyogrio.read_info(path, layer=names[0])["dataset_metadata"] or {}).get(
                _METADATA_KEY
            )
            if stored is not None:
                frame, provenance = parse_metadata(stored, source)
        elements: list[MapElement] = []
        for name in names:
            element_type = element_type_by_name(name)
            if element_type is None:
                skipped.add("layer", name)
                continue
            meta, fids, wkb, columns = read(path, layer=name, return_fids=True)
            frame = _checked_frame(frame, meta["crs"], f"{source}, layer {name}")
            if wkb is None and len(fids):
                raise FormatError(
                    f"{source}, layer {name} is a table without geometry; expected "
                    f"{element_type.geometry_type} Z. Rename the table, or add its geometry in QGIS."
                )
            fields = [str(field) for field in meta["fields"]]
            for row, fid in enumerate(fids):
                elements.append(
                    _read_element(
                        element_type,
                        wkb[row],
                        {f: columns[i][row] for i, f in enumerate(fields)},
                        frame,
                        f"{source}, layer {name}, feature {fid}",
                    )
                )
    skipped.log(_log, source)
    if skipped.counts:
        provenance = {**provenance, **skipped.to_provenance()}
    return VectorMap(frame or MapFrame(), with_stable_ids(elements), provenance)


def _write_layer(
    vector_map: VectorMap, element_type: type[MapElement], path: Path, metadata: str
) -> None:
    from pyogrio.raw import write

    elements = [e for e in vector_map if type(e) is element_type]
    frame = vector_map.frame
    geometry = np.array(
        [
            shapely.to_wkb(
                map_geometry(e.geometry, lambda c: c + frame.offset_m),
                output_dimension=3,
                flavor="iso",
            )
            for e in elements
        ],
        dtype=object,
    )
    rows = [element_fields(e) for e in elements]
    columns = [
        _column([row[name] for row in rows], _column_kind(field.annotation), name, elements)
        for name, field in element_type.model_fields.items()
        if name != "geometry"
    ]
    options: dict[str, Any] = {}
    if not frame.is_georeferenced:
        options["layer_options"] = {"SRID": "-1"}  # GeoPackage's "undefined Cartesian"
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="'crs' was not provided", category=UserWarning)
        write(
            path,
            geometry,
            [values for values, _ in columns],
            [name for name in element_type.model_fields if name != "geometry"],
            field_mask=[mask for _, mask in columns],
            layer=element_type.element_type,
            driver="GPKG",
            geometry_type=f"{element_type.geometry_type} Z",
            crs=frame.crs_wkt,
            dataset_metadata={_METADATA_KEY: metadata},
            **options,
        )


def _column_kind(annotation: Any) -> type:
    """str, int, float or bool; dict for what is kept as JSON text."""
    origin = get_origin(annotation)
    if origin in (tuple, list, dict):
        return dict
    for option in (*get_args(annotation), annotation):
        if get_origin(option) is not None:
            return _column_kind(option)
        for plain in (bool, int, float, str):
            if option is not NoneType and isinstance(option, type) and issubclass(option, plain):
                return plain
    raise TypeError(f"No GeoPackage column for {annotation}.")


def _column(
    values: list[Any], kind: type, name: str, elements: list[MapElement]
) -> tuple[NDArrayAny, NDArrayAny | None]:
    """(values, mask of the missing ones) as pyogrio takes them."""
    if kind is dict:
        texts = [json.dumps(v, sort_keys=True, separators=(",", ":")) for v in values]
        return np.array(texts, dtype=object), None
    if kind is str:
        for text, element in zip(values, elements, strict=True):
            if text is not None and not _is_unicode(text):
                raise FormatError(
                    f"{name} of {element.element_type} {element.id!a} is {ascii(text)[:80]}, which "
                    "holds half a character (a lone surrogate); a GeoPackage holds Unicode text."
                )
        return np.array(values, dtype=object), None
    mask = np.array([v is None for v in values], dtype=bool)
    filled = [kind() if v is None else v for v in values]
    if kind is int:
        for value, element in zip(filled, elements, strict=True):
            if not -(2**63) <= value < 2**63:
                raise FormatError(
                    f"{name} of {element.element_type} {element.id!r} is {value}; a GeoPackage "
                    "holds 64-bit integers."
                )
    return np.array(filled, dtype={int: np.int64, float: np.float64, bool: bool}[kind]), (
        mask if mask.any() else None
    )


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _read_element(
    element_type: type[MapElement],
    wkb: bytes | None,
    row: Mapping[str, Any],
    frame: MapFrame,
    name: str,
) -> MapElement:
    if wkb is None:
        raise FormatError(f"{name} has no geometry; delete the feature or draw it.")
    fields: dict[str, Any] = {}
    for key, value in row.items():
        field = element_type.model_fields.get(key)
        missing = value is None or (isinstance(value, float | np.floating) and np.isnan(value))
        if field is None or missing:
            continue
        plain = value.item() if isinstance(value, np.generic) else value
        kind = _column_kind(field.annotation)
        if kind is dict:
            try:
                plain = json.loads(plain)
            except (TypeError, ValueError, RecursionError) as error:
                raise FormatError(f"{name}: {key} is not JSON ({error}).") from error
        fields[key] = kind(plain) if kind in (bool, int) and plain == kind(plain) else plain
    try:
        geometry = shapely.from_wkb(wkb)
    except shapely.errors.ShapelyError as error:
        raise FormatError(f"{name} has a damaged geometry: {error}.") from error
    geometry = map_geometry(geometry, lambda c: c - frame.offset_m)
    return element_from_fields(element_type, fields, geometry, name)


def _checked_frame(frame: MapFrame | None, layer_crs: str | None, name: str) -> MapFrame:
    from pyproj import CRS

    if frame is None:
        crs = CRS.from_user_input(layer_crs) if layer_crs else None
        return MapFrame() if crs is None or crs.is_engineering else MapFrame(crs.to_wkt())
    if frame.is_georeferenced and layer_crs and not _is_same_place(frame, CRS(layer_crs)):
        raise CRSMismatchError(
            f"{name} is in {CRS(layer_crs).name!r}, the map in {frame.crs.name!r}; "
            "save the layer in the map's CRS."
        )
    return frame


def _is_same_place(frame: MapFrame, crs: CRS) -> bool:
    """Whether coordinates mean the same; GDAL may spell a CRS differently than it was given."""
    if frame.crs.equals(crs, ignore_axis_order=True):
        return True
    if not crs.is_projected:
        return False
    around = np.array([[0.0, 0.0, 0.0], [5e3, 0.0, 0.0], [0.0, 5e3, 0.0]])
    other = MapFrame(crs.to_wkt(), frame.offset_m, frame.vertical_datum)
    return bool(np.allclose(frame.to_wgs84(around), other.to_wgs84(around), rtol=0, atol=1e-9))


@contextlib.contextmanager
def _pyogrio_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """GDAL with our settings, the user's again afterwards; its errors become one line of ours."""
    import pyogrio
    from pyogrio.errors import (
        DataLayerError,
        DataSourceError,
        FeatureError,
        FieldError,
        GeometryError,
    )

    with _gdal_lock:
        before = {key: pyogrio.get_gdal_config_option(key) for key in _GDAL_SETTINGS}
        pyogrio.set_gdal_config_options(_GDAL_SETTINGS)
        try:
            yield
        except (DataSourceError, DataLayerError, FeatureError, FieldError, GeometryError) as error:
            raise FormatError(f"{path} cannot be used as a GeoPackage: {error}") from error
        finally:
            pyogrio.set_gdal_config_options(before)
