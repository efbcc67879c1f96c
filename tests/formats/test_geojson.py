import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, shape

from hdmap_tools.errors import FormatError, NoOriginError, OutputExistsError
from hdmap_tools.formats import geojson
from hdmap_tools.formats.geojson import read_geojson, validate_geojson, write_geojson
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import LaneMark, MapElement
from hdmap_tools.map_model.vector_map import VectorMap

from .conftest import assert_same


def test_round_trip_within_a_millimetre(vector_map: VectorMap, tmp_path: Path) -> None:
    write_geojson(vector_map, tmp_path / "a.geojson")
    found = read_geojson(tmp_path / "a.geojson")
    assert found.frame == vector_map.frame
    assert found.provenance == vector_map.provenance
    assert_same(vector_map, found, 1e-3)
    far = MapFrame.from_origin(49.01, 8.43)
    moved = read_geojson(tmp_path / "a.geojson", far)
    assert moved.frame == far
    middle = moved.of_type(LaneMark)[0]
    back = vector_map.frame.from_wgs84(
        far.to_wgs84(shapely.get_coordinates(middle.geometry, include_z=True))
    )
    expected = shapely.get_coordinates(vector_map.of_type(LaneMark)[0].geometry, include_z=True)
    assert np.abs(back - expected).max() < 1e-3


def test_follows_rfc_7946(vector_map: VectorMap, tmp_path: Path) -> None:
    write_geojson(vector_map, tmp_path / "a.geojson")
    text = (tmp_path / "a.geojson").read_text(encoding="utf-8")
    document = json.loads(text, parse_float=str)
    assert "crs" not in document

    def numbers(value: Any) -> list[str]:
        return (
            [str(value)] if not isinstance(value, list) else [n for v in value for n in numbers(v)]
        )

    for feature in document["features"]:
        for number in numbers(feature["geometry"]["coordinates"]):
            assert len(number.partition(".")[2]) <= 9
            assert "e" not in number
    document = json.loads(text)
    polygons = [shape(f["geometry"]) for f in document["features"] if "Poly" in str(f["geometry"])]
    assert len(polygons) == 3
    for polygon in polygons:
        assert polygon.exterior.is_ccw
        assert not any(hole.is_ccw for hole in polygon.interiors)
    lon, lat, height = document["features"][0]["geometry"]["coordinates"][0][:3]
    assert (lon, lat) == pytest.approx((8.4242, 49.0034), abs=2e-3)
    assert height == pytest.approx(110, abs=2)


@given(
    xyz=st.lists(
        st.tuples(*[st.integers(-5_000_000, 5_000_000).map(lambda mm: mm / 1000)] * 3),
        min_size=2, max_size=6, unique_by=lambda p: p[:2],
    ),
    lat=st.floats(-80, 80), lon=st.floats(-179.9, 179.9),
)  # fmt: skip
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_line_on_earth_comes_back(
    xyz: list[tuple[float, float, float]], lat: float, lon: float, tmp_path: Path
) -> None:
    vector_map = VectorMap(
        MapFrame.from_origin(lat, lon), (LaneMark(id="m", geometry=LineString(xyz)),)
    )
    write_geojson(vector_map, tmp_path / "a.geojson", overwrite=True)
    assert_same(vector_map, read_geojson(tmp_path / "a.geojson"), 1e-3)


def test_across_the_antimeridian(tmp_path: Path) -> None:
    frame = MapFrame.from_origin(-17.0, 179.9999)
    mark = LaneMark(id="m", geometry=LineString([(-100, 0, 0), (100, 0, 0)]))
    write_geojson(VectorMap(frame, (mark,)), tmp_path / "a.geojson")
    document = json.loads((tmp_path / "a.geojson").read_text())
    del document["hdmap_tools"]
    (tmp_path / "b.geojson").write_text(json.dumps(document))
    found = read_geojson(tmp_path / "b.geojson")
    assert found.elements[0].geometry.length == pytest.approx(200.0, abs=1e-3)


def test_same_map_same_bytes(vector_map: VectorMap, tmp_path: Path) -> None:
    write_geojson(vector_map, tmp_path / "a.geojson")
    shuffled = list(vector_map.elements)
    random.Random(3).shuffle(shuffled)
    again = VectorMap(
        vector_map.frame, tuple(shuffled), dict(reversed(vector_map.provenance.items()))
    )
    write_geojson(again, tmp_path / "b.geojson")
    assert (tmp_path / "a.geojson").read_bytes() == (tmp_path / "b.geojson").read_bytes()


def test_empty_and_no_origin_and_existing(
    frame: MapFrame, elements: tuple[MapElement, ...], tmp_path: Path
) -> None:
    path = tmp_path / "a.geojson"
    with pytest.raises(NoOriginError, match="--origin"):
        write_geojson(VectorMap(MapFrame(), elements), path)
    assert list(tmp_path.iterdir()) == []
    write_geojson(VectorMap(frame), path)
    assert len(read_geojson(path)) == 0
    with pytest.raises(OutputExistsError):
        write_geojson(VectorMap(frame, elements), path)
    assert len(read_geojson(path)) == 0


def test_failure_keeps_the_old_file(
    vector_map: VectorMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.geojson"
    write_geojson(vector_map, path)
    before = path.read_bytes()
    monkeypatch.setattr(geojson, "_load", lambda _: {"type": "FeatureCollection", "features": 1})
    with pytest.raises(FormatError, match="not a list"):
        write_geojson(vector_map, path, overwrite=True)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.geojson"]


def test_element_too_small_for_nine_decimals_is_refused(frame: MapFrame, tmp_path: Path) -> None:
    dot = LaneMark(id="dot", geometry=LineString([(0, 0, 0), (1e-6, 0, 0)]))
    with pytest.raises(FormatError, match="lane_mark"):
        write_geojson(VectorMap(frame, (dot,)), tmp_path / "a.geojson")
    assert list(tmp_path.iterdir()) == []


def _collection(*geometries: Any, **properties: Any) -> dict[str, Any]:
    features = [
        {"type": "Feature", "geometry": g, "properties": {"element_type": "lane_mark"} | properties}
        for g in geometries
    ]
    return {"type": "FeatureCollection", "features": features}


LINE = {"type": "LineString", "coordinates": [[8.0, 49.0], [8.001, 49.0]]}


def test_files_of_others(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    document = _collection(LINE, None, {"type": "Point", "coordinates": [8.0, 49.0]})
    document["features"].append({"type": "Feature", "geometry": LINE, "properties": None, "id": 7})
    (tmp_path / "a.geojson").write_text(json.dumps(document))
    found = read_geojson(tmp_path / "a.geojson")
    assert found.provenance["skipped"] == {
        "feature without a known element_type": 1,
        "lane_mark with Point geometry": 1,
        "lane_mark with no geometry": 1,
    }
    assert found.provenance["skipped_ids"]["feature without a known element_type"] == ["7"]
    assert "skipped" in caplog.text
    (mark,) = found.elements
    assert mark.geometry.length == pytest.approx(73.17, abs=0.1)
    assert mark.geometry.centroid.coords[0] == pytest.approx((0, 0), abs=0.01)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not JSON"),
        ('{"type":"FeatureCollection","features":[', "not JSON"),
        ("[" * 200_000, "nested too deeply"),
        ("[]", "found 'list'"),
        ('{"type":"Topology"}', "found 'Topology'"),
        ('{"type":"FeatureCollection","features":[],"crs":{}}', "'crs' member"),
        ('{"type":"FeatureCollection"}', "not a list"),
        ('{"type":"FeatureCollection","features":[1]}', "not a Feature"),
        ('{"type":"FeatureCollection","features":[NaN]}', "NaN"),
        (json.dumps(_collection({"type": "Circle"})), "'Circle' does not exist"),
        (json.dumps(_collection({"type": "LineString", "coordinates": [[8, 49]]})), "at least 2"),
        (json.dumps(_collection({"type": "LineString", "coordinates": [[8, 49], [8]]})), "position"),
        (json.dumps(_collection({"type": "LineString", "coordinates": [[49, 98], [8, 4]]})), "latitude"),
        (json.dumps(_collection({"type": "LineString", "coordinates": [["8", 9], [8, 4]]})), "finite"),
        (json.dumps(_collection(LINE)).replace("49.0", "1e999"), "finite"),
        (json.dumps(_collection(LINE)).replace("49.0", "1" + "0" * 400), "finite"),
        (json.dumps(_collection(LINE)).replace("49.0", "1" + "0" * 5000), "not JSON"),
        (json.dumps(_collection(LINE, confidence=2)), "confidence"),
        (
            json.dumps(_collection({"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 1]]]})),
            "not closed",
        ),
        ('{"type":"FeatureCollection","features":[],"hdmap_tools":{}}', "damaged"),
        ('{"type":"FeatureCollection","features":[],"hdmap_tools":{"format_version":9}}', "update"),
    ],
)  # fmt: skip
def test_bad_files_end_in_one_clear_line(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.geojson"
    path.write_text(text)
    with pytest.raises(FormatError, match=says) as caught:
        read_geojson(path)
    assert "bad.geojson" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_not_utf8_and_missing(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'{"type": "\xff\xfe"}')
    with pytest.raises(FormatError, match="not JSON"):
        read_geojson(tmp_path / "a.json")
    with pytest.raises(FormatError, match="cannot be read"):
        read_geojson(tmp_path / "none.json")


def test_validation_accepts_every_geometry_type_of_the_rfc() -> None:
    kinds = ("Point", "MultiPoint", "MultiLineString", "MultiPolygon", "GeometryCollection")
    validate_geojson(_collection(*({"type": kind} for kind in kinds)))
