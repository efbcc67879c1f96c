"""Map elements refuse what no map can carry."""

import numpy as np
import pytest
from pydantic import ValidationError
from shapely.geometry import LinearRing, LineString, MultiLineString, Point, Polygon

from hdmap_tools.map_model.elements import (
    ELEMENT_TYPES,
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    MarkStyle,
    RoadBoundary,
    StopLine,
    element_type_by_name,
)

LINE = LineString([(0, 0, 1), (5, 0, 1.5)])
with np.errstate(invalid="ignore"):
    NAN_X = LineString([(0, 0, 0), (1, np.nan, 0)])
    NAN_Z = LineString([(0, 0, 0), (1, 1, np.nan)])
    INFINITE = LineString([(0, 0, 0), (np.inf, 1, 0)])
SQUARE = Polygon([(0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0)])


def test_a_usable_element_keeps_its_geometry() -> None:
    mark = LaneMark(geometry=LINE, style="dashed", confidence=0.75, sigma_m=0.04, width_m=0.12)
    assert mark.geometry is LINE
    assert mark.style is MarkStyle.DASHED
    assert mark.id == ""
    hole = Polygon(SQUARE.exterior.coords, [[(1, 1, 0), (2, 1, 0), (2, 2, 0)]])
    assert Crosswalk(geometry=hole).geometry.area == pytest.approx(11.5)


@pytest.mark.parametrize(
    ("element_type", "geometry", "message"),
    [
        (LaneMark, SQUARE, "lane_mark needs a LineString, found Polygon"),
        (Crosswalk, LINE, "crosswalk needs a Polygon, found LineString"),
        (RoadBoundary, LinearRing(SQUARE.exterior.coords), "needs a LineString, found LinearRing"),
        (LaneMark, MultiLineString([LINE]), "found MultiLineString"),
        (StopLine, Point(0, 0, 0), "found Point"),
        (LaneMark, LineString(), "empty geometry"),
        (Crosswalk, Polygon(), "empty geometry"),
        (LaneMark, LineString([(0, 0), (1, 1)]), "3D coordinates, found 2D"),
        (Crosswalk, Polygon([(0, 0), (1, 0), (1, 1)]), "3D coordinates, found 2D"),
        (LaneMark, NAN_X, "NaN or infinite"),
        (LaneMark, NAN_Z, "NaN or infinite"),
        (LaneMark, INFINITE, "NaN or infinite"),
        (LaneMark, LineString([(0, 0, 0), (0, 0, 0)]), "not a valid geometry"),
        (Crosswalk, Polygon([(0, 0, 0), (2, 2, 0), (2, 0, 0), (0, 2, 0)]), "Self-intersection"),
        (LaneMark, None, "geometry"),
        (LaneMark, "LINESTRING Z (0 0 0, 1 1 1)", "geometry"),
    ],
)
def test_unusable_geometry_is_refused(element_type, geometry, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        element_type(geometry=geometry)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("confidence", -0.01),
        ("confidence", 1.01),
        ("confidence", np.nan),
        ("sigma_m", -0.1),
        ("sigma_m", np.inf),
        ("num_observations", -1),
        ("width_m", 0.0),
        ("width_m", np.inf),
        ("style", "wavy"),
        ("colour", "white"),
    ],
)
def test_unusable_attributes_are_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        LaneMark(geometry=LINE, **{field: value})


def test_elements_cannot_be_changed() -> None:
    mark = LaneMark(geometry=LINE)
    with pytest.raises(ValidationError, match="frozen"):
        mark.confidence = 0.5


def test_a_lanelet_names_its_bounds() -> None:
    with pytest.raises(ValidationError, match="left_id"):
        Lanelet(geometry=LINE, right_id="b")
    lanelet = Lanelet(geometry=LINE, left_id="a", right_id="b", successor_ids=("c", "d"))
    assert lanelet.successor_ids == ("c", "d")


def test_every_element_type_is_found_by_its_name() -> None:
    names = [t.element_type for t in ELEMENT_TYPES]
    assert len(set(names)) == len(names)
    for element_type in ELEMENT_TYPES:
        assert element_type_by_name(element_type.element_type) is element_type
    assert element_type_by_name("map_element") is None
    assert set(ELEMENT_TYPES) == set(MapElement.__subclasses__())
