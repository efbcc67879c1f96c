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
    if path.suffix.lower() == ".json" and path.name.startswith("log_map_archive_"):
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


def write_vector_map(
    vector_map: VectorMap,
    path: str | os.PathLike[str],
    format_name: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a map in a format by name (`FORMAT_SUFFIXES`); None takes it from the suffix.

    Raises:
        FormatError: If the format is unknown or cannot hold the map.
        NoOriginError: If a geographic format is asked of a map without an origin.
        OutputExistsError: If the file exists and overwrite is False.
    """
    name = _NAME_OF_SUFFIX.get(Path(path).suffix.lower()) if format_name is None else format_name
    if name == "gpkg":
        from hdmap_tools.formats.gpkg import write_gpkg

        write_gpkg(vector_map, path, overwrite=overwrite)
    elif name == "lanelet2":
        from hdmap_tools.formats.lanelet2 import write_lanelet2

        write_lanelet2(vector_map, path, overwrite=overwrite)
    elif name == "geojson":
        from hdmap_tools.formats.geojson import write_geojson

        write_geojson(vector_map, path, overwrite=overwrite)
    else:
        asked = repr(format_name) if format_name is not None else f"suffix {Path(path).suffix!r}"
        raise FormatError(
            f"No format {asked} to write; expected one of {', '.join(FORMAT_SUFFIXES)}."
        )


def _suffixes() -> str:
    return ", ".join(sorted(_NAME_OF_SUFFIX))
