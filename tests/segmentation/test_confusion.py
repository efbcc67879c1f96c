"""Confusion matrices: counted right, added, merged into classes, kept on disk."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from hdmap_tools.errors import ConfigError, LabelError, ShapeError
from hdmap_tools.labels.label_set import MAP_CLASSES, MapClass, load_label_set
from hdmap_tools.segmentation.confusion import ConfusionMatrix, find_confusion

WAYMO, ADAS = load_label_set("waymo-panoptic"), load_label_set("adas-0001")

true_images = npst.arrays(
    np.uint8, (5, 7), elements=st.sampled_from([*range(len(WAYMO)), 255, 255])
)
predicted_images = npst.arrays(np.uint8, (5, 7), elements=st.sampled_from([0, 1, 2, 3, 255]))


def matrix(counts, source="", true_set=ADAS):
    return ConfusionMatrix(true_set, ADAS, np.asarray(counts), source)


@given(true=true_images, predicted=predicted_images)
def test_each_pixel_is_counted_once_unless_it_is_to_be_ignored(true, predicted):
    expected = np.zeros((len(WAYMO), 4), np.int64)
    for t, p in zip(true.ravel(), predicted.ravel(), strict=True):
        if t != 255 and p != 255:
            expected[t, p] += 1
    measured = ConfusionMatrix.measure(true, predicted, WAYMO, ADAS)
    assert measured.counts.dtype == np.int64
    np.testing.assert_array_equal(measured.counts, expected)


@given(true=true_images, predicted=predicted_images, cut=st.integers(1, 4))
def test_parts_add_up_to_the_whole(true, predicted, cut):
    whole = ConfusionMatrix.measure(true, predicted, WAYMO, ADAS)
    upper = ConfusionMatrix.measure(true[:cut], predicted[:cut], WAYMO, ADAS)
    lower = ConfusionMatrix.measure(true[cut:], predicted[cut:], WAYMO, ADAS)
    assert upper + lower == whole == lower + upper


@given(counts=npst.arrays(np.int64, (4, 4), elements=st.integers(0, 2**53)), source=st.text())
def test_json_round_trip(counts, source):
    original = matrix(counts, source)
    again = ConfusionMatrix.from_json(original.to_json())
    assert again == original
    assert again.source == source
    assert again.to_json() == original.to_json()


def test_a_label_set_that_does_not_ship_travels_with_the_matrix(label_set):
    original = ConfusionMatrix(label_set, ADAS, np.arange(16).reshape(4, 4))
    assert json.loads(original.to_json())["predicted_set"] == "adas-0001"
    assert ConfusionMatrix.from_json(original.to_json()).true_set == label_set


def test_class_rows_add_the_labels_of_a_class_and_leave_unseen_ones_zero():
    counts = np.arange(len(WAYMO) * 4).reshape(-1, 4)
    rows = ConfusionMatrix(WAYMO, ADAS, counts).class_rows(MAP_CLASSES)
    assert rows.shape == (5, 4)
    lane_mark = counts[WAYMO.id_of("TYPE_LANE_MARKER")] + counts[WAYMO.id_of("TYPE_ROAD_MARKER")]
    by_class = dict(zip(MAP_CLASSES, rows.tolist(), strict=True))
    assert by_class[MapClass.LANE_MARK] == lane_mark.tolist()
    assert by_class[MapClass.ROAD] == counts[WAYMO.id_of("TYPE_ROAD")].tolist()
    assert by_class[MapClass.CROSSWALK] == [0, 0, 0, 0]
    assert ConfusionMatrix(WAYMO, ADAS, counts).class_rows([]).shape == (0, 4)


def test_agreement_by_hand():
    # True road: 80 road, 15 background, 5 mark. True mark: 30 mark, 10 road.
    counts = np.zeros((4, 4), np.int64)
    counts[1] = [15, 80, 0, 5]
    counts[3] = [0, 10, 0, 30]
    counts[0] = [900, 20, 0, 0]
    one = matrix(counts)
    road = one.class_agreement()[MapClass.ROAD]
    assert road.recall == 80 / 100
    assert road.precision == 80 / 110
    assert road.iou == 80 / (100 + 110 - 80)
    drivable = one.agreement(["road", "mark"], ["road", "mark"])
    assert drivable.recall == 125 / 140
    assert drivable.iou == 125 / (140 + 145 - 125)
    assert set(one.class_agreement()) == {MapClass.ROAD, MapClass.LANE_MARK}
    assert math.isnan(one.agreement(["curb"], ["curb"]).iou)
    with pytest.raises(LabelError, match="no label 'kerb'"):
        one.agreement(["kerb"], ["curb"])


@pytest.mark.parametrize(
    "counts",
    [
        np.full((4, 4), -1),
        np.full((4, 4), np.nan),
        np.full((4, 4), np.inf),
        np.full((4, 4), 0.5),
        np.full((4, 4), 2**53 + 1, np.uint64),
        np.full((4, 4), "1"),
        np.full((4, 4), None),
        np.full((4, 4), 1e300),
    ],
    ids=["negative", "nan", "inf", "half", "overflow", "text", "none", "huge"],
)
def test_counts_that_count_nothing_are_refused(counts):
    with pytest.raises(LabelError, match="counts must be whole numbers"):
        matrix(counts)


@pytest.mark.parametrize("shape", [(4, 5), (5, 4), (16,), (4, 4, 1), (0, 0)])
def test_counts_of_another_shape_are_refused(shape):
    with pytest.raises(LabelError, match=r"expected \(4, 4\)"):
        matrix(np.zeros(shape, np.int64))


def test_counts_cannot_be_changed_from_outside():
    counts = np.zeros((4, 4), np.int64)
    one = matrix(counts)
    counts[0, 0] = 7
    assert one.counts[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        one.counts[0, 0] = 1


def test_matrices_of_other_labels_are_not_added():
    with pytest.raises(LabelError, match="cannot be added"):
        matrix(np.zeros((4, 4))) + ConfusionMatrix(WAYMO, ADAS, np.zeros((len(WAYMO), 4)))


def test_sources_are_kept_when_adding():
    zero = np.zeros((4, 4))
    assert (matrix(zero, "a") + matrix(zero, "b")).source == "a + b"
    assert (matrix(zero, "a") + matrix(zero, "a")).source == "a"


def test_images_that_do_not_fit():
    good = np.zeros((3, 4), np.uint8)
    with pytest.raises(LabelError, match="true label image holds label id 4"):
        ConfusionMatrix.measure(good + 4, good, ADAS, ADAS)
    with pytest.raises(LabelError, match="predicted label image holds label id 9"):
        ConfusionMatrix.measure(good, good + 9, ADAS, ADAS)
    for other in (good.T, good.astype(np.int64), good[None]):
        with pytest.raises(ShapeError, match="uint8 of one size"):
            ConfusionMatrix.measure(good, other, ADAS, ADAS)


def changed(**fields):
    document = json.loads(matrix(np.ones((4, 4))).to_json())
    return json.dumps(document | fields)


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("", ConfigError, "not a confusion matrix"),
        ("[]", ConfigError, "not a confusion matrix"),
        ("[" * 100_000, ConfigError, "not a confusion matrix"),
        ('{"counts": ' + "9" * 9000 + "}", ConfigError, "not a confusion matrix"),
        (changed(schema_version=2), ConfigError, "schema_version"),
        (changed(extra=1), ConfigError, "extra"),
        (changed(counts=[[float("nan")] * 4] * 4), ConfigError, "counts"),
        (changed(counts=[[0.5] * 4] * 4), ConfigError, "counts"),
        (changed(counts=[[-1] * 4] * 4), LabelError, "from 0 to"),
        (changed(counts=[[1] * 4] * 3), LabelError, r"counts are \(3, 4\), expected \(4, 4\)"),
        (changed(counts=[[1] * 4, [1] * 3]), LabelError, "differ in length"),
        (changed(counts=[[10**30] * 4] * 4), LabelError, "m.json"),
        (changed(true_set="unheard-of"), LabelError, "unheard-of"),
        (changed(true_labels=["a", "b", "c", "d"]), LabelError, "measure it anew"),
        (changed(predicted_set="cityscapes"), LabelError, "predicted labels"),
    ],
)
def test_documents_that_are_wrong(text, error, message, tmp_path):
    path = tmp_path / "m.json"
    path.write_text(text)
    with pytest.raises(error, match=message) as caught:
        ConfusionMatrix.load(path)
    assert "\n" not in str(caught.value)
    assert "pydantic" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(ConfigError, match="road-segmentation-adas-0001"):
        ConfusionMatrix.load("none-such")


def test_the_shipped_matrix_is_found_by_model_and_by_label_set():
    shipped = ConfusionMatrix.load("road-segmentation-adas-0001")
    assert shipped.source
    assert find_confusion(ADAS, "road-segmentation-adas-0001") == shipped
    assert find_confusion(ADAS) == find_confusion(ADAS, "precomputed") == shipped
    assert find_confusion(WAYMO) is None
    assert find_confusion(WAYMO, "road-segmentation-adas-0001") is None
