"""The 66 labels of Mapillary Vistas, and their reduction to the paper's 19."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hdmap_tools.errors import LabelError
from hdmap_tools.labels.label_set import IGNORE_ID, MapClass, load_label_set
from hdmap_tools.labels.vistas import VISTAS_TO_PAZ2020, remap_vistas_to_paz2020

VISTAS = load_label_set("mapillary-vistas-66")
PAZ = load_label_set("paz2020")


def fate(vistas_name: str) -> str | None:
    remapped = remap_vistas_to_paz2020(np.array([[VISTAS.id_of(vistas_name)]], dtype=np.uint8))
    return None if remapped[0, 0] == IGNORE_ID else PAZ.names[remapped[0, 0]]


def test_every_label_has_a_declared_fate_and_no_other_has() -> None:
    assert list(VISTAS_TO_PAZ2020) == list(VISTAS.names)
    assert len(VISTAS) == 66


def test_every_label_of_the_paper_is_reached() -> None:
    assert {target for target in VISTAS_TO_PAZ2020.values() if target} == set(PAZ.names)


def test_the_papers_mergers() -> None:
    merged = {
        name: sorted(v for v, target in VISTAS_TO_PAZ2020.items() if target == name)
        for name in PAZ.names
    }
    assert {name: sources for name, sources in merged.items() if len(sources) > 1} == {
        "crosswalk": ["construction--flat--crosswalk-plain", "marking--crosswalk-zebra"],
        "building": ["construction--structure--bridge", "construction--structure--building"],
        "person": ["human--person", "human--rider--other-rider"],
        "vegetation": ["nature--terrain", "nature--vegetation"],
        "traffic sign": ["object--traffic-sign--back", "object--traffic-sign--front"],
    }
    assert fate("human--rider--bicyclist") == "bicyclist"
    assert fate("human--rider--motorcyclist") == "motorcyclist"
    assert fate("marking--general") == "lane marking"


def test_unnamed_and_void_labels_are_dropped() -> None:
    assert sum(target is None for target in VISTAS_TO_PAZ2020.values()) == 66 - 24
    for name in ("void--unlabeled", "void--ego-vehicle", "nature--snow", "object--traffic-light"):
        assert fate(name) is None


@given(
    hnp.arrays(
        np.uint8,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=6),
        elements=st.integers(0, 65) | st.just(IGNORE_ID),
    )
)
def test_remapping_is_the_table_pixel_by_pixel(image) -> None:
    remapped = remap_vistas_to_paz2020(image)
    assert remapped.dtype == np.uint8
    assert remapped.shape == image.shape
    PAZ.check(remapped, "remapped")
    for before, after in zip(image.flat, remapped.flat, strict=True):
        target = VISTAS_TO_PAZ2020[VISTAS.names[before]] if before != IGNORE_ID else None
        assert after == (IGNORE_ID if target is None else PAZ.id_of(target))


def test_kept_labels_keep_their_class_and_their_motion() -> None:
    """What a Vistas label is on the map it also is after the reduction, or it is dropped."""
    for label in VISTAS.labels:
        target = VISTAS_TO_PAZ2020[label.name]
        if target is not None:
            kept = PAZ.labels[PAZ.id_of(target)]
            assert (kept.map_class, kept.moves) == (label.map_class, label.moves), label.name


def test_foreign_ids_and_dtypes_are_refused() -> None:
    with pytest.raises(LabelError, match=r"a\.png holds label id 66"):
        remap_vistas_to_paz2020(np.array([[66]], dtype=np.uint8), "a.png")
    with pytest.raises(LabelError, match="16-bit instance image"):
        remap_vistas_to_paz2020(np.array([[13 * 256]], dtype=np.uint16))


def test_the_remapping_table_cannot_be_changed_through_a_result() -> None:
    image = np.arange(66, dtype=np.uint8)[None]
    first = remap_vistas_to_paz2020(image)
    expected = first.copy()
    first[:] = 7
    np.testing.assert_array_equal(remap_vistas_to_paz2020(image), expected)


def test_map_classes_of_vistas() -> None:
    crosswalks = [VISTAS.names[i] for i in VISTAS.ids_of_class(MapClass.CROSSWALK)]
    assert crosswalks == ["construction--flat--crosswalk-plain", "marking--crosswalk-zebra"]
    assert [VISTAS.names[i] for i in VISTAS.ids_of_class(MapClass.LANE_MARK)] == [
        "marking--general"
    ]
    assert {VISTAS.names[i].split("--")[0] for i in VISTAS.moving_ids} == {
        "animal",
        "human",
        "object",
        "void",
    }


@pytest.mark.realdata
def test_names_order_and_colours_are_the_data_sets_own(data_root: Path) -> None:
    config = json.loads((data_root / "mapillary_vistas" / "config.json").read_text())
    assert [(label.name, list(label.color)) for label in VISTAS.labels] == [
        (entry["name"], entry["color"]) for entry in config["labels"]
    ]
    assert set(VISTAS_TO_PAZ2020) == {entry["name"] for entry in config["labels"]}
    colours = {entry["name"]: entry["color"] for entry in config["labels"]}
    for label in PAZ.labels:
        sources = [v for v, target in VISTAS_TO_PAZ2020.items() if target == label.name]
        assert list(label.color) in [colours[v] for v in sources], label.name
