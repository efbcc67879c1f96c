"""The lanelet2 library judges what is written, and what is read from real maps."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from hdmap_tools.formats.lanelet2 import read_lanelet2, write_lanelet2
from hdmap_tools.formats.osm_xml import read_osm
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import Centerline, Crosswalk, Lanelet
from hdmap_tools.map_model.vector_map import VectorMap

from .conftest import ORIGIN

lanelet2 = pytest.importorskip("lanelet2", reason="no lanelet2 wheel for this platform")
from lanelet2.io import Origin, loadRobust  # noqa: E402
from lanelet2.projection import LocalCartesianProjector, UtmProjector  # noqa: E402


def _city_points(line: Any, projector: Any, frame: MapFrame) -> np.ndarray:
    gps = [projector.reverse(lanelet2.core.BasicPoint3d(p.x, p.y, p.z)) for p in line]
    return frame.from_wgs84(np.array([(g.lon, g.lat, g.alt) for g in gps]))


@pytest.mark.parametrize("make_projector", [UtmProjector, LocalCartesianProjector])
def test_library_loads_every_vertex_within_a_centimetre(
    vector_map: VectorMap, tmp_path: Path, make_projector: Any
) -> None:
    path = tmp_path / "a.osm"
    write_lanelet2(vector_map, path)
    projector = make_projector(Origin(*ORIGIN))
    found, errors = loadRobust(str(path), projector)
    assert list(errors) == []
    counts = vector_map.counts()
    assert len(found.laneletLayer) == counts["lanelet"] + counts["crosswalk"]
    assert len(found.areaLayer) == counts["sidewalk_area"] + counts["vegetation_area"]
    lines = {
        ls.attributes["hdmap_id"]: ls for ls in found.lineStringLayer if "hdmap_id" in ls.attributes
    }
    lanelets = {ll.attributes["hdmap_id"]: ll for ll in found.laneletLayer}
    areas = {area.attributes["hdmap_id"]: area for area in found.areaLayer}
    checked = 0
    for element in vector_map:
        if isinstance(element, Centerline):
            continue
        if isinstance(element, Lanelet):
            loaded = lanelets[element.id]
            sides = {"left": loaded.leftBound, "right": loaded.rightBound}
            assert sides["left"].attributes["hdmap_id"] == element.left_id
            assert sides["right"].attributes["hdmap_id"] == element.right_id
            assert sides["left"].inverted() == element.is_left_reversed
            assert sides["right"].inverted() == element.is_right_reversed
            continue
        expected = shapely.get_coordinates(element.geometry, include_z=True)
        if element.geometry_type == "LineString":
            seen = _city_points(lines[element.id], projector, vector_map.frame)
            assert seen.shape == expected.shape
            distance = np.linalg.norm(seen - expected, axis=1)
        else:
            if isinstance(element, Crosswalk):
                bounds = [lanelets[element.id].leftBound, lanelets[element.id].rightBound]
            else:
                inner = [ls for ring in areas[element.id].innerBounds for ls in ring]
                bounds = [*areas[element.id].outerBound, *inner]
            seen = np.concatenate([_city_points(b, projector, vector_map.frame) for b in bounds])
            assert len(np.unique(seen, axis=0)) == len(np.unique(expected, axis=0))
            distance = np.linalg.norm(expected[:, None] - seen[None], axis=2).min(axis=1)
        assert distance.max() < 0.01, element.id
        checked += len(expected)
    assert checked > 50


def test_library_drives_where_we_say(vector_map: VectorMap, tmp_path: Path) -> None:
    path = tmp_path / "a.osm"
    write_lanelet2(vector_map, path)
    found, _ = loadRobust(str(path), UtmProjector(Origin(*ORIGIN)))
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(found, rules)
    by_name = {ll.attributes["hdmap_id"]: ll for ll in found.laneletLayer}
    following = {
        name: sorted(f.attributes["hdmap_id"] for f in graph.following(ll))
        for name, ll in by_name.items()
    }
    assert following == {"lane_1": ["lane_2"], "lane_2": [], "lane_back": [], "crossing": []}
    pedestrians = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Pedestrian
    )
    assert pedestrians.canPass(by_name["crossing"])
    assert not rules.canPass(by_name["crossing"])
    crossing = shapely.Polygon([(p.x, p.y) for p in by_name["crossing"].polygon2d()])
    assert crossing.is_valid
    truth = next(e for e in vector_map if e.id == "crossing").geometry
    assert crossing.area == pytest.approx(truth.area, rel=2e-3)  # UTM's scale


REAL = {
    "lanelet2/mapping_example.osm": (371, 8),
    "interaction/DR_DEU_Roundabout_OF.osm": (48, 0),
    "interaction/DR_USA_Intersection_EP0.osm": (59, 0),
    "interaction/DR_USA_Intersection_MA.osm": (66, 0),
}


@pytest.mark.realdata
@pytest.mark.parametrize("name", REAL)
def test_real_maps_as_the_library_sees_them(name: str, data_root: Path, tmp_path: Path) -> None:
    source = data_root / name
    node = next(iter(read_osm(source).nodes.values()))
    projector = UtmProjector(Origin(node.lat, node.lon))
    library, errors = loadRobust(str(source), projector)
    ours = read_lanelet2(source)
    num_bad = ours.provenance["skipped"].get("lanelet without one left and one right way", 0)
    assert num_bad == len([e for e in errors if "exactly one" in e])
    lanelets, crossings = ours.of_type(Lanelet), ours.of_type(Crosswalk)
    assert (len(library.laneletLayer), len(crossings)) == REAL[name]
    assert len(lanelets) + len(crossings) + num_bad == len(library.laneletLayer)
    for lanelet in lanelets:
        loaded = library.laneletLayer[int(lanelet.id.removeprefix("relation-"))]
        sides = (lanelet.left_id, lanelet.right_id)
        assert sides == (f"way-{loaded.leftBound.id}", f"way-{loaded.rightBound.id}")
        turned = (loaded.leftBound.inverted(), loaded.rightBound.inverted())
        assert turned == (lanelet.is_left_reversed, lanelet.is_right_reversed)
    following = {
        f"relation-{a.id}": {
            f"relation-{b.id}"
            for b in library.laneletLayer
            if a.id != b.id
            and a.attributes["subtype"] != "crosswalk" != b.attributes["subtype"]
            and lanelet2.geometry.follows(a, b)
        }
        for a in library.laneletLayer
    }
    assert {x.id: set(x.successor_ids) for x in lanelets} == {
        x.id: following[x.id] for x in lanelets
    }

    again = tmp_path / "again.osm"
    write_lanelet2(ours, again)
    reloaded, errors = loadRobust(str(again), projector)
    assert list(errors) == []
    assert len(reloaded.laneletLayer) == len(lanelets) + len(crossings)
    back = read_lanelet2(again)
    assert back.counts() == ours.counts()
    assert [e.id for e in back] == [e.id for e in ours]
    assert max(
        shapely.hausdorff_distance(a.geometry, b.geometry) for a, b in zip(ours, back, strict=True)
    ) < 1e-3  # fmt: skip
