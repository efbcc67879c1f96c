"""Mappings between label sets: every label has a fate, and none changes what it is on the map."""

from itertools import product

import numpy as np
import pytest

from hdmap_tools.errors import LabelError
from hdmap_tools.labels.label_mapping import LabelMapping, identity_mapping
from hdmap_tools.labels.label_set import IGNORE_ID, Label, LabelSet, load_label_set
from hdmap_tools.labels.mappings import known_mappings, mapping_to, shipped_mapping

SOURCES = (
    "camvid-32",
    "camvid-11",
    "cityscapes",
    "cityscapes-ids",
    "mapillary-vistas-124",
    "mapillary-vistas-66",
)


def label_set(name: str, *names: str) -> LabelSet:
    labels = tuple(Label(id=i, name=n, color=(i, i, i)) for i, n in enumerate(names))
    return LabelSet(name=name, labels=labels)


def dropped(source: str, target: str) -> set[str]:
    return {name for name, fate in shipped_mapping(source, target).fates.items() if fate is None}


def test_every_data_set_can_be_brought_onto_both() -> None:
    expected = [*product(SOURCES, ("paz2020", "street")), ("paz2020", "street")]
    assert list(known_mappings()) == sorted(expected)


@pytest.mark.parametrize(("source", "target"), known_mappings())
def test_every_label_has_a_fate_and_stays_what_it_is_on_the_map(source: str, target: str) -> None:
    mapping = shipped_mapping(source, target)
    assert set(mapping.fates) == set(mapping.source.names)
    for label in mapping.source.labels:
        fate = mapping.fates[label.name]
        there = mapping.table[label.id]
        if fate is None:
            assert there == IGNORE_ID
            continue
        kept = mapping.target.labels[there]
        assert kept.name == fate
        assert (kept.map_class, kept.moves) == (label.map_class, label.moves), label.name
    assert (mapping.table[len(mapping.source) :] == IGNORE_ID).all()


@pytest.mark.parametrize("source", [*SOURCES, "paz2020"])
def test_street_keeps_all_that_the_map_has_a_class_for(source: str) -> None:
    source_set = load_label_set(source)
    classes = {
        name
        for name in dropped(source, "street")
        if source_set.labels[source_set.id_of(name)].map_class
    }
    assert classes == set()


@pytest.mark.parametrize("source", SOURCES)
def test_street_agrees_with_the_paper_where_the_paper_says_something(source: str) -> None:
    by_paper = shipped_mapping(source, "paz2020").then(shipped_mapping("paz2020", "street"))
    direct = shipped_mapping(source, "street")
    said = by_paper.table != IGNORE_ID
    assert said.any()
    np.testing.assert_array_equal(direct.table[said], by_paper.table[said])


def test_street_has_what_a_map_needs() -> None:
    street = load_label_set("street")
    assert street.names == (
        *("road", "crosswalk", "lane marking", "sidewalk", "vegetation", "curb"),
        *("building", "pole", "vehicle", "person", "sky"),
    )
    assert dropped("paz2020", "street") == set()
    table = shipped_mapping("paz2020", "street").table[:19]
    assert set(table.tolist()) == set(range(11))


def test_both_versions_of_vistas_agree_on_the_names_they_share() -> None:
    for target in ("paz2020", "street"):
        one = shipped_mapping("mapillary-vistas-66", target).fates
        two = shipped_mapping("mapillary-vistas-124", target).fates
        shared = set(one) & set(two)
        assert len(shared) == 61
        assert {name: one[name] for name in shared} == {name: two[name] for name in shared}
    first, second = (load_label_set(f"mapillary-vistas-{n}") for n in (66, 124))
    for label in first.labels:
        if label.name in second.names:
            other = second.labels[second.id_of(label.name)]
            assert (other.color, other.map_class, other.moves) == (
                label.color,
                label.map_class,
                label.moves,
            )


def test_what_vistas_2_parted_goes_where_it_went_in_one_piece() -> None:
    fates = shipped_mapping("mapillary-vistas-124", "paz2020").fates
    assert len(fates) == 124
    marks = {name: fate for name, fate in fates.items() if name.startswith("marking")}
    assert len(marks) == 24
    zebra = {name for name in marks if name.endswith("crosswalk-zebra")}
    assert {marks[name] for name in zebra} == {"crosswalk"}
    assert {name for name, fate in marks.items() if fate is None} == {
        "marking--discrete--ambiguous"
    }
    assert {fate for name, fate in marks.items() if name not in zebra} == {"lane marking", None}
    people = {name: fate for name, fate in fates.items() if name.startswith("human")}
    assert sorted(people.values(), key=str) == [
        "bicyclist",
        "motorcyclist",
        "person",
        "person",
        "person",
    ]
    signs = [n for n in fates if n.startswith("object--traffic-sign--")]
    assert [n for n in signs if fates[n] != "traffic sign"] == ["object--traffic-sign--ambiguous"]


def test_the_names_of_vistas_2_are_in_the_order_of_the_data_set() -> None:
    names = load_label_set("mapillary-vistas-124").names
    # By the alphabet, but for traffic lights: whatever their order, they fare alike.
    lights = [n for n in names if n.startswith("object--traffic-light")]
    for target in ("paz2020", "street"):
        fates = shipped_mapping("mapillary-vistas-124", target).fates
        assert len({fates[n] for n in lights}) == 1
    assert [n for n in names if n not in lights] == sorted(set(names) - set(lights))


def test_cityscapes_training_labels_fare_as_its_ids() -> None:
    for target in ("paz2020", "street"):
        full = shipped_mapping("cityscapes-ids", target).fates
        assert shipped_mapping("cityscapes", target).fates == {
            name: full[name] for name in load_label_set("cityscapes").names
        }
    assert dropped("cityscapes", "paz2020") == {
        *("wall", "fence", "traffic light", "rider", "train"),
    }
    assert dropped("cityscapes", "street") == {"wall", "fence"}
    assert dropped("camvid-11", "street") == {"fence"}


def test_a_mapping_is_applied_by_name() -> None:
    source = label_set("from", "a", "b", "c", "d")
    target = label_set("to", "y", "x")
    mapping = LabelMapping(source, target, {"a": "x", "b": None, "c": "y", "d": "x"})
    image = np.array([[0, 1, 2], [3, 255, 2]], dtype=np.uint8)
    np.testing.assert_array_equal(mapping.apply(image, "it"), [[1, 255, 0], [1, 255, 0]])
    onwards = LabelMapping(target, label_set("end", "only"), {"x": "only", "y": None})
    np.testing.assert_array_equal(
        mapping.then(onwards).apply(image, "it"), onwards.apply(mapping.apply(image, "it"), "it")
    )
    with pytest.raises(LabelError, match="'to' cannot be followed by one from 'from'"):
        mapping.then(mapping)


def test_a_mapping_refuses_what_it_does_not_know() -> None:
    source, target = label_set("from", "a", "b"), label_set("to", "x")
    with pytest.raises(LabelError, match="does not say what becomes of b"):
        LabelMapping(source, target, {"a": "x"})
    with pytest.raises(LabelError, match="names z, which the first set has not"):
        LabelMapping(source, target, {"a": "x", "b": None, "z": "x"})
    with pytest.raises(LabelError, match="no label 'y'"):
        LabelMapping(source, target, {"a": "x", "b": "y"})
    mapping = LabelMapping(source, target, {"a": "x", "b": None})
    with pytest.raises(LabelError, match=r"mask\.png holds label id 2"):
        mapping.apply(np.array([[2]], dtype=np.uint8), "mask.png")
    with pytest.raises(LabelError, match="int64, expected uint8"):
        mapping.apply(np.array([[1]]), "mask.png")


def test_the_way_between_two_sets_is_found_or_refused() -> None:
    street, paz = load_label_set("street"), load_label_set("paz2020")
    assert mapping_to(paz, "street").fates == shipped_mapping("paz2020", "street").fates
    assert mapping_to(street, "street").target is street
    np.testing.assert_array_equal(identity_mapping(street).table[:11], np.arange(11))
    with pytest.raises(LabelError, match=r"from label set 'street' to 'paz2020'.*camvid-11 -> paz"):
        mapping_to(street, "paz2020")
    impostor = paz.model_copy(update={"labels": paz.labels[:5]})
    with pytest.raises(LabelError, match="calls itself 'paz2020' but has other labels"):
        mapping_to(impostor, "street")
