from pathlib import Path

import pytest

from hdmap_tools.errors import CRSMismatchError, FormatError, NoOriginError, OutputExistsError
from hdmap_tools.formats.by_name import FORMAT_SUFFIXES, read_vector_map, write_vector_map
from hdmap_tools.formats.reproject import reproject
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.map_model.vector_map import VectorMap

from .conftest import assert_same


@pytest.mark.parametrize("name", FORMAT_SUFFIXES)
def test_every_format_by_name_and_suffix(name: str, vector_map: VectorMap, tmp_path: Path) -> None:
    path = tmp_path / f"map{FORMAT_SUFFIXES[name].upper()}"
    write_vector_map(vector_map, path, name)
    found = read_vector_map(path)
    assert found.frame == vector_map.frame
    assert found.counts() | {"centerline": 1} == vector_map.counts()
    with pytest.raises(OutputExistsError):
        write_vector_map(vector_map, path, name)
    write_vector_map(vector_map, path, overwrite=True)
    other = MapFrame.from_origin(49.004, 8.425)
    moved = read_vector_map(path, other)
    assert moved.frame == other
    assert_same(found, reproject(moved, found.frame), 1e-3)


def test_reproject_needs_two_places_on_earth_and_one_datum(
    vector_map: VectorMap, elements: tuple[MapElement, ...]
) -> None:
    assert reproject(vector_map, vector_map.frame) is vector_map
    with pytest.raises(NoOriginError):
        reproject(VectorMap(MapFrame(), elements), vector_map.frame)
    with pytest.raises(NoOriginError):
        reproject(vector_map, MapFrame())
    with pytest.raises(CRSMismatchError, match="EGM2008"):
        reproject(vector_map, MapFrame.from_origin(49.0, 8.4, vertical_datum="EGM2008"))


def test_unknown_names_say_what_is_known(vector_map: VectorMap, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="does not exist"):
        read_vector_map(tmp_path / "a.osm")
    with pytest.raises(FormatError, match="is a folder"):
        read_vector_map(tmp_path)
    for name, says in (("a.shp", "'.shp'"), ("log_map_archive_x____PIT.json", "Argoverse 2")):
        (tmp_path / name).write_text("{}")
        with pytest.raises(FormatError, match=says):
            read_vector_map(tmp_path / name)
    with pytest.raises(FormatError, match="gpkg, lanelet2, geojson"):
        write_vector_map(vector_map, tmp_path / "b.osm", "shapefile")
    with pytest.raises(FormatError, match=r"suffix '\.shp'"):
        write_vector_map(vector_map, tmp_path / "b.shp")
