"""Reading by a file's suffix, writing by a format's name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from hdmap_tools.errors import FormatError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.vector_map import VectorMap

FORMAT_SUFFIXES: Final = {"gpkg": ".gpkg", "lanelet2": ".osm", "geojson": ".geojson"}
"""Names of the formats that can be written, with the suffix each goes by."""

_NAME_OF_SUFFIX: Final = {
    ".gpkg": "gpkg",
    ".osm": "lanelet2",
    ".geojson": "geojson",
    ".json": "geojson",
}


def read_vector_map(path: str | os.PathLike[str], frame: MapFrame | None = None) -> VectorMap:
    """Read a map; its format follows from the suffix: .gpkg, .osm, .geojson or .json.

    Args:
        path: The file.
        frame: City frame of the result; by default the file's own.

    Raises:
        FormatError: If the file is missing, of an unknown format, or cannot be read.
        CRSMismatchError: If it cannot be brought into the frame.
    """
    path = Path(path)
    if not path.is_file():
        found = "is a folder" if path.is_dir() else "does not exist"
        raise FormatError(f"{path} {found}; expected a map file ({_suffixes()}).")
    name = _NAME_OF_SUFFIX.get(path.suffix.lower())
    if _is_av2_map(path):
        raise FormatError(
            f"{path} is an Argoverse 2 map, which cannot be read yet; expected {_suffixes()}."
        )
    if name == "gpkg":
        from hdmap_tools.formats.gpkg import read_gpkg
        from hdmap_tools.formats.reproject import reproject

        vector_map = read_gpkg(path)
        return vector_map if frame is None else reproject(vector_map, frame)
    if name == "lanelet2":
        from hdmap_tools.formats.lanelet2 import read_lanelet2

        return read_lanelet2(path, frame)
    if name == "geojson":
        from hdmap_tools.formats.geojson import read_geojson

        return read_geojson(path, frame)
    raise FormatError(
        f"{path} has the suffix {path.suffix!r}, which is no map format known; expected {_suffixes()}."
    )


def is_readable(path: Path) -> bool:
    """Whether `read_vector_map` knows files of that name."""
    return path.suffix.lower() in _NAME_OF_SUFFIX and not _is_av2_map(path)


def _is_av2_map(path: Path) -> bool:
    return path.suffix.lower() == ".json" and path.name.startswith("log_map_archive_")


def write_vector_map(
    vector_map: VectorMap,
    path: str | os.PathLike[str],
    format_name: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a map in a format by name (`FORMAT_SUFFIXES`); None takes it from the suffix.

    Raises:
        FormatError: As `output_format`, or if the format cannot hold the map.
        NoOriginError: If a geographic format is asked of a map without an origin.
        OutputExistsError: If the file exists and overwrite is False.
    """
    name = output_format(path, format_name)
    if name == "gpkg":
        from hdmap_tools.formats.gpkg import write_gpkg

        write_gpkg(vector_map, path, overwrite=overwrite)
    elif name == "lanelet2":
        from hdmap_tools.formats.lanelet2 import write_lanelet2

        write_lanelet2(vector_map, path, overwrite=overwrite)
    else:
        from hdmap_tools.formats.geojson import write_geojson

        write_geojson(vector_map, path, overwrite=overwrite)


def output_format(path: str | os.PathLike[str], format_name: str | None = None) -> str:
    """Name of the format to write a file in: its suffix says it, or `format_name` for another suffix.

    Raises:
        FormatError: If neither says it, the name is unknown, or suffix and name disagree:
            every reader goes by the suffix, so such a file could not be read again.
    """
    suffix = Path(path).suffix
    of_suffix = _NAME_OF_SUFFIX.get(suffix.lower())
    if format_name is None and of_suffix is None:
        raise FormatError(
            f"{path} has the suffix {suffix!r}, which says no format; end it in {_suffixes()}, or "
            f"name one of {', '.join(FORMAT_SUFFIXES)} with --format."
        )
    if format_name is not None and format_name not in FORMAT_SUFFIXES:
        raise FormatError(
            f"No format {format_name!r} to write; expected one of {', '.join(FORMAT_SUFFIXES)}."
        )
    if format_name is not None and of_suffix not in (None, format_name):
        raise FormatError(
            f"{path} ends in {suffix}, which is {of_suffix}, but the format asked for is "
            f"{format_name}; end it in {FORMAT_SUFFIXES[format_name]}, or leave --format out."
        )
    return of_suffix or str(format_name)


def _suffixes() -> str:
    return ", ".join(sorted(_NAME_OF_SUFFIX))
