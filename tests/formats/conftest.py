"""A small exact map: two lanes, a crossing, an island, areas with a hole."""

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Polygon

from hdmap_tools.formats.lanelet2_geometry import centerline_between
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import (
    Centerline,
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    RoadBoundary,
    SidewalkArea,
    StopLine,
    VegetationArea,
    VirtualBoundary,
)
from hdmap_tools.map_model.vector_map import VectorMap

ORIGIN = (49.0034, 8.4242, 110.0)


def line(*points: tuple[float, float]) -> LineString:
    return LineString([(x, y, 0.02 * x - 0.01 * y) for x, y in points])


def polygon(points: list[tuple[float, float]], *holes: list[tuple[float, float]]) -> Polygon:
    def lifted(ring: list[tuple[float, float]]) -> list[tuple[float, float, float]]:
        return [(x, y, 0.02 * x - 0.01 * y) for x, y in ring]

    return Polygon(lifted(points), [lifted(hole) for hole in holes])


def lanelet(name: str, left: MapElement, right: MapElement, **fields: object) -> Lanelet:
    sides = [shapely.get_coordinates(e.geometry, include_z=True) for e in (left, right)]
    for k, turned in enumerate(("is_left_reversed", "is_right_reversed")):
        if fields.get(turned):
            sides[k] = sides[k][::-1]
    center = centerline_between(*sides)
    return Lanelet(
        id=name, geometry=LineString(center), left_id=left.id, right_id=right.id, **fields
    )


@pytest.fixture
def frame() -> MapFrame:
    return MapFrame.from_origin(*ORIGIN)


@pytest.fixture
def elements() -> tuple[MapElement, ...]:
    right = RoadBoundary(id="right", geometry=line((0, 0), (12, 0.2), (30, 0)), kind="kerb_high")
    right_2 = RoadBoundary(id="right_2", geometry=line((30, 0), (60, 0)), kind="kerb_low")
    middle = LaneMark(
        id="middle",
        geometry=line((0, 3.5), (12, 3.7), (30, 3.5)),
        style="dashed",
        color="yellow",
        width_m=0.12,
        confidence=0.987654321,
        sigma_m=0.0312,
        num_observations=17,
        plugin="lane_mark_skeleton",
        plugin_version="1.2",
    )
    middle_2 = VirtualBoundary(id="middle_2", geometry=line((30, 3.5), (60, 3.5)))
    left = RoadBoundary(id="left", geometry=line((0, 7), (30, 7)), kind="edge")
    theta = np.linspace(0, 2 * np.pi, 13)
    circle = [(80 + 3 * np.cos(a), 5 - 3 * np.sin(a)) for a in theta[:-1]]
    return (
        right,
        right_2,
        middle,
        middle_2,
        left,
        LaneMark(id="wide", geometry=line((0, 9), (5, 9)), style="solid_dashed", width_m=0.25),
        LaneMark(id="plain", geometry=line((0, 10), (5, 10))),
        LaneMark(id="thick", geometry=line((0, 11), (5, 11)), is_thick=True),
        LaneMark(id="thin", geometry=line((0, 11.5), (5, 11.5)), width_m=0.3, is_thick=False),
        RoadBoundary(
            id="island", geometry=line(*circle, circle[0]), kind="unknown", is_island=True
        ),
        StopLine(id="stop", geometry=line((28, 0.2), (28, 3.4)), width_m=0.4),
        Crosswalk(
            id="crossing",
            geometry=polygon([(32, -1), (36, -1), (36.5, 3), (36, 8), (32, 8), (31.8, 4)]),
            confidence=0.8,
        ),
        SidewalkArea(
            id="pavement",
            geometry=polygon([(0, -4), (30, -4), (30, -1), (0, -1)], [(3, -3), (4, -3), (4, -2)]),
        ),
        VegetationArea(id="lawn", geometry=polygon([(0, 12), (9, 12), (5, 18)])),
        Centerline(id="center", geometry=line((0, 1.75), (30, 1.75))),
        lanelet("lane_1", middle, right, successor_ids=("lane_2",), tags={"location": "urban"}),
        lanelet(
            "lane_2", middle_2, right_2, subtype="highway",
            tags={"location": "nonurban", "speed_limit": "80", "one_way": "yes"},
        ),
        lanelet(
            "lane_back", middle, left, is_left_reversed=True, is_right_reversed=True,
            tags={"location": "urban"},
        ),
    )  # fmt: skip


@pytest.fixture
def vector_map(frame: MapFrame, elements: tuple[MapElement, ...]) -> VectorMap:
    return VectorMap(frame, elements, {"plugins": [{"name": "ü & <b> \"x'", "options": {"a": 1}}]})


def assert_same(expected: VectorMap, found: VectorMap, tolerance_m: float) -> None:
    """Same elements with the same attributes; each vertex of each where it was."""
    assert [(e.element_type, e.id) for e in expected] == [(e.element_type, e.id) for e in found]
    for a, b in zip(expected, found, strict=True):
        assert a.model_dump(exclude={"geometry"}) == b.model_dump(exclude={"geometry"})
        if isinstance(a.geometry, Polygon):
            assert isinstance(b.geometry, Polygon)
            rings = [(a.geometry.exterior, b.geometry.exterior)]
            assert len(a.geometry.interiors) == len(b.geometry.interiors)
            rings += list(zip(a.geometry.interiors, b.geometry.interiors, strict=True))
            for one, other in rings:
                assert _ring_distance(one, other) <= tolerance_m, a.id
        else:
            one = shapely.get_coordinates(a.geometry, include_z=True)
            other = shapely.get_coordinates(b.geometry, include_z=True)
            assert one.shape == other.shape, a.id
            assert np.abs(one - other).max() <= tolerance_m, a.id


def _ring_distance(one: LineString, other: LineString) -> float:
    """Largest vertex difference over all starts and both directions."""
    a = shapely.get_coordinates(one, include_z=True)[:-1]
    b = shapely.get_coordinates(other, include_z=True)[:-1]
    if a.shape != b.shape:
        return float("inf")
    return min(
        float(np.abs(a - np.roll(turned, k, axis=0)).max())
        for turned in (b, b[::-1])
        for k in range(len(b))
    )
