"""The town that ships with the package: made by its recipe, whole, and worth driving through."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.simulate.read_world import read_world, shipped_world
from hdmap_tools.simulate.route import plan_route
from hdmap_tools.simulate.smooth_line import between, curvature
from hdmap_tools.simulate.world_map import LineKind, WorldMap

RECIPE = Path(__file__).resolve().parents[2] / "examples" / "make_demo_town.py"


@pytest.fixture(scope="module")
def town() -> WorldMap:
    return read_world(shipped_world())


def test_the_recipe_makes_the_very_file() -> None:
    made: str = runpy.run_path(str(RECIPE))["town"]()
    assert made.encode() == shipped_world().read_bytes()
    assert len(made) < 400_000


def test_the_lanelet2_library_finds_no_fault_and_a_way_from_anywhere_to_anywhere() -> None:
    lanelet2 = pytest.importorskip("lanelet2", reason="no lanelet2 wheel for this platform")
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(49.012, 8.432))
    loaded, errors = lanelet2.io.loadRobust(str(shipped_world()), projector)
    assert list(errors) == []
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    assert list(graph.checkValidity(False)) == []
    roads = [lanelet for lanelet in loaded.laneletLayer if rules.canPass(lanelet)]
    for lanelet in roads:
        assert len(graph.reachableSet(lanelet, 1e6, 0, True)) == len(roads)
    limits = {round(rules.speedLimit(lanelet).speedLimit) for lanelet in roads}
    assert limits == {30, 50}
    kinds: list[Any] = [element.attributes["subtype"] for element in loaded.regulatoryElementLayer]
    assert {k: kinds.count(k) for k in set(kinds)} == {"right_of_way": 6, "traffic_light": 4}


def test_it_has_what_a_town_has(town: WorldMap) -> None:
    low, high = (
        np.min([lane.left.min(axis=0) for lane in town.lanes.values()], axis=0),
        np.max([lane.left.max(axis=0) for lane in town.lanes.values()], axis=0),
    )
    assert ((high - low) > (430.0, 340.0)).all()
    assert ((high - low) < (520.0, 420.0)).all()
    assert {lane.kind for lane in town.lanes.values()} == {"road", "bicycle", "walkway"}
    kinds = {line.kind for line in town.lines}
    assert kinds == set(LineKind) - {LineKind.EDGE}
    paints = {(p.style, p.color, p.width_m) for line in town.lines if (p := line.paint) is not None}
    white, yellow = MarkColor.WHITE, MarkColor.YELLOW
    assert paints >= {
        (MarkStyle.DASHED, white, 0.12),
        (MarkStyle.SOLID, white, 0.12),
        (MarkStyle.SOLID, white, 0.25),
        (MarkStyle.SOLID_SOLID, white, 0.12),
        (MarkStyle.SOLID_SOLID, yellow, 0.12),
    }
    assert len(town.crosswalks) >= 12
    assert len(town.stop_lines) == 7
    assert set(town.areas) == {"building", "vegetation", "drivable", "island"}


def test_lanes_are_as_wide_as_lanes(town: WorldMap) -> None:
    for lane in town.lanes.values():
        _, half_width_m = between(lane.left, lane.right)
        low, high = {"road": (2.9, 7.0), "bicycle": (1.4, 2.6), "walkway": (1.9, 4.0)}[lane.kind]
        assert low <= 2 * half_width_m.min()
        assert 2 * half_width_m.max() <= high, lane.id


def test_nothing_stands_where_one_drives_or_walks(town: WorldMap) -> None:
    ground = {
        kind: shapely.union_all([k.polygon() for k in town.lanes.values() if k.kind == kind])
        for kind in ("road", "bicycle", "walkway")
    }
    paved = shapely.union_all([ground["road"], ground["bicycle"], *town.areas["drivable"]])
    assert ground["walkway"].intersection(paved).area < 1.0
    taken = shapely.union_all([paved, ground["walkway"]])
    solids = [*town.areas["building"], *town.areas["vegetation"]]
    for k, solid in enumerate(solids):
        assert solid.intersection(taken).area == 0.0
        assert not any(solid.intersects(other) for other in solids[k + 1 :])
    barriers = (LineKind.WALL, LineKind.FENCE, LineKind.GUARD_RAIL)
    for line in town.lines:
        if line.kind in barriers:
            assert not shapely.LineString(line.xy).intersects(taken)


def test_every_road_lane_lies_on_pavement_between_kerbs(town: WorldMap) -> None:
    """No holes: within the outer kerbs everything is lane, parking, junction or island."""
    roads = [lane.polygon() for lane in town.lanes.values() if lane.kind != "walkway"]
    paved = shapely.union_all([*roads, *town.areas["drivable"], *town.areas["island"]])
    closed = paved.buffer(0.05).buffer(-0.05)
    (whole,) = shapely.get_parts(closed)
    blocks = [shapely.Polygon(ring).area for ring in whole.interiors]
    assert min(blocks) > 1000.0  # the four blocks between the streets, and nothing else
    assert len(blocks) == 4


def test_the_default_drive_shows_what_a_demo_needs(town: WorldMap) -> None:
    route = plan_route(town, 300.0, None, 0)
    assert route.length_m == 300.0
    line = shapely.LineString(route.xy)
    assert sum(line.intersects(crossing) for crossing in town.crosswalks) >= 2
    bend = np.abs(curvature(route.xy))
    assert (bend > 1 / 20.0).sum() * route.step_m > 8.0  # a turn at a junction
    assert ((bend > 1 / 120.0) & (bend < 1 / 25.0)).sum() * route.step_m > 15.0  # a curve
    dashed = {k.id for k in town.lines if k.paint is not None and k.paint.style == "dashed"}
    driven = [town.lanes[k] for k in route.lane_ids]
    divided = [k for k in driven if k.right_line in dashed]  # a lane of its direction beside it
    divided += [
        k
        for k in driven
        if any(o.right_line == k.left_line for o in town.lanes.values()) and k.left_line in dashed
    ]
    assert sum(shapely.LineString(k.left).length for k in divided) > 50.0


@pytest.mark.parametrize("seed", range(3))
def test_a_long_drive_repeats_little(town: WorldMap, seed: int) -> None:
    route = plan_route(town, 1500.0, None, seed)
    assert route.length_m == 1500.0
    assert len(set(route.lane_ids)) >= 0.95 * len(route.lane_ids)
