"""VectorMap: unique ids that follow from what and where a thing is."""

import random
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import LineString, Polygon

from hdmap_tools.errors import FormatError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import Crosswalk, LaneMark, MapElement, MarkColor, StopLine
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids


def line(x: float, y: float, length: float = 10.0) -> LineString:
    return LineString([(x, y, 0.0), (x + length, y, 0.0)])


def square(x: float, y: float, size: float = 4.0) -> Polygon:
    return Polygon([(x, y, 0), (x + size, y, 0), (x + size, y + size, 0), (x, y + size, 0)])


@st.composite
def elements(draw: st.DrawFn) -> MapElement:
    # Coarse positions, so that several elements often share a place.
    x, y = draw(st.integers(-3, 3)) * 0.2, draw(st.integers(-3, 3)) * 0.2
    kind = draw(st.sampled_from(["mark", "stop", "crosswalk"]))
    if kind == "crosswalk":
        return Crosswalk(geometry=square(x, y))
    if kind == "stop":
        return StopLine(geometry=line(x, y))
    return LaneMark(geometry=line(x, y), color=draw(st.sampled_from(MarkColor)))


def key(element: MapElement) -> tuple[str, str]:
    return element.geometry.wkt, element.model_dump_json()


@given(st.lists(elements(), max_size=12), st.randoms(use_true_random=False))
def test_ids_do_not_depend_on_the_order_of_arrival(found, rng: random.Random) -> None:
    shuffled = list(found)
    rng.shuffle(shuffled)
    first = sorted(key(e) for e in with_stable_ids(found))
    assert first == sorted(key(e) for e in with_stable_ids(shuffled))


def test_two_marks_on_one_line_are_told_apart_by_what_they_are() -> None:
    white, yellow = (LaneMark(geometry=line(0, 0), color=c) for c in ("white", "yellow"))
    one, other = with_stable_ids([white, yellow]), with_stable_ids([yellow, white])
    assert {e.color: e.id for e in one} == {e.color: e.id for e in other}
    assert one[0].id != one[1].id


@given(st.lists(elements(), max_size=12))
def test_ids_are_unique_and_nothing_is_lost(found) -> None:
    named = with_stable_ids(found)
    assert len(named) == len(found)
    assert len({e.id for e in named}) == len(found)
    assert all(e.id.startswith(e.element_type) for e in named)
    assert sorted(e.geometry.wkt for e in named) == sorted(e.geometry.wkt for e in found)
    # Named once, named for good.
    assert {e.id for e in with_stable_ids(named)} == {e.id for e in named}


def test_ids_are_the_same_in_another_process() -> None:
    code = (
        "from shapely.geometry import LineString\n"
        "from hdmap_tools.map_model.elements import LaneMark\n"
        "from hdmap_tools.map_model.vector_map import with_stable_ids\n"
        "print(with_stable_ids([LaneMark(geometry=LineString([(1, 2, 0), (11, 2, 0)]))])[0].id)"
    )
    ids = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for seed in ("1", "2")
    }
    assert ids == {with_stable_ids([LaneMark(geometry=line(1, 2))])[0].id}


def test_a_small_move_keeps_the_id_and_a_large_one_does_not() -> None:
    here, near, far = (
        with_stable_ids([LaneMark(geometry=line(x, 0.0))])[0].id for x in (100.0, 100.1, 102.0)
    )
    assert here == near
    assert here != far


def test_given_ids_are_kept_and_not_given_again() -> None:
    wanted = with_stable_ids([LaneMark(geometry=line(0, 0))])[0].id
    taken = LaneMark(id=wanted, geometry=line(50, 50))
    for found in (
        [taken, LaneMark(geometry=line(0, 0))],
        [LaneMark(geometry=line(0, 0)), taken],
    ):
        named = {e.geometry.wkt: e.id for e in with_stable_ids(found)}
        assert named[taken.geometry.wkt] == wanted
        assert named[line(0, 0).wkt] == f"{wanted}-2"


def test_a_generator_of_elements_is_read_once_and_wholly() -> None:
    found = [LaneMark(geometry=line(k, 0)) for k in range(3)]
    assert len(with_stable_ids(e for e in found)) == 3
    assert len(VectorMap(MapFrame()).with_elements(e for e in found)) == 3


def test_elements_are_sorted_by_type_and_id() -> None:
    found = [
        StopLine(id="a", geometry=line(0, 0)),
        Crosswalk(id="z", geometry=square(0, 0)),
        LaneMark(id="m2", geometry=line(0, 0)),
        LaneMark(id="m1", geometry=line(0, 0)),
    ]
    built = VectorMap(MapFrame(), tuple(found))
    assert [e.id for e in built] == ["z", "m1", "m2", "a"]
    assert built.elements == VectorMap(MapFrame(), tuple(reversed(found))).elements
    assert built.counts() == {"crosswalk": 1, "lane_mark": 2, "stop_line": 1}
    assert [e.id for e in built.of_type(LaneMark)] == ["m1", "m2"]
    assert len(built.of_type(MapElement)) == len(built) == 4
    assert built.bounds_m == (0.0, 0.0, 10.0, 4.0)


def test_repeated_and_empty_ids_are_refused() -> None:
    twice = tuple(LaneMark(id="same", geometry=line(k, 0)) for k in range(2))
    with pytest.raises(FormatError, match=r"unique; 1 occur again: same"):
        VectorMap(MapFrame(), twice)
    # One id for two types is one id too many: formats have one name space.
    with pytest.raises(FormatError, match="same"):
        VectorMap(MapFrame(), (twice[0], StopLine(id="same", geometry=line(0, 0))))
    with pytest.raises(FormatError, match=r"1 of 2 are. Call with_stable_ids"):
        VectorMap(MapFrame(), (twice[0], LaneMark(geometry=line(0, 0))))


def test_adding_names_the_new_and_keeps_the_old() -> None:
    frame = MapFrame.from_origin(49.0, 8.4)
    base = VectorMap(frame, provenance={"plugins": ["x"]}).with_elements(
        [LaneMark(geometry=line(0, 0))]
    )
    more = base.with_elements([LaneMark(geometry=line(0, 0)), Crosswalk(geometry=square(9, 9))])
    assert len(base) == 1
    assert len(more) == 3
    assert base.elements[0] in more.elements
    assert (more.frame, more.provenance) == (frame, {"plugins": ["x"]})


def test_an_empty_map() -> None:
    empty = VectorMap(MapFrame())
    assert len(empty) == 0
    assert empty.bounds_m is None
    assert empty.counts() == {}
    assert with_stable_ids([]) == ()
