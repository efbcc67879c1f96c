"""`hdmap export`: the format follows from the file's name."""

import json

import pytest

from hdmap_tools.formats.by_name import read_vector_map, write_vector_map
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.vector_map import VectorMap


@pytest.fixture
def features(mark, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_vector_map(VectorMap(MapFrame.from_origin(49.0, 8.4), (mark,)), "features.gpkg")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "start"),
    [("m.osm", b"<?xml"), ("m.geojson", b"{"), ("m.JSON", b"{"), ("m.gpkg", b"SQLite format 3")],
)
def test_the_suffix_says_the_format(name, start, features, hdmap):
    code, _, err = hdmap("export", "features.gpkg", "-o", name)
    assert code == 0, err
    assert (features / name).read_bytes().startswith(start)
    assert read_vector_map(features / name).counts() == {"lane_mark": 1}


def test_a_name_is_taken_where_the_suffix_says_nothing(features, hdmap, fails):
    fails("export", "features.gpkg", "-o", "map.xml", says=("'.xml'", "--format"))
    code, _, err = hdmap(
        "export", "features.gpkg", "-o", "map.xml", "--format", "lanelet2", "--json", "f.json"
    )
    assert code == 0, err
    assert (features / "map.xml").read_bytes().startswith(b"<?xml")
    assert json.loads((features / "f.json").read_text())["format"] == "lanelet2"


def test_suffix_and_name_that_disagree_are_refused(features, fails):
    fails(
        "export", "features.gpkg", "-o", "map.geojson", "--format", "lanelet2",
        says=("map.geojson ends in .geojson", "lanelet2", ".osm"),
    )  # fmt: skip
    assert not (features / "map.geojson").exists()
