import random
import time
from pathlib import Path

import numpy as np
import pyogrio
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyproj import CRS
from shapely.geometry import LineString

from hdmap_tools.errors import CRSMismatchError, FormatError, OutputExistsError
from hdmap_tools.formats import gpkg
from hdmap_tools.formats.gpkg import read_gpkg, write_gpkg
from hdmap_tools.formats.records import element_from_fields
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import ELEMENT_TYPES, LaneMark, MapElement
from hdmap_tools.map_model.vector_map import VectorMap

from .conftest import assert_same


def test_round_trip_is_exact(vector_map: VectorMap, tmp_path: Path) -> None:
    write_gpkg(vector_map, tmp_path / "a.gpkg")
    found = read_gpkg(tmp_path / "a.gpkg")
    assert found.frame == vector_map.frame
    assert found.provenance == vector_map.provenance
    assert_same(vector_map, found, 1e-9)


@pytest.mark.parametrize(
    "crs", ["EPSG:25832", "EPSG:3857", "EPSG:2056", "EPSG:27700", "EPSG:31467"]
)
def test_crs_of_all_kinds_come_back(crs: str, tmp_path: Path) -> None:
    frame = MapFrame.from_crs(crs, (50.0, 7.0), 12.5)
    mark = LaneMark(id="m", geometry=LineString([(0, 0, 0), (1, 2, 3)]))
    write_gpkg(VectorMap(frame, (mark,)), tmp_path / "a.gpkg")
    found = read_gpkg(tmp_path / "a.gpkg")
    assert found.frame == frame
    assert_same(VectorMap(frame, (mark,)), found, 1e-9)


def test_gdal_sees_typed_3d_layers_in_the_crs_of_the_map(
    vector_map: VectorMap, tmp_path: Path
) -> None:
    path = tmp_path / "a.gpkg"
    write_gpkg(vector_map, path)
    layers = {str(n): str(kind) for n, kind in pyogrio.list_layers(path)}
    assert layers == {t.element_type: f"{t.geometry_type} Z" for t in ELEMENT_TYPES}
    info = pyogrio.read_info(path, layer="lane_mark")
    assert CRS(info["crs"]).equals(vector_map.frame.crs, ignore_axis_order=True)
    kinds = dict(zip(info["fields"], info["dtypes"], strict=True))
    assert kinds["confidence"] == kinds["width_m"] == "float64"
    assert kinds["num_observations"] == "int64"
    boundary = pyogrio.read_info(path, layer="road_boundary")
    assert dict(zip(boundary["fields"], boundary["dtypes"], strict=True))["is_island"] == "bool"
    assert pyogrio.read_bounds(path, layer="lane_mark")[1][2].max() == pytest.approx(30.0)


@given(
    xyz=st.lists(
        st.tuples(*[st.floats(-5e5, 5e5)] * 3), min_size=2, max_size=6, unique_by=lambda p: p[:2]
    ),
    offset=st.tuples(st.floats(-9e6, 9e6), st.floats(-9e6, 9e6), st.floats(-400, 9000)),
    confidence=st.floats(0, 1),
    count=st.integers(0, 2**63 - 1),
)
@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_line_comes_back_within_a_nanometre(
    xyz: list[tuple[float, float, float]],
    offset: tuple[float, float, float],
    confidence: float,
    count: int,
    tmp_path: Path,
) -> None:
    frame = MapFrame(CRS.from_epsg(32632).to_wkt(), offset)
    mark = LaneMark(id="m", geometry=LineString(xyz), confidence=confidence, num_observations=count)
    write_gpkg(VectorMap(frame, (mark,)), tmp_path / "a.gpkg", overwrite=True)
    found = read_gpkg(tmp_path / "a.gpkg")
    assert found.elements[0].confidence == confidence
    assert found.elements[0].num_observations == count
    assert np.abs(np.array(found.elements[0].geometry.coords) - xyz).max() <= 1e-9


def test_without_an_origin_and_empty(elements: tuple[MapElement, ...], tmp_path: Path) -> None:
    local = VectorMap(MapFrame(), elements)
    write_gpkg(local, tmp_path / "a.gpkg")
    assert_same(local, read_gpkg(tmp_path / "a.gpkg"), 0.0)
    assert not read_gpkg(tmp_path / "a.gpkg").frame.is_georeferenced
    empty = VectorMap(MapFrame(), (), {"a": 1})
    write_gpkg(empty, tmp_path / "empty.gpkg")
    assert read_gpkg(tmp_path / "empty.gpkg") == empty
    assert len(pyogrio.list_layers(tmp_path / "empty.gpkg")) == len(ELEMENT_TYPES)


def test_same_map_same_bytes(vector_map: VectorMap, tmp_path: Path) -> None:
    write_gpkg(vector_map, tmp_path / "a.gpkg")
    shuffled = list(vector_map.elements)
    random.Random(3).shuffle(shuffled)
    time.sleep(1.1)  # a time of day would show
    again = VectorMap(vector_map.frame, tuple(shuffled), vector_map.provenance)
    write_gpkg(again, tmp_path / "b.gpkg")
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()


def test_failure_keeps_the_old_file(
    vector_map: VectorMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.gpkg"
    write_gpkg(vector_map, path)
    before = path.read_bytes()
    with pytest.raises(OutputExistsError):
        write_gpkg(vector_map, path)
    written: list[str] = []
    real = gpkg._write_layer

    def fails_later(m: VectorMap, t: type[MapElement], p: Path, text: str) -> None:
        if len(written) == 4:
            raise RuntimeError("disk gone")
        written.append(t.element_type)
        real(m, t, p, text)

    monkeypatch.setattr(gpkg, "_write_layer", fails_later)
    with pytest.raises(RuntimeError, match="disk gone"):
        write_gpkg(vector_map, path, overwrite=True)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.gpkg"]


def test_gdal_settings_are_put_back(vector_map: VectorMap, tmp_path: Path) -> None:
    write_gpkg(vector_map, tmp_path / "a.gpkg")
    assert pyogrio.get_gdal_config_option("OGR_CURRENT_DATE") is None


@pytest.mark.parametrize("mode", [0o755, 0o555])
def test_reading_leaves_nothing_beside_the_file(
    mode: int, vector_map: VectorMap, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    path = folder / "a.gpkg"
    write_gpkg(vector_map, path)
    before = path.read_bytes()
    path.chmod(mode & 0o666)
    folder.chmod(mode)
    try:
        assert_same(vector_map, read_gpkg(path), 1e-9)
        assert [p.name for p in folder.iterdir()] == ["a.gpkg"]
        assert path.read_bytes() == before
    finally:
        folder.chmod(0o755)


def test_text_that_a_geopackage_cuts_is_refused(frame: MapFrame, tmp_path: Path) -> None:
    mark = LaneMark(id="m", geometry=LineString([(0, 0, 0), (1, 0, 0)]), plugin="a\0b")
    with pytest.raises(FormatError, match=r"attributes of lane_mark 'm'"):
        write_gpkg(VectorMap(frame, (mark,)), tmp_path / "a.gpkg")
    assert list(tmp_path.iterdir()) == []
    big = mark.model_copy(update={"plugin": "", "num_observations": 2**63})
    with pytest.raises(FormatError, match="64-bit"):
        write_gpkg(VectorMap(frame, (big,)), tmp_path / "a.gpkg")
    with pytest.raises(FormatError, match="JSON"):
        write_gpkg(VectorMap(frame, (), {"x": float("nan")}), tmp_path / "a.gpkg")


def test_damaged_missing_and_foreign_files(vector_map: VectorMap, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="does not exist"):
        read_gpkg(tmp_path / "none.gpkg")
    (tmp_path / "text.gpkg").write_text("no database")
    with pytest.raises(FormatError, match=r"text\.gpkg cannot be used as a GeoPackage"):
        read_gpkg(tmp_path / "text.gpkg")
    write_gpkg(vector_map, tmp_path / "a.gpkg")
    (tmp_path / "cut.gpkg").write_bytes((tmp_path / "a.gpkg").read_bytes()[:20000])
    with pytest.raises(FormatError):
        read_gpkg(tmp_path / "cut.gpkg")


def test_layers_of_others_are_counted_and_another_crs_refused(
    vector_map: VectorMap, tmp_path: Path
) -> None:
    path = tmp_path / "a.gpkg"
    write_gpkg(vector_map, path)
    wkb = np.array([LineString([(0, 0, 0), (1, 1, 1)]).wkb], dtype=object)
    line = {"driver": "GPKG", "geometry_type": "LineString Z"}
    pyogrio.raw.write(path, wkb, [], [], layer="notes", crs="EPSG:32632", **line)
    assert read_gpkg(path).provenance["skipped"] == {"layer": 1}
    other = tmp_path / "b.gpkg"
    pyogrio.raw.write(other, wkb, [], [], layer="lane_mark", crs="EPSG:32632", **line)
    found = read_gpkg(other)
    assert found.frame.crs == CRS.from_epsg(32632)
    assert found.elements[0].id.startswith("lane_mark-")
    pyogrio.raw.write(other, wkb, [], [], layer="stop_line", crs="EPSG:32633", **line)
    with pytest.raises(CRSMismatchError, match="33N"):
        read_gpkg(other)
    pyogrio.raw.write(tmp_path / "c.gpkg", wkb, [], [], layer="lane_mark", crs="EPSG:4326", **line)
    with pytest.raises(CRSMismatchError, match="projected"):
        read_gpkg(tmp_path / "c.gpkg")


def test_a_layer_without_geometry_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    ids = np.array(["a"], dtype=object)
    pyogrio.raw.write(
        path, None, [ids], ["id"], layer="lane_mark", driver="GPKG", geometry_type=None, crs=None
    )
    with pytest.raises(FormatError, match="lane_mark is a table without geometry"):
        read_gpkg(path)


@pytest.mark.parametrize("fields", [{"id": "a\ud800"}, {"id": "a", "plugin": "\udc00"}])
def test_half_a_character_is_refused_by_name(fields: dict[str, str], tmp_path: Path) -> None:
    mark = LaneMark(geometry=LineString([(0, 0, 0), (1, 2, 3)]), **fields)
    with pytest.raises(FormatError, match=r"lane_mark 'a.* half a character") as caught:
        write_gpkg(VectorMap(MapFrame(), (mark,)), tmp_path / "a.gpkg")
    assert str(caught.value).isascii()
    assert not list(tmp_path.iterdir())


def test_up_to_three_wrong_fields_are_named_at_once() -> None:
    fields = {"id": 5, "confidence": 7.0, "style": "wavy", "width_m": "wide"}
    with pytest.raises(FormatError, match=r"^feature 3 is not a valid lane_mark: id: ") as caught:
        element_from_fields(LaneMark, fields, LineString([(0, 0, 0), (1, 2, 3)]), "feature 3")
    text = str(caught.value)
    assert text.count(";") == 3
    assert text.endswith("and 1 more.")
