"""MapFrame: metres to earth and back, with pyproj's geodesics and known points as judges."""

import json
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Geod

from hdmap_tools.errors import CRSMismatchError, FormatError, NoOriginError, ShapeError
from hdmap_tools.geometry.map_frame import MapFrame

from .strategies import points

KARLSRUHE = (49.0, 8.4)
SINGAPORE = (1.28821, 103.78475)
UTM_32N = "EPSG:32632"


@given(
    st.floats(-80.0, 80.0),
    st.floats(-180.0, 180.0),
    points(3, elements=st.floats(-5000.0, 5000.0)),
)
@settings(max_examples=50)
def test_five_kilometres_come_back_within_a_millimetre(lat_deg, lon_deg, points_city) -> None:
    frame = MapFrame.from_origin(lat_deg, lon_deg, 100.0)
    back = frame.from_wgs84(frame.to_wgs84(points_city))
    np.testing.assert_allclose(back, points_city, atol=1e-3, rtol=0)


def test_the_origin_is_city_zero() -> None:
    frame = MapFrame.from_origin(*KARLSRUHE, 115.0)
    lon_lat_height = frame.to_wgs84(np.zeros((1, 3)))
    np.testing.assert_allclose(lon_lat_height, [[8.4, 49.0, 115.0]], atol=1e-12)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), [KARLSRUHE, SINGAPORE, (-33.9, 151.2)])
def test_x_is_east_and_y_north_and_metres_are_metres(lat_deg: float, lon_deg: float) -> None:
    frame = MapFrame.from_origin(lat_deg, lon_deg)
    lon, lat, _ = frame.to_wgs84(np.array([[1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0]])).T
    azimuth_deg, _, distance_m = Geod(ellps="WGS84").inv([lon_deg] * 2, [lat_deg] * 2, lon, lat)
    np.testing.assert_allclose(np.array(azimuth_deg) % 360, [90.0, 0.0], atol=0.01)
    np.testing.assert_allclose(distance_m, 1000.0, atol=1e-4)


def test_utm_agrees_with_a_known_point() -> None:
    """The CN Tower, as encyclopaedias give it: zone 17, 630084 m east, 4833438 m north."""
    frame = MapFrame.from_crs("EPSG:32617")
    city = frame.from_wgs84(np.array([[-79.387139, 43.642567, 0.0]]))
    np.testing.assert_allclose(city[0, :2], [630084, 4833438], atol=1.0)


def test_an_origin_in_utm_is_subtracted_and_put_back() -> None:
    frame = MapFrame.from_crs(UTM_32N, KARLSRUHE, 110.0)
    assert frame.offset_m[0] == pytest.approx(456_115, abs=100)
    np.testing.assert_allclose(frame.to_wgs84(np.zeros((1, 3))), [[8.4, 49.0, 110.0]], atol=1e-9)
    whole = MapFrame.from_crs(UTM_32N)
    there = np.array([[8.41, 49.01, 120.0]])
    np.testing.assert_allclose(
        frame.from_wgs84(there), whole.from_wgs84(there) - frame.offset_m, atol=1e-6
    )
    points_city = np.array([[5000.0, -5000.0, 3.0], [-4000.0, 123.4, -1.0]])
    back = frame.from_wgs84(frame.to_wgs84(points_city))
    np.testing.assert_allclose(back, points_city, atol=1e-3)


def test_a_crs_that_names_north_first_still_has_x_east() -> None:
    """EPSG:31467 (Gauss-Krüger zone 3) lists northing before easting."""
    assert CRS("EPSG:31467").axis_info[0].direction == "north"
    frame = MapFrame.from_crs("EPSG:31467", KARLSRUHE)
    assert frame.offset_m[0] == pytest.approx(3_456_200, abs=300)
    lon, lat, _ = frame.to_wgs84(np.array([[100.0, 0.0, 0.0], [0.0, 100.0, 0.0]])).T
    assert lon[0] - 8.4 > 0.001 > abs(lat[0] - 49.0)
    assert lat[1] - 49.0 > 0.0008 > abs(lon[1] - 8.4)


def test_without_an_origin_geography_is_refused_and_the_option_named() -> None:
    frame = MapFrame()
    assert not frame.is_georeferenced
    for ask in (frame.to_wgs84, frame.from_wgs84):
        with pytest.raises(NoOriginError, match="--origin LAT,LON"):
            ask(np.zeros((1, 3)))
    with pytest.raises(NoOriginError, match="no origin on earth"):
        _ = frame.crs


@pytest.mark.parametrize(
    "lat_lon", [(103.78, 1.29), (91.0, 0.0), (0.0, 181.0), (np.nan, 0.0), (0.0, np.inf)]
)
def test_an_origin_off_the_earth_is_refused(lat_lon) -> None:
    with pytest.raises(NoOriginError, match="in this order"):
        MapFrame.from_origin(*lat_lon)


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:4326", "projected CRS in metres, found 'WGS 84'"),
        ("EPSG:2263", "in metres, found .*foot"),
        ("EPSG:999999", "pyproj knows"),
        ("nonsense", "pyproj knows"),
    ],
)
def test_an_unsuitable_crs_is_refused(crs: str, message: str) -> None:
    with pytest.raises(CRSMismatchError, match=message):
        MapFrame.from_crs(crs)


def test_broken_wkt_is_refused() -> None:
    with pytest.raises(CRSMismatchError, match="not WKT"):
        MapFrame("PROJCRS[broken")


FRAMES = {
    "none": MapFrame(),
    "none, shifted": MapFrame(None, (1.0, 0.0, 0.0)),
    "karlsruhe": MapFrame.from_origin(*KARLSRUHE),
    "karlsruhe, higher": MapFrame.from_origin(*KARLSRUHE, 100.0),
    "karlsruhe, geoid": MapFrame.from_origin(*KARLSRUHE, vertical_datum="EGM2008"),
    "singapore": MapFrame.from_origin(*SINGAPORE),
    "utm": MapFrame.from_crs(UTM_32N),
    "utm, offset": MapFrame.from_crs(UTM_32N, KARLSRUHE),
}


@pytest.mark.parametrize("other", FRAMES)
@pytest.mark.parametrize("one", FRAMES)
def test_mixing_frames_raises_and_names_both(one: str, other: str) -> None:
    if one == other:
        FRAMES[one].require_same(FRAMES[other])
        return
    with pytest.raises(CRSMismatchError, match="Two frames were mixed") as caught:
        FRAMES[one].require_same(FRAMES[other])
    assert FRAMES[one].describe() in str(caught.value)
    assert FRAMES[other].describe() in str(caught.value)
    assert FRAMES[one].describe() != FRAMES[other].describe()


def test_the_same_crs_in_other_words_is_the_same() -> None:
    pretty = CRS(UTM_32N).to_wkt(pretty=True)
    assert pretty != FRAMES["utm"].crs_wkt
    FRAMES["utm"].require_same(MapFrame(pretty))


@pytest.mark.parametrize("name", FRAMES)
def test_frames_survive_json_and_pickle(name: str) -> None:
    frame = FRAMES[name]
    assert MapFrame.from_json(json.loads(json.dumps(frame.to_json()))) == frame
    if frame.is_georeferenced:
        frame.to_wgs84(np.zeros((1, 3)))  # fills the caches that pickling meets
    assert pickle.loads(pickle.dumps(frame)) == frame


@pytest.mark.parametrize(
    "document",
    [
        {},
        {"crs_wkt": None, "offset_m": [0, 0], "vertical_datum": "WGS84"},
        {"crs_wkt": None, "offset_m": None, "vertical_datum": "WGS84"},
        {"crs_wkt": None, "offset_m": ["a", 0, 0], "vertical_datum": "WGS84"},
        {"crs_wkt": None, "offset_m": [0, 0, 0]},
    ],
)
def test_a_damaged_document_is_refused(document) -> None:
    with pytest.raises(FormatError, match="needs crs_wkt, offset_m"):
        MapFrame.from_json(document)


def test_points_without_a_place_are_refused() -> None:
    frame = FRAMES["karlsruhe"]
    with pytest.raises(CRSMismatchError, match=r"1 points have no place .*nan"):
        frame.to_wgs84(np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))
    with pytest.raises(CRSMismatchError, match="no place"):
        frame.from_wgs84(np.array([[8.4, 95.0, 0.0]]))
    with pytest.raises(ShapeError, match=r"\(N, 3\), found \(2, 2\)"):
        frame.to_wgs84(np.zeros((2, 2)))
    with pytest.raises(ShapeError, match="three finite metres"):
        MapFrame(None, (0.0, np.nan, 0.0))


def test_no_points() -> None:
    assert FRAMES["karlsruhe"].to_wgs84(np.zeros((0, 3))).shape == (0, 3)


def test_the_crs_has_a_name_that_people_see_in_other_programs() -> None:
    frame = FRAMES["singapore"]
    assert frame.crs.name == "hdmap city frame"
    # What was written without the name is the same place.
    unnamed = CRS.from_json_dict({**frame.crs.to_json_dict(), "name": "unknown"})
    frame.require_same(MapFrame(unnamed.to_wkt()))
    assert MapFrame(unnamed.to_wkt()).describe() == frame.describe()


def test_a_frame_is_described_as_briefly_as_it_can_be() -> None:
    frame = MapFrame.from_origin(1.2882100868743724, 103.78475189208984)
    said = "transverse Mercator at latitude 1.288210, longitude 103.784752"
    assert frame.describe() == f"{said}, heights above WGS84"
    higher = MapFrame.from_origin(1.2882100868743724, 103.78475189208984, 12.5, "EGM2008")
    assert higher.describe() == (
        f"{said} with city origin at (0.000, 0.000, 12.500), heights above EGM2008"
    )
    assert FRAMES["none"].describe() == "local metres without an origin"
    assert FRAMES["utm"].describe() == "WGS 84 / UTM zone 32N, heights above WGS84"


def test_a_projection_without_a_name_of_another_kind_is_described() -> None:
    frame = MapFrame.from_crs("+proj=lcc +lat_1=33 +lat_2=45 +lat_0=23 +lon_0=-96 +datum=WGS84")
    assert frame.describe() == "Lambert Conic Conformal (2SP), heights above WGS84"


def test_frames_that_differ_by_a_millimetre_are_told_apart() -> None:
    near = MapFrame.from_origin(KARLSRUHE[0] + 1e-8, KARLSRUHE[1])
    with pytest.raises(CRSMismatchError) as caught:
        FRAMES["karlsruhe"].require_same(near)
    one, two = str(caught.value).removeprefix("Two frames were mixed: ").split(" and ")
    assert one != two
