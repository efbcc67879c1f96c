"""Round trips and rules of the Lanelet2 files; the library judges them in test_lanelet2_library."""

import random
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, MultiPoint, Polygon

from hdmap_tools.errors import FormatError, NoOriginError, OutputExistsError
from hdmap_tools.formats import lanelet2_write
from hdmap_tools.formats.lanelet2 import read_lanelet2, to_osm, write_lanelet2
from hdmap_tools.formats.lanelet2_geometry import are_reversed, split_crosswalk
from hdmap_tools.formats.lanelet2_tags import line_fields, line_tags
from hdmap_tools.formats.osm_document import require_valid_lanelet2
from hdmap_tools.formats.osm_xml import read_osm
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import (
    Centerline,
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    MarkColor,
    MarkStyle,
    RoadBoundary,
    SidewalkArea,
)
from hdmap_tools.map_model.vector_map import VectorMap

from .conftest import assert_same, lanelet, line, polygon


def _written(vector_map: VectorMap) -> VectorMap:
    """What the format can hold of it."""
    kept = tuple(e for e in vector_map if not isinstance(e, Centerline))
    return VectorMap(vector_map.frame, kept, vector_map.provenance)


def test_every_element_type_comes_back(
    vector_map: VectorMap, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.osm"
    write_lanelet2(vector_map, path)
    assert "1 centerline" in caplog.text
    caplog.clear()
    found = read_lanelet2(path)
    assert found.frame == vector_map.frame
    assert found.provenance == {**vector_map.provenance, "skipped": {}}
    assert caplog.text == ""
    assert_same(_written(vector_map), found, 1e-5)
    again = read_lanelet2(path, MapFrame.from_origin(49.0, 8.42, 100.0))
    assert again.counts() == found.counts()
    assert again.frame.to_wgs84(
        shapely.get_coordinates(again.of_type(LaneMark)[0].geometry, include_z=True)
    ) == pytest.approx(
        found.frame.to_wgs84(
            shapely.get_coordinates(found.of_type(LaneMark)[0].geometry, include_z=True)
        ),
        abs=1e-8,
    )


def test_file_keeps_the_rules(vector_map: VectorMap, tmp_path: Path) -> None:
    path = tmp_path / "a.osm"
    write_lanelet2(vector_map, path)
    lines = path.read_text(encoding="utf-8").splitlines()
    kinds = [s.split()[0].strip("<>/") for s in map(str.strip, lines) if s[:5] in _PRIMITIVES]
    assert kinds == sorted(kinds, key=["node", "way", "relation"].index)
    assert all('visible="true" version="1"' in s for s in lines if s.strip()[:5] in _PRIMITIVES)
    document = read_osm(path)
    ids = [*document.nodes, *document.ways, *document.relations]
    assert ids == list(range(1, len(ids) + 1))
    by_name = {w.tags["hdmap_id"]: w for w in document.ways.values() if "hdmap_id" in w.tags}
    assert by_name["middle"].tags | {"type": "line_thin", "subtype": "dashed", "color": "yellow",
                                     "width": "0.12", "confidence": "0.987654321", "sigma_m": "0.0312",
                                     "num_observations": "17"} == by_name["middle"].tags  # fmt: skip
    assert by_name["wide"].tags["type"] == "line_thick"
    assert by_name["plain"].tags == {"type": "line_thin", "hdmap_id": "plain"}
    assert (by_name["right"].tags["type"], by_name["right"].tags["subtype"]) == (
        "curbstone",
        "high",
    )
    assert by_name["left"].tags["type"] == "road_border"
    assert by_name["middle_2"].tags["type"] == "virtual"
    assert by_name["stop"].tags["type"] == "stop_line"
    # successors share end nodes, neighbours the way
    assert by_name["right"].node_ids[-1] == by_name["right_2"].node_ids[0]
    assert by_name["middle"].node_ids[-1] == by_name["middle_2"].node_ids[0]
    assert by_name["island"].node_ids[0] == by_name["island"].node_ids[-1]
    relations = {r.tags["hdmap_id"]: r for r in document.relations.values()}
    members = {m.role: m.ref for m in relations["lane_1"].members}
    back = {m.role: m.ref for m in relations["lane_back"].members}
    assert members == {"left": by_name["middle"].id, "right": by_name["right"].id}
    assert back["left"] == members["left"]
    crossing = relations["crossing"].tags
    assert crossing == {"type": "lanelet", "subtype": "crosswalk", "location": "urban", "one_way": "no",
                        "participant:pedestrian": "yes", "hdmap_id": "crossing", "confidence": "0.8"}  # fmt: skip
    assert [m.role for m in relations["pavement"].members] == ["outer", "inner"]
    assert relations["lane_2"].tags["speed_limit"] == "80"


_PRIMITIVES = ("<node", "<way ", "<rela")


@pytest.mark.parametrize(
    ("kind", "width", "is_thick"),
    [
        ("line_thick", "", True),
        ("line_thin", "", None),
        ("line_thick", "0.25", None),
        ("line_thin", "0.12", None),
        ("line_thick", "0.12", True),
        ("line_thin", "0.25", False),
    ],
)
def test_thick_and_thin_are_kept_as_they_were(kind: str, width: str, is_thick: bool | None) -> None:
    tags = {"type": kind, "subtype": "dashed"} | ({"width": width} if width else {})
    found = line_fields(tags)
    assert found is not None
    element_type, fields, changed = found
    assert (element_type, fields["is_thick"], changed) == (LaneMark, is_thick, "")
    mark = element_type(id="m", geometry=LineString([(0, 0, 0), (1, 0, 0)]), **fields)
    assert line_tags(mark) == {"hdmap_id": "m", **tags}


@pytest.mark.realdata
def test_a_real_map_keeps_its_kinds_of_line(data_root: Path, tmp_path: Path) -> None:
    source = data_root / "lanelet2" / "mapping_example.osm"
    write_lanelet2(read_lanelet2(source), tmp_path / "copy.osm")

    def kinds(path: Path) -> Counter[tuple[str, str | None]]:
        ways = read_osm(path).ways.values()
        return Counter(
            (w.tags["type"], w.tags.get("subtype"))
            for w in ways
            if w.tags.get("type") in ("line_thick", "line_thin")
        )

    before, after = kinds(source), kinds(tmp_path / "copy.osm")
    assert before["line_thick", "dashed"] == 50
    # Bike marks, which we know no type for, become thin lines without more.
    assert {k: after[k] for k in before if k[0] == "line_thick"} == {
        k: n for k, n in before.items() if k[0] == "line_thick"
    }


def test_centerline_that_is_not_the_middle_is_kept(frame: MapFrame, tmp_path: Path) -> None:
    left, right = (LaneMark(id=str(y), geometry=line((0, y), (20, y))) for y in (3, 0))
    shifted = Lanelet(
        id="lane", geometry=line((0, 1), (9, 1.2), (20, 1)), left_id="3", right_id="0",
        tags={"location": "urban"},
    )  # fmt: skip
    vector_map = VectorMap(frame, (left, right, shifted))
    write_lanelet2(vector_map, tmp_path / "a.osm")
    assert_same(vector_map, read_lanelet2(tmp_path / "a.osm"), 1e-5)


def test_lanelet_of_subtype_crosswalk_stays_a_lanelet(frame: MapFrame, tmp_path: Path) -> None:
    left, right = (LaneMark(id=str(y), geometry=line((0, y), (20, y))) for y in (3, 0))
    tags = {"location": "urban"}
    vector_map = VectorMap(
        frame, (left, right, lanelet("lane", left, right, subtype="crosswalk", tags=tags))
    )
    write_lanelet2(vector_map, tmp_path / "a.osm")
    assert_same(vector_map, read_lanelet2(tmp_path / "a.osm"), 1e-5)


coordinate = st.integers(-5_000_000, 5_000_000).map(lambda mm: mm / 1000)
points = st.lists(
    st.tuples(coordinate, coordinate, st.floats(-100, 3000)),
    min_size=2, max_size=5, unique_by=lambda p: p[:2],
)  # fmt: skip
marks = st.builds(
    lambda xyz, **fields: LaneMark(geometry=LineString(xyz), **fields),
    points,
    style=st.sampled_from(MarkStyle),
    color=st.sampled_from(MarkColor),
    width_m=st.none() | st.floats(0.01, 1.0),
    confidence=st.floats(0, 1),
    sigma_m=st.floats(0, 10),
    num_observations=st.integers(0, 10**6),
    plugin=st.text(
        st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=9
    ).filter(lambda s: not set(s) & {"\ufffe", "\uffff"}),
)


@given(
    elements=st.lists(marks, max_size=4),
    lat=st.floats(-75, 75), lon=st.floats(-179.9, 179.9),
)  # fmt: skip
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_marks_come_back(
    elements: list[LaneMark], lat: float, lon: float, tmp_path: Path
) -> None:
    vector_map = VectorMap(MapFrame.from_origin(lat, lon)).with_elements(elements)
    write_lanelet2(vector_map, tmp_path / "a.osm", overwrite=True)
    assert_same(vector_map, read_lanelet2(tmp_path / "a.osm"), 1e-3)


@given(
    xy=st.lists(
        st.tuples(st.integers(-9000, 9000), st.integers(-9000, 9000)), min_size=3, max_size=12
    ),
    is_hull=st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_split_crosswalk_keeps_every_vertex(xy: list[tuple[int, int]], is_hull: bool) -> None:
    corners = [(x / 1000, y / 1000) for x, y in xy]
    shape = MultiPoint(corners).convex_hull if is_hull else Polygon(corners)
    assume(isinstance(shape, Polygon) and shape.is_valid and shape.area > 0.5)
    assume(len(set(shape.exterior.coords)) == len(shape.exterior.coords) - 1)
    shape = shapely.force_3d(shape, 1.5)
    sides = split_crosswalk(shape)
    assert sides is not None
    left, right = sides
    assert min(len(left), len(right)) >= 2
    assert are_reversed(left, right) == (False, False)
    assert not set(map(tuple, left)) & set(map(tuple, right))
    ring = shapely.get_coordinates(shape.exterior, include_z=True)[:-1]
    assert set(map(tuple, ring)) <= set(map(tuple, np.concatenate(sides)))
    again = Polygon(np.concatenate([right, left[::-1]]))
    assert again.symmetric_difference(shape).area < 1e-9


def test_split_crosswalk_cuts_the_short_ends() -> None:
    left, right = split_crosswalk(polygon([(0, 0), (12, 0), (12, 4), (6, 4.2), (0, 4)])) or ((), ())
    sides = {tuple(p[:2] for p in map(tuple, side)) for side in (left, right)}
    bottom, top = ((0, 0), (12, 0)), ((0, 4), (6, 4.2), (12, 4))
    assert sides in ({bottom, top}, {bottom[::-1], top[::-1]})


def test_same_map_same_bytes(vector_map: VectorMap, tmp_path: Path) -> None:
    write_lanelet2(vector_map, tmp_path / "a.osm")
    shuffled = list(vector_map.elements)
    random.Random(3).shuffle(shuffled)
    again = VectorMap(vector_map.frame, tuple(shuffled), vector_map.provenance)
    write_lanelet2(again, tmp_path / "b.osm")
    assert (tmp_path / "a.osm").read_bytes() == (tmp_path / "b.osm").read_bytes()


def test_empty_and_no_origin_and_existing(
    frame: MapFrame, elements: tuple[MapElement, ...], tmp_path: Path
) -> None:
    path = tmp_path / "a.osm"
    with pytest.raises(NoOriginError, match="--origin"):
        write_lanelet2(VectorMap(MapFrame(), elements), path)
    assert list(tmp_path.iterdir()) == []
    write_lanelet2(VectorMap(frame), path)
    assert len(read_lanelet2(path)) == 0
    with pytest.raises(OutputExistsError):
        write_lanelet2(VectorMap(frame, elements), path)
    assert len(read_lanelet2(path)) == 0


def test_failure_keeps_the_old_file(
    vector_map: VectorMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.osm"
    write_lanelet2(vector_map, path)
    before = path.read_bytes()
    real = lanelet2_write.to_xml
    monkeypatch.setattr(lanelet2_write, "to_xml", lambda d: real(d)[:-200])
    with pytest.raises(FormatError, match="not well-formed"):
        write_lanelet2(vector_map, path, overwrite=True)
    monkeypatch.setattr(lanelet2_write, "to_xml", lambda d: real(d).replace("dashed", "solid"))
    with pytest.raises(FormatError, match="did not come back"):
        write_lanelet2(vector_map, path, overwrite=True)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.osm"]


def _refused(frame: MapFrame, *elements: MapElement) -> str:
    with pytest.raises(FormatError) as caught:
        to_osm(VectorMap(frame, elements))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_breaks_a_rule_is_refused_by_name(
    frame: MapFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mark(name: str, *xy: tuple[float, float]) -> LaneMark:
        return LaneMark(id=name, geometry=line(*xy))

    assert "lane_mark 'twice' has the same point" in _refused(
        frame, mark("twice", (0, 0), (1, 0), (1, 0), (2, 0))
    )
    assert "lane_mark 'tiny'" in _refused(frame, mark("tiny", (0, 0), (1e-8, 0)))
    repeated = polygon([(0, 0), (4, 0), (4, 0), (4, 3)])
    assert "sidewalk_area 'area'" in _refused(frame, SidewalkArea(id="area", geometry=repeated))
    assert "lane_mark 'far': 1 points have no place" in _refused(
        frame, mark("far", (0, 0), (1e12, 0))
    )
    left, right = mark("l", (0, 3), (20, 3)), mark("r", (0, 0), (20, 0))
    lane = lanelet("lane", left, right)
    assert "'lane': its right bound 'r' is no line" in _refused(frame, left, lane)
    center = Centerline(id="r", geometry=right.geometry)
    assert "'lane': its right bound 'r' is no line" in _refused(frame, left, center, lane)
    swapped = lane.model_copy(update={"left_id": "r", "right_id": "l"})
    assert "are left and right swapped?" in _refused(frame, left, right, swapped)
    same = lane.model_copy(update={"right_id": "l"})
    assert "'l' is its left and its right bound" in _refused(frame, left, right, same)
    tagged = lane.model_copy(update={"tags": {"type": "x"}})
    assert "the tag 'type'" in _refused(frame, left, right, tagged)
    ring = mark("ring", (0, 3), (10, 9), (20, 3)), mark("low", (0, 3), (10, 0), (20, 3))
    both_ends = lanelet("eye", *ring)
    assert "'eye'" in _refused(frame, *ring, both_ends)
    crossing = Crosswalk(id="maze", geometry=polygon([(0, 0), (9, 0), (9, 4), (0, 4)]))
    monkeypatch.setattr(lanelet2_write, "split_crosswalk", lambda _: None)
    assert "crosswalk 'maze' has no two sides" in _refused(frame, crossing)
    control = left.model_copy(update={"plugin": "a\x01"})
    with pytest.raises(FormatError, match="which XML cannot"):
        write_lanelet2(VectorMap(frame, (control,)), tmp_path / "a.osm")
    assert list(tmp_path.iterdir()) == []


def test_what_is_lost_is_counted(frame: MapFrame, caplog: pytest.LogCaptureFixture) -> None:
    holed = polygon([(0, 0), (9, 0), (9, 4), (0, 4)], [(2, 1), (3, 1), (3, 2)])
    left, right = (LaneMark(id=str(y), geometry=line((0, y), (20, y))) for y in (13, 10))
    lane = lanelet("lane", left, right, successor_ids=("elsewhere",))
    to_osm(VectorMap(frame, (Crosswalk(id="c", geometry=holed), left, right, lane)))
    assert "1 hole of a crosswalk" in caplog.text
    assert "1 successor whose bounds do not meet" in caplog.text
    caplog.clear()
    to_osm(VectorMap(frame, (LaneMark(id="m", geometry=line((0, 0), (0.01, 0), (5, 0))),)))
    assert "1 pairs of consecutive points" in caplog.text


def test_lane_that_begins_in_a_point_is_kept(frame: MapFrame, tmp_path: Path) -> None:
    left = LaneMark(id="l", geometry=line((0, 0), (10, 3), (20, 3)))
    right = RoadBoundary(id="r", geometry=line((0, 0), (10, 0), (20, 0)))
    vector_map = VectorMap(
        frame, (left, right, lanelet("lane", left, right, tags={"location": "urban"}))
    )
    write_lanelet2(vector_map, tmp_path / "a.osm")
    assert_same(vector_map, read_lanelet2(tmp_path / "a.osm"), 1e-5)


@pytest.mark.parametrize("corners", [[(0, 0), (9, 0), (0, 4)], [(9, 4), (1, 4), (9, 1), (6, 3)]])
def test_triangle_and_dart_get_a_vertex_and_keep_their_shape(
    corners: list[tuple[float, float]], frame: MapFrame, tmp_path: Path
) -> None:
    shape = polygon(corners)
    write_lanelet2(VectorMap(frame, (Crosswalk(id="c", geometry=shape),)), tmp_path / "a.osm")
    found = read_lanelet2(tmp_path / "a.osm").elements[0].geometry
    assert found.symmetric_difference(shape).area < 1e-4


def test_document_rules_are_checked(vector_map: VectorMap) -> None:
    from dataclasses import replace

    document = to_osm(vector_map)
    way = next(iter(document.ways.values()))
    lane = next(r for r in document.relations.values() if r.tags["subtype"] == "road")
    left = lane.members[0]
    broken = {
        "two points": replace(way, node_ids=way.node_ids[:1]),
        "node 999 does not exist": replace(way, node_ids=(999, *way.node_ids)),
        "two points in a row": replace(way, node_ids=(way.node_ids[0], *way.node_ids)),
        "'type' is missing": replace(way, tags={}),
        "one left and one right": replace(lane, members=(left, left)),
        "no role 'outer'": replace(lane, members=(*lane.members, replace(left, role="outer"))),
        "share the point": replace(lane, members=(left, replace(left, role="right"))),
        "'location' is missing": replace(lane, tags={"type": "lanelet", "subtype": "road"}),
        "is none that Lanelet2 knows": replace(lane, tags={"type": "route"}),
        "way 5000 does not exist": replace(lane, members=(replace(left, ref=5000),)),
    }
    for says, primitive in broken.items():
        layer = "ways" if primitive.id == way.id else "relations"
        changed = {**getattr(document, layer), primitive.id: primitive}
        with pytest.raises(FormatError, match=says):
            require_valid_lanelet2(replace(document, **{layer: changed}))
    for ident in (0, -3, 2**63, way.id):
        node = replace(document.nodes[1], id=ident)
        with pytest.raises(FormatError, match="positive, unique"):
            require_valid_lanelet2(replace(document, nodes={**document.nodes, -1: node}))
    for lat in (float("nan"), 91.0):
        bad = {**document.nodes, 1: replace(document.nodes[1], lat=lat)}
        with pytest.raises(FormatError, match="is not latitude"):
            require_valid_lanelet2(replace(document, nodes=bad))
