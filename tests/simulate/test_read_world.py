"""Maps as worlds: made ones with known truth, and recorded ones against the libraries of others."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from lxml import etree

from hdmap_tools.errors import FormatError, WorldError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.simulate.lane_links import MAX_GAP_M
from hdmap_tools.simulate.read_world import read_world, shipped_world
from hdmap_tools.simulate.world_map import LineKind, WorldMap

ORIGIN = (49.0, 8.4, 0.0)
FRAME = MapFrame.from_origin(*ORIGIN)
Tags = dict[str, str]


class OsmFile:
    """A Lanelet2 file made by hand; every way has its own nodes unless they are at one place."""

    def __init__(self) -> None:
        self.nodes: dict[tuple[float, float], int] = {}
        self.body: list[str] = []
        self.count = 0

    def new_id(self) -> int:
        self.count += 1
        return self.count

    def way(self, points: list[tuple[float, float]], **tags: str) -> int:
        for point in points:
            self.nodes.setdefault(point, 0)
            self.nodes[point] = self.nodes[point] or self.new_id()
        refs = "".join(f"<nd ref='{self.nodes[p]}'/>" for p in points)
        return self._add("way", refs, tags)

    def lanelet(self, left: int, right: int, **tags: str) -> int:
        members = "".join(
            f"<member type='way' ref='{ref}' role='{role}'/>"
            for ref, role in ((left, "left"), (right, "right"))
        )
        given = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}
        return self._add("relation", members, {**given, **tags})

    def area(self, outer: list[int], **tags: str) -> int:
        members = "".join(f"<member type='way' ref='{ref}' role='outer'/>" for ref in outer)
        return self._add("relation", members, {"type": "multipolygon", **tags})

    def _add(self, kind: str, inside: str, tags: Tags) -> int:
        identifier = self.new_id()
        written = "".join(f"<tag k='{k}' v='{v}'/>" for k, v in tags.items())
        self.body.append(f"<{kind} id='{identifier}'>{inside}{written}</{kind}>")
        return identifier

    def write(self, path: Path, is_local: bool = False) -> Path:
        lines = ["<osm version='0.6'>"]
        for (x, y), identifier in self.nodes.items():
            lon, lat, _ = FRAME.to_wgs84(np.array([[x, y, 0.0]]))[0]
            tags = ""
            if is_local:
                lat = lon = 0.0
                tags = f"<tag k='local_x' v='{x}'/><tag k='local_y' v='{y}'/>"
            at = f"lat='{lat:.11f}' lon='{lon:.11f}'"
            lines.append(f"<node id='{identifier}' {at}>{tags}</node>")
        path.write_text("\n".join([*lines, *self.body, "</osm>"]))
        return path


def road(osm: OsmFile, x0: float, x1: float, y: float = 0.0, **tags: str) -> int:
    """A lanelet 3 m wide, eastwards, from x0 to x1; its right bound is at y."""
    left = osm.way([(x0, y + 3.0), (x1, y + 3.0)], type="virtual")
    right = osm.way([(x0, y), (x1, y)], type="virtual")
    return osm.lanelet(left, right, **tags)


def read(osm: OsmFile, tmp_path: Path) -> WorldMap:
    return read_world(osm.write(tmp_path / "made.osm"), ORIGIN)


# Lanelet2, made


@pytest.mark.parametrize("turn_left", [False, True])
@pytest.mark.parametrize("turn_right", [False, True])
def test_bounds_run_in_driving_direction_however_the_ways_run(
    tmp_path: Path, turn_left: bool, turn_right: bool
) -> None:
    osm = OsmFile()
    left = [(0.0, 3.0), (20.0, 3.5), (40.0, 3.0)]
    right = [(0.0, 0.0), (40.0, 0.0)]
    ways = osm.way(left[:: -1 if turn_left else 1]), osm.way(right[:: -1 if turn_right else 1])
    identifier = osm.lanelet(*ways)
    lane = read(osm, tmp_path).lanes[str(identifier)]
    np.testing.assert_allclose(lane.left, left, atol=2e-5)
    np.testing.assert_allclose(lane.right, right, atol=2e-5)
    assert (lane.left_line, lane.right_line) == (str(ways[0]), str(ways[1]))


LINES: list[tuple[Tags, LineKind, dict[str, Any] | None]] = [
    ({"type": "line_thin", "subtype": "solid"}, LineKind.PAINT, {"width_m": 0.12}),
    ({"type": "line_thin"}, LineKind.PAINT, {"style": MarkStyle.SOLID}),
    (
        {"type": "line_thin", "subtype": "dashed"},
        LineKind.PAINT,
        {"style": MarkStyle.DASHED, "width_m": 0.12, "dash_m": 3.0, "gap_m": 6.0},
    ),
    (
        {"type": "line_thick", "subtype": "solid_solid", "color": "yellow"},
        LineKind.PAINT,
        {"style": MarkStyle.SOLID_SOLID, "color": MarkColor.YELLOW, "width_m": 0.25},
    ),
    (
        {"type": "line_thin", "subtype": "dashed_solid"},
        LineKind.PAINT,
        {"style": MarkStyle.DASHED_SOLID},
    ),
    (
        {"type": "line_thin", "subtype": "solid_dashed"},
        LineKind.PAINT,
        {"style": MarkStyle.SOLID_DASHED},
    ),
    ({"type": "line_thin", "width": "0.2"}, LineKind.PAINT, {"width_m": 0.2}),
    ({"type": "line_thin", "width": "nan"}, LineKind.PAINT, {"width_m": 0.12}),
    ({"type": "line_thin", "color": "pink"}, LineKind.PAINT, {"color": MarkColor.WHITE}),
    ({"type": "curbstone", "subtype": "high"}, LineKind.KERB_HIGH, None),
    ({"type": "curbstone"}, LineKind.KERB_HIGH, None),
    ({"type": "curbstone", "subtype": "low"}, LineKind.KERB_LOW, None),
    ({"type": "road_border"}, LineKind.EDGE, None),
    ({"type": "fence"}, LineKind.FENCE, None),
    ({"type": "wall"}, LineKind.WALL, None),
    ({"type": "jersey_barrier"}, LineKind.WALL, None),
    ({"type": "guard_rail"}, LineKind.GUARD_RAIL, None),
    ({"type": "virtual", "subtype": "dashed"}, LineKind.VIRTUAL, None),
]


@pytest.mark.parametrize(("tags", "kind", "paint"), LINES)
def test_a_line_is_what_its_tags_say(
    tmp_path: Path, tags: Tags, kind: LineKind, paint: dict[str, Any] | None
) -> None:
    osm = OsmFile()
    road(osm, 0.0, 40.0)
    way = osm.way([(0.0, 9.0), (30.0, 9.0)], **tags)
    (line,) = [line for line in read(osm, tmp_path).lines if line.id == str(way)]
    assert line.kind is kind
    assert (line.paint is None) == (paint is None)
    for name, value in (paint or {}).items():
        assert getattr(line.paint, name) == value


def test_what_is_not_on_the_ground_is_no_line(tmp_path: Path) -> None:
    osm = OsmFile()
    road(osm, 0.0, 40.0)
    for number, kind in enumerate(("traffic_sign", "traffic_light", "stop_line", "rail")):
        osm.way([(0.0, 9.0 + number), (30.0, 9.0 + number)], type=kind)
    world = read(osm, tmp_path)
    assert {line.kind for line in world.lines} == {LineKind.VIRTUAL}
    (stop,) = world.stop_lines
    np.testing.assert_allclose(stop.coords, [(0.0, 11.0), (30.0, 11.0)], atol=2e-5)


def test_a_lanelet_of_both_directions_is_two_lanes(tmp_path: Path) -> None:
    osm = OsmFile()
    a = road(osm, 0.0, 40.0, one_way="no")
    b = road(osm, 40.0, 80.0)
    lanes = read(osm, tmp_path).lanes
    assert set(lanes) == {f"{a}", f"{a}~", f"{b}"}
    forth, back = lanes[f"{a}"], lanes[f"{a}~"]
    np.testing.assert_array_equal(back.left, forth.right[::-1])
    np.testing.assert_array_equal(back.right, forth.left[::-1])
    assert (back.left_line, back.right_line) == (forth.right_line, forth.left_line)
    assert forth.successors == (f"{b}",)
    assert back.successors == ()


@pytest.mark.parametrize(
    ("gap_m", "is_joined"), [(0.0, True), (0.4, True), (MAX_GAP_M + 0.1, False)]
)
def test_lanes_join_across_small_gaps(tmp_path: Path, gap_m: float, is_joined: bool) -> None:
    osm = OsmFile()
    a, b = road(osm, 0.0, 40.0), road(osm, 40.0 + gap_m, 80.0)
    assert read(osm, tmp_path).lanes[f"{a}"].successors == ((f"{b}",) if is_joined else ())


def test_lanes_do_not_join_lanes_that_come_the_other_way(tmp_path: Path) -> None:
    osm = OsmFile()
    a = road(osm, 0.0, 40.0)
    left = osm.way([(80.0, 0.1), (40.1, 0.1)])
    right = osm.way([(80.0, 3.1), (40.1, 3.1)])
    osm.lanelet(left, right)
    assert read(osm, tmp_path).lanes[f"{a}"].successors == ()


def test_a_lane_for_vehicles_does_not_lead_into_one_for_bicycles(tmp_path: Path) -> None:
    osm = OsmFile()
    a, b = road(osm, 0.0, 40.0), road(osm, 40.0, 80.0, subtype="bicycle_lane")
    world = read(osm, tmp_path)
    assert world.lanes[f"{b}"].kind == "bicycle"
    assert world.lanes[f"{a}"].successors == ()


def crossing_lines(x: float, y0: float, y1: float) -> list[list[tuple[float, float]]]:
    return [[(x, y0), (x, y1)], [(x + 4.0, y1), (x + 4.0, y0)]]


@pytest.mark.parametrize("kind", ["zebra_marking", "pedestrian_marking"])
@pytest.mark.parametrize("is_lanelet", [False, True])
def test_crossings_of_lanelets_and_of_pairs_of_lines(
    tmp_path: Path, kind: str, is_lanelet: bool
) -> None:
    osm = OsmFile()
    road(osm, 0.0, 40.0)
    right, left = (osm.way(points, type=kind) for points in crossing_lines(20.0, -0.5, 3.5))
    if is_lanelet:
        osm.lanelet(left, right, subtype="crosswalk", one_way="no")
    (crossing,) = read(osm, tmp_path).crosswalks
    assert crossing.normalize().equals_exact(crossing.envelope.normalize(), 1e-3)
    np.testing.assert_allclose(crossing.bounds, (20.0, -0.5, 24.0, 3.5), atol=1e-4)


def test_footpaths_marked_like_crossings_are_none(tmp_path: Path) -> None:
    osm = OsmFile()
    road(osm, 0.0, 40.0)
    for points in crossing_lines(20.0, 5.0, 9.0):
        osm.way(points, type="pedestrian_marking")
    right, left = (osm.way(p, type="virtual") for p in crossing_lines(20.0, 15.0, 19.0))
    osm.lanelet(left, right, subtype="crosswalk", one_way="no")
    world = read(osm, tmp_path)
    assert world.crosswalks == ()
    assert world.areas["sidewalk"][0].area == pytest.approx(16.0, abs=0.01)


def test_areas_go_by_what_they_are(tmp_path: Path) -> None:
    osm = OsmFile()
    road(osm, 0.0, 40.0)
    kinds = {
        "building": "building",
        "vegetation": "vegetation",
        "walkway": "sidewalk",
        "traffic_island": "island",
        "parking": "drivable",
    }
    for number, subtype in enumerate(kinds):
        y = 10.0 * (number + 1)
        halves = [[(0.0, y), (5.0, y), (5.0, y + 5.0)], [(0.0, y), (0.0, y + 5.0), (5.0, y + 5.0)]]
        osm.area([osm.way(points) for points in halves], subtype=subtype)
    osm.area([osm.way([(0.0, 90.0), (5.0, 90.0), (5.0, 95.0)])], subtype="building")  # open
    areas = read(osm, tmp_path).areas
    assert set(areas) == set(kinds.values())
    for polygons in areas.values():
        assert [p.area for p in polygons] == pytest.approx([25.0], abs=0.01)


@pytest.mark.parametrize(
    ("text", "mps"),
    [("50", 50 / 3.6), ("30 km/h", 30 / 3.6), ("15mph", 6.7056), ("10 m/s", 10.0), ("fast", None)],
)
def test_speed_limits(tmp_path: Path, text: str, mps: float | None) -> None:
    osm = OsmFile()
    a = road(osm, 0.0, 40.0, speed_limit=text)
    assert read(osm, tmp_path).lanes[f"{a}"].speed_limit_mps == pytest.approx(mps)


def test_without_origin_the_city_frame_lies_in_the_middle(tmp_path: Path) -> None:
    osm = OsmFile()
    road(osm, 100.0, 140.0)
    (lane,) = read_world(osm.write(tmp_path / "made.osm")).lanes.values()
    np.testing.assert_allclose(lane.left[[0, -1], 0], [-20.0, 20.0], atol=0.02)
    np.testing.assert_allclose(lane.left[:, 1], 1.5, atol=0.02)


def test_local_coordinates_need_an_origin(tmp_path: Path) -> None:
    osm = OsmFile()
    road(osm, 100.0, 140.0)
    path = osm.write(tmp_path / "made.osm", is_local=True)
    with pytest.raises(WorldError, match="--origin"):
        read_world(path)
    (lane,) = read_world(path, ORIGIN).lanes.values()
    np.testing.assert_array_equal(lane.right, [(100.0, 0.0), (140.0, 0.0)])
    path.write_text(path.read_text().replace("v='100.0'", "v='nan'", 1))
    with pytest.raises(WorldError, match="finite metres"):
        read_world(path, ORIGIN)


def test_lanelets_with_a_broken_bound_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    osm = OsmFile()
    a = road(osm, 0.0, 40.0)
    osm.lanelet(osm.way([(0.0, 9.0), (40.0, 9.0)]), 999_999)
    osm.lanelet(osm.way([(0.0, 20.0)]), osm.way([(0.0, 17.0), (40.0, 17.0)]))
    assert set(read(osm, tmp_path).lanes) == {f"{a}"}
    assert "2 lanelets without two whole bounds" in caplog.text


# What is no world


def test_files_that_are_no_world(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="demo_town"):
        read_world(tmp_path / "none.osm")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(WorldError, match="none of the maps"):
        read_world(tmp_path / "a.txt")
    with pytest.raises(WorldError, match="holds 0 files"):
        read_world(tmp_path)
    (tmp_path / "b.osm").write_text("<osm version='0.6'></osm>")
    with pytest.raises(WorldError, match="no lanes"):
        read_world(tmp_path / "b.osm")
    with pytest.raises(WorldError, match="demo_town"):
        shipped_world("atlantis")


def test_only_lanes_for_walking_are_no_world(tmp_path: Path) -> None:
    osm = OsmFile()
    road(osm, 0.0, 40.0, subtype="walkway")
    with pytest.raises(WorldError, match="1 lanes, none of them for vehicles"):
        read(osm, tmp_path)


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.999])
def test_a_truncated_map_is_refused(tmp_path: Path, kept: float) -> None:
    text = shipped_world().read_text(encoding="utf-8")
    path = tmp_path / "cut.osm"
    path.write_text(text[: int(kept * len(text))], encoding="utf-8")
    with pytest.raises(FormatError, match=r"cut\.osm"):
        read_world(path)


# Argoverse 2, made


def av2_line(points: list[tuple[float, float]]) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": 0.0} for x, y in points]


def av2_lane(
    identifier: int, x0: float, y: float, successors: list[int], **more: Any
) -> dict[str, Any]:
    return {
        "id": identifier,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": av2_line([(x0, y + 3.0), (x0 + 40.0, y + 3.0)]),
        "right_lane_boundary": av2_line([(x0, y), (x0 + 40.0, y)]),
        "left_lane_mark_type": "NONE",
        "right_lane_mark_type": "NONE",
        "successors": successors,
        **more,
    }


@pytest.fixture
def av2_map() -> dict[str, Any]:
    lanes = [
        av2_lane(1, 0.0, 0.0, [3, 77], left_lane_mark_type="DASHED_WHITE"),
        av2_lane(2, 0.0, 3.0, [], left_lane_mark_type="DOUBLE_SOLID_YELLOW"),
        av2_lane(3, 40.0, 0.0, [], lane_type="BUS", is_intersection=True),
        av2_lane(4, 40.0, 3.0, [], lane_type="BIKE"),
    ]
    edges = {"edge1": av2_line([(10, 0), (10, 6)]), "edge2": av2_line([(13, 6), (13, 0)])}
    whole = av2_line([(0, 0), (80, 0), (80, 6), (0, 6)])
    return {
        "lane_segments": {str(lane["id"]): lane for lane in lanes},
        "pedestrian_crossings": {"9": {"id": 9, **edges}},
        "drivable_areas": {"8": {"id": 8, "area_boundary": whole}},
    }


def write_av2(document: Any, folder: Path, city: str = "PIT") -> Path:
    path = folder / f"log_map_archive_made____{city}_city_1.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def test_an_av2_map(av2_map: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    path = write_av2(av2_map, tmp_path / "map")
    world = read_world(path)
    for folder in (tmp_path, tmp_path / "map"):
        assert read_world(folder).lanes.keys() == world.lanes.keys()
    lanes = world.lanes
    assert [lane.kind for lane in lanes.values()] == ["road", "road", "road", "bicycle"]
    assert lanes["1"].successors == ("3",)
    # The lane divider and the double line stand once, in the paint of the map.
    assert lanes["1"].left_line == lanes["2"].right_line == "1:left"
    paints = {line.id: line.paint for line in world.lines if line.kind is LineKind.PAINT}
    assert set(paints) == {"1:left", "2:left"}
    divider, middle = paints["1:left"], paints["2:left"]
    assert divider is not None
    assert middle is not None
    assert (divider.style, divider.color) == (MarkStyle.DASHED, MarkColor.WHITE)
    assert (middle.style, middle.color) == (MarkStyle.SOLID_SOLID, MarkColor.YELLOW)
    (crossing,) = world.crosswalks
    assert crossing.equals(shapely.box(10, 0, 13, 6))
    (surface,) = world.areas["drivable"]
    assert surface.area == 480.0
    # The kerbs run along the road and are open where its lanes come in and lead out.
    kerbs = shapely.union_all(
        [shapely.LineString(k.xy) for k in world.lines if k.kind is LineKind.KERB_HIGH]
    )
    assert kerbs.distance(shapely.Point(40.0, 0.0)) == 0.0
    assert kerbs.distance(shapely.Point(40.0, 6.0)) == 0.0
    assert kerbs.distance(shapely.Point(0.0, 3.0)) > 1.0
    assert kerbs.distance(shapely.Point(80.0, 3.0)) > 1.0
    lon, lat, _ = world.frame.to_wgs84(np.zeros((1, 3)))[0]
    assert (lat, lon) == pytest.approx((40.44177902989321, -80.01294377242584), abs=1e-7)


def test_an_av2_map_of_no_known_city_needs_an_origin(
    av2_map: dict[str, Any], tmp_path: Path
) -> None:
    path = write_av2(av2_map, tmp_path, "XYZ")
    with pytest.raises(WorldError, match="--origin"):
        read_world(path)
    assert read_world(path, ORIGIN).frame == FRAME


def _without(document: dict[str, Any], key: str) -> Any:
    return {k: v for k, v in document.items() if k != key}


def test_damaged_av2_maps_are_refused(av2_map: dict[str, Any], tmp_path: Path) -> None:
    text = json.dumps(av2_map)
    nan = text.replace("40.0", "NaN", 1)
    damaged: list[Any] = ["", text[: len(text) // 2], "[]", "{}", "3", nan, "[" * 100_000]
    damaged += [_without(av2_map, key) for key in av2_map]
    damaged += [text.replace("NaN", "x").replace('"x": 0.0', '"x": "a"'), '{"lane_segments": [1]}']
    for document in damaged:
        with pytest.raises(FormatError, match="no usable Argoverse 2 map"):
            read_world(write_av2(document, tmp_path))
    (tmp_path / "log_map_archive_made____PIT_city_1.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError):
        read_world(tmp_path)


# Real maps, with the libraries of others as judges

LANELET2_FILES = (
    "lanelet2/mapping_example.osm",
    "interaction/DR_DEU_Roundabout_OF.osm",
    "interaction/DR_USA_Intersection_EP0.osm",
    "interaction/DR_USA_Intersection_MA.osm",
)
AV2_LOGS = ("7fab2350-7eaf-3b7e-a39d-6937a4c1bede", "3bffdcff-c3a7-38b6-a0f2-64196d130958")


@pytest.mark.realdata
@pytest.mark.parametrize("name", LANELET2_FILES)
def test_lanes_are_those_of_the_lanelet2_library(
    data_root: Path, tmp_path: Path, name: str
) -> None:
    judge_by_lanelet2(data_root / name, tmp_path)


def test_lanes_of_the_shipped_world_are_those_of_the_lanelet2_library(tmp_path: Path) -> None:
    judge_by_lanelet2(shipped_world(), tmp_path)


def without_patched_bounds(path: Path, folder: Path) -> tuple[Path, set[str]]:
    """A copy without the lanelets whose bound is several ways, and their ids.

    The library makes lanelets without bounds of them, and crashes when it routes.
    """
    tree = etree.parse(str(path))
    patched = {
        relation.get("id")
        for relation in tree.getroot().findall("relation")
        if relation.find("tag[@k='type'][@v='lanelet']") is not None
        and any(len(relation.findall(f"member[@role='{r}']")) != 1 for r in ("left", "right"))
    }
    for relation in tree.getroot().findall("relation"):
        if relation.get("id") in patched:
            tree.getroot().remove(relation)
        for member in relation.findall("member[@type='relation']"):
            if member.get("ref") in patched:
                relation.remove(member)
    tree.write(str(folder / "judged.osm"))
    return folder / "judged.osm", patched


def judge_by_lanelet2(path: Path, tmp_path: Path) -> None:
    lanelet2 = pytest.importorskip("lanelet2", reason="no lanelet2 wheel for this platform")
    world = read_world(path)
    lon, lat, _ = world.frame.to_wgs84(np.zeros((1, 3)))[0]
    projector = lanelet2.projection.LocalCartesianProjector(lanelet2.io.Origin(lat, lon))
    judged, left_out = without_patched_bounds(path, tmp_path)
    loaded, errors = lanelet2.io.loadRobust(str(judged), projector)
    assert list(errors) == []

    def city(bound: Any) -> np.ndarray:
        gps = [projector.reverse(lanelet2.core.BasicPoint3d(p.x, p.y, p.z)) for p in bound]
        return world.frame.from_wgs84(np.array([(g.lon, g.lat, 0.0) for g in gps]))[:, :2]

    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    num_judged = num_followed = num_bridged = 0
    for lanelet in loaded.laneletLayer:
        if not rules.canPass(lanelet):
            continue
        for driven, name in ((lanelet, f"{lanelet.id}"), (lanelet.invert(), f"{lanelet.id}~")):
            if driven is not lanelet and rules.isOneWay(lanelet):
                assert name not in world.lanes
                continue
            lane = world.lanes[name]
            assert lane.kind == "road"
            for ours, theirs in ((lane.left, driven.leftBound), (lane.right, driven.rightBound)):
                distinct = city(theirs)
                apart = np.linalg.norm(np.diff(distinct, axis=0), axis=1) > 1e-6
                distinct = distinct[np.concatenate([[True], apart])]
                np.testing.assert_allclose(ours, distinct, atol=2e-3)
            followed = {
                f"{other.id}" + ("~" if other.inverted() else "")
                for other in graph.following(driven)
            }
            assert followed <= set(lane.successors)
            # What we add lies, by both ends, within the gap we bridge, and only at dead ends.
            for other in set(lane.successors) - followed - left_out:
                assert not followed
                ahead = world.lanes[other]
                assert np.hypot(*(ahead.left[0] - lane.left[-1])) <= MAX_GAP_M
                assert np.hypot(*(ahead.right[0] - lane.right[-1])) <= MAX_GAP_M
                num_bridged += 1
            num_followed += len(followed)
            num_judged += 1
    roads = [lane for lane in world.lanes.values() if lane.kind == "road"]
    assert left_out <= set(world.lanes)
    assert num_judged >= 40
    assert num_judged >= 0.9 * len(roads)
    assert num_followed > 0.8 * num_judged
    assert num_bridged <= 0.02 * num_judged


@pytest.mark.realdata
@pytest.mark.parametrize("log", AV2_LOGS)
def test_lanes_are_those_of_the_av2_package(data_root: Path, log: str) -> None:
    map_api = pytest.importorskip("av2.map.map_api", reason="no av2 wheel for this platform")
    folder = data_root / "av2" / log / "map"
    theirs = map_api.ArgoverseStaticMap.from_json(next(folder.glob("log_map_archive_*.json")))
    world = read_world(folder)
    assert set(world.lanes) == {str(k) for k in theirs.vector_lane_segments}
    lines = {line.id: line for line in world.lines}
    num_painted = 0
    for segment in theirs.vector_lane_segments.values():
        lane = world.lanes[str(segment.id)]
        sides = (
            (lane.left, lane.left_line, segment.left_lane_boundary, segment.left_mark_type),
            (lane.right, lane.right_line, segment.right_lane_boundary, segment.right_mark_type),
        )
        for ours, line_id, boundary, mark in sides:
            assert shapely.LineString(ours).equals(shapely.LineString(boundary.xyz[:, :2]))
            line = lines[str(line_id)]
            assert shapely.LineString(line.xy).buffer(0.31).covers(shapely.LineString(ours))
            if mark.value not in ("NONE", "UNKNOWN"):
                assert line.paint is not None
                assert line.paint.color.value == mark.value.rpartition("_")[2].lower()
                assert ("dash" in line.paint.style) == ("DASH" in mark.value)
                num_painted += 1
        kept = {str(k) for k in segment.successors if k in theirs.vector_lane_segments}
        assert set(lane.successors) == kept
        assert lane.kind == ("bicycle" if segment.lane_type.value == "BIKE" else "road")
    assert num_painted > 50
    assert len(world.crosswalks) == len(theirs.vector_pedestrian_crossings)
    for crossing in theirs.vector_pedestrian_crossings.values():
        corners = shapely.MultiPoint(crossing.polygon[:, :2])
        best = min(world.crosswalks, key=lambda area: area.hausdorff_distance(corners.convex_hull))
        assert best.hausdorff_distance(corners.convex_hull) < 0.01
    surface = shapely.union_all(
        [shapely.Polygon(a.xyz[:, :2]).buffer(0) for a in theirs.vector_drivable_areas.values()]
    )
    ours = shapely.union_all(world.areas["drivable"])
    assert ours.symmetric_difference(surface).area < 1e-3 * surface.area
