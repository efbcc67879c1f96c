"""LabelSet, and the sets that ship with the package."""

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from hdmap_tools.errors import LabelError
from hdmap_tools.labels.label_set import (
    DRIVABLE_CLASSES,
    IGNORE_ID,
    MAP_CLASSES,
    Label,
    LabelSet,
    MapClass,
    builtin_label_sets,
    load_label_set,
)

SHIPPED = (
    "adas-0001",
    "camvid-11",
    "camvid-32",
    "cityscapes",
    "cityscapes-ids",
    "mapillary-vistas-124",
    "mapillary-vistas-66",
    "paz2020",
    "street",
    "waymo-panoptic",
)


def labels(*names: str) -> list[dict[str, object]]:
    return [{"id": i, "name": name, "color": [i, i, i]} for i, name in enumerate(names)]


@pytest.fixture
def small() -> LabelSet:
    return LabelSet(
        name="small",
        labels=(
            Label(id=0, name="void", color=(1, 2, 3)),
            Label(id=1, name="road", color=(128, 64, 128), map_class=MapClass.ROAD),
            Label(id=2, name="car", color=(0, 0, 142), moves=True),
            Label(id=3, name="manhole", color=(9, 9, 9), map_class=MapClass.ROAD),
        ),
    )


def test_the_papers_five_classes_in_their_order() -> None:
    assert [str(c) for c in MAP_CLASSES] == [
        "road",
        "crosswalk",
        "lane_mark",
        "vegetation",
        "sidewalk",
    ]
    assert set(DRIVABLE_CLASSES) < set(MAP_CLASSES)


def test_ids_and_classes(small: LabelSet) -> None:
    assert len(small) == 4
    assert small.id_of("car") == 2
    assert small.ids_of_class(MapClass.ROAD) == (1, 3)
    assert small.ids_of_class(MapClass.SIDEWALK) == ()
    assert small.moving_ids == (2,)
    assert small.colors.shape == (256, 3)
    assert small.colors.dtype == np.uint8
    assert small.colors[1].tolist() == [128, 64, 128]
    assert not small.colors[4:].any()


def test_an_unknown_name_lists_the_known_ones(small: LabelSet) -> None:
    with pytest.raises(LabelError, match="no label 'tree'; it has void, road, car, manhole"):
        small.id_of("tree")


def test_images_of_the_set_pass(small: LabelSet) -> None:
    small.check(np.array([[0, 1], [3, IGNORE_ID]], dtype=np.uint8), "image")
    small.check(np.zeros((0, 0), dtype=np.uint8), "image")


@pytest.mark.parametrize("bad_id", [4, 254])
def test_an_id_outside_the_set_is_named_and_counted(small: LabelSet, bad_id: int) -> None:
    image = np.full((4, 5), 1, dtype=np.uint8)
    image[1, :3] = bad_id
    with pytest.raises(LabelError) as caught:
        small.check(image, "CAM_FRONT/12.png")
    message = str(caught.value)
    assert "CAM_FRONT/12.png" in message
    assert f"label id {bad_id} (3 pixels" in message
    assert "'small'" in message
    assert "0..3" in message


def test_negative_and_fractional_ids_are_refused(small: LabelSet) -> None:
    with pytest.raises(LabelError, match="label id -1"):
        small.check(np.array([[-1, 0]], dtype=np.int16), "image")
    with pytest.raises(LabelError, match="float64, expected uint8"):
        small.check(np.array([[np.nan, 0.0]]), "image")


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"labels": []}, "0..n-1"),
        ({"labels": labels("a", "b")[1:]}, r"found \[1\]"),
        ({"labels": labels("a", "b", "c")[::2]}, r"found \[0, 2\]"),
        ({"labels": labels("a", "b")[::-1]}, r"found \[1, 0\]"),
        ({"labels": labels("a", "b", "a")}, "a name twice"),
        ({"labels": [{"id": 255, "name": "a", "color": [0, 0, 0]}]}, "less than or equal to 254"),
        ({"labels": [{"id": 0, "name": "", "color": [0, 0, 0]}]}, "labels.0.name"),
        ({"labels": [{"id": 0, "name": "a", "color": [0, 0, 256]}]}, "labels.0.color.2"),
        ({"labels": [{"id": 0, "name": "a", "color": [0, 0]}]}, "labels.0.color"),
        (
            {"labels": [{"id": 0, "name": "a", "color": [0, 0, 0], "map_class": "kerb"}]},
            "labels.0.map_class",
        ),
        ({"labels": labels("a"), "colour": "red"}, "colour"),
    ],
)
def test_an_unusable_set_is_refused(document, message: str, tmp_path: Path) -> None:
    document = {"name": "mine", **document}
    with pytest.raises(ValidationError, match=message):
        LabelSet.model_validate(document)
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(document))
    with pytest.raises(LabelError, match=r"mine\.json is not a label set") as caught:
        load_label_set(path)
    assert caught.match(message)


def test_more_labels_than_a_byte_holds_are_refused() -> None:
    with pytest.raises(ValidationError, match="254"):
        LabelSet.model_validate({"name": "wide", "labels": labels(*(f"l{i}" for i in range(256)))})


def test_sets_load_by_name_and_by_path(small: LabelSet, tmp_path: Path) -> None:
    assert load_label_set("paz2020") is builtin_label_sets()["paz2020"]
    path = tmp_path / "small.json"
    path.write_text(small.model_dump_json())
    assert load_label_set(path) == small
    assert load_label_set(str(path)) == small


def test_no_such_set_lists_the_shipped_ones(tmp_path: Path) -> None:
    with pytest.raises(LabelError, match=r"'ade20k' is neither .*cityscapes.*paz2020.* nor a JSON"):
        load_label_set("ade20k")
    with pytest.raises(LabelError, match="neither"):
        load_label_set(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it is not valid JSON"),
        (b"{", "it is not valid JSON"),
        (b"\xff\xfe", "it is not valid JSON"),
        (b"[]", "the file: Input should be"),
        (b"null", "the file: Input should be"),
        (b"[" * 100_000, "it is nested too deeply"),
        (b'{"name": ' + b"1" * 5000 + b"}", "it is not valid JSON"),
        (b'{"name": "a", "labels": [{"id": ' + b"1" * 4000 + b"}]}", "labels.0.id: "),
        (b'{"name": "\\ud800", "labels": []}', "name: expected printable text"),
        (b'{"\\n\\u0000": 1, "name": "a", "labels": []}', r"\\n\\x00"),
        (b'{"' + b"k" * 5000 + b'": 1}', r"\(50\d\d characters\)"),
        (b'{"name": "' + b"n" * 5000 + b'", "labels": []}', r"\(50\d\d characters\)"),
        (b'{"name": "a", "labels": [' + b"{}," * 300 + b"{}]}", "; and 900 more"),
        (
            json.dumps({"name": "a", "labels": labels(*map(str, range(99)))[1:]}).encode(),
            "and 88 more",
        ),
    ],
)
def test_a_damaged_file_is_refused_on_one_short_line(
    content: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "broken.json"
    path.write_bytes(content)
    with pytest.raises(
        LabelError, match=rf"broken\.json is not a label set: .*{message}"
    ) as caught:
        load_label_set(path)
    text = str(caught.value)
    assert text.isprintable()
    assert len(text.replace(str(path), "")) < 600
    assert "pydantic" not in text


@pytest.mark.parametrize("name", ["a" * 5000, "a\0b", "\ud800"])
def test_a_name_that_can_be_no_path_is_refused(name: str) -> None:
    with pytest.raises(LabelError, match="is neither a label set") as caught:
        load_label_set(name)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 400


def test_each_shipped_file_is_named_as_its_set() -> None:
    folder = resources.files("hdmap_tools.labels") / "sets"
    stems = sorted(e.name.removesuffix(".json") for e in folder.iterdir())
    assert stems == sorted(builtin_label_sets()) == list(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_sets_say_their_source_and_know_roads(name: str) -> None:
    label_set = load_label_set(name)
    assert len(label_set.source) > 40
    assert label_set.ids_of_class(MapClass.ROAD)
    for label in label_set.labels:
        assert not (label.moves and label.map_class), f"{label.name} is ground and moves"


def test_adas_labels_are_the_networks_channels() -> None:
    adas = load_label_set("adas-0001")
    assert adas.names == ("background", "road", "curb", "mark")
    assert [label.map_class for label in adas.labels] == [None, "road", None, "lane_mark"]


def test_paz2020_is_the_papers_list() -> None:
    paz = load_label_set("paz2020")
    assert ", ".join(paz.names) == (
        "curb, crosswalk, road, sidewalk, building, person, bicyclist, motorcyclist, lane marking, "
        "sky, vegetation, manhole, pole, traffic sign, bicycle, bus, car, motorcycle, truck"
    )
    # The indices at which the authors' code takes the five classes from its confusion matrix.
    first = [paz.id_of(n) for n in ("road", "crosswalk", "lane marking", "vegetation", "sidewalk")]
    assert first == [2, 1, 8, 10, 3]
    assert [paz.ids_of_class(c)[0] for c in MAP_CLASSES] == first
    assert paz.ids_of_class(MapClass.ROAD) == (2, paz.id_of("manhole"))
    moving = {"person", "bicyclist", "motorcyclist", "bicycle", "bus", "car", "motorcycle", "truck"}
    assert {paz.names[i] for i in paz.moving_ids} == moving


def test_cityscapes_train_ids_and_ids_agree() -> None:
    train, full = load_label_set("cityscapes"), load_label_set("cityscapes-ids")
    assert len(train) == 19
    assert len(full) == 34
    full_ids = [full.id_of(name) for name in train.names]
    assert full_ids == [7, 8, 11, 12, 13, 17, *range(19, 29), 31, 32, 33]
    for label in train.labels:
        same = full.labels[full.id_of(label.name)]
        assert (label.color, label.map_class, label.moves) == (
            same.color,
            same.map_class,
            same.moves,
        )
    assert train.labels[train.id_of("terrain")].map_class == MapClass.VEGETATION


def test_waymo_paint_is_lane_mark() -> None:
    waymo = load_label_set("waymo-panoptic")
    assert len(waymo) == 29
    assert (waymo.id_of("TYPE_ROAD"), waymo.id_of("TYPE_SIDEWALK")) == (20, 23)
    assert waymo.ids_of_class(MapClass.LANE_MARK) == (21, 22)
    assert waymo.ids_of_class(MapClass.CROSSWALK) == ()
    assert waymo.moving_ids == (*range(1, 14), 16, 27)


@pytest.mark.realdata
def test_recorded_waymo_masks_hold_ids_of_the_set(data_root: Path) -> None:
    import cv2

    waymo = load_label_set("waymo-panoptic")
    masks = sorted((data_root / "waymo_panoptic").glob("*_panoptic.png"))
    assert len(masks) == 5
    seen: set[int] = set()
    for path in masks:
        classes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) // 1000
        waymo.check(classes, path.name)
        seen |= set(np.unique(classes).tolist())
        # The road fills the lower middle of a picture taken from a car.
        if path.name.startswith("FRONT_panoptic"):
            below = classes[int(0.65 * len(classes)) : int(0.8 * len(classes))]
            ground = np.isin(below, waymo.ids_of_class(MapClass.ROAD) + (21, 22))
            assert ground.mean() > 0.3
            sky = classes[: len(classes) // 8] == waymo.id_of("TYPE_SKY")
            assert sky.any()
    assert {waymo.id_of("TYPE_ROAD"), waymo.id_of("TYPE_LANE_MARKER")} < seen
