"""`hdmap confusion` on a drive whose true labels are known."""

import json
import shutil

import cv2
import numpy as np
import pytest

from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.confusion import ConfusionMatrix


@pytest.fixture
def predicted(street):
    """Predictions that take all paint of the left half of each image for road."""
    folder = street / "predicted"
    shutil.copytree(street / "labels", folder)
    for path in folder.rglob("*.png"):
        labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        left = labels[:, : labels.shape[1] // 2]
        left[left == 3] = 1
        cv2.imwrite(str(path), labels)
    label_set = load_label_set("adas-0001").model_dump_json()
    for one in ("labels", "predicted"):
        (street / one / "label_set.json").write_text(label_set)
    return folder


def measure(hdmap, street, predicted, *more):
    out = street / "c.json"
    code, said, err = hdmap(
        "confusion", "--drive", street / "drive", "--truth", street / "labels",
        "--labels", predicted, "-o", out, *more,
    )  # fmt: skip
    assert code == 0, err
    return ConfusionMatrix.load(out), said


def test_a_drive_with_truth_by_distance(hdmap, street, predicted):
    matrix, said = measure(hdmap, street, predicted, "--range-bands", "0,10,20")
    true, lost = 0, 0
    for path in sorted((street / "labels").rglob("*.png")):
        labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        true += int((labels == 3).sum())
        lost += int((labels[:, : labels.shape[1] // 2] == 3).sum())
    assert matrix.counts[3].tolist() == [0, lost, 0, true - lost]
    assert matrix.range_edges_m == (0.0, 10.0, 20.0)
    assert sum(int(b.counts.sum()) for b in matrix.bands) == matrix.counts.sum() == 3 * 640 * 400
    # All of the sky is in the last band.
    assert matrix.bands[0].counts[0].sum() < 0.1 * matrix.bands[2].counts[0].sum()
    assert f"lane_mark: IoU {(true - lost) / true:.3f}" in said
    assert "label road: recall 1.000" in said
    assert "0-10 m, lane_mark: recall" in said
    assert "20 m and beyond, road: recall" in said
    assert "3 images" in matrix.source


def test_several_drives_add_up(hdmap, street, predicted):
    one, _ = measure(hdmap, street, predicted)
    (street / "drive" / "truth").mkdir()
    shutil.copytree(street / "labels", street / "drive" / "truth" / "label_images")
    out = street / "both.json"
    code, _, err = hdmap(
        "confusion", "--drive", street / "drive", "--labels", predicted,
        "--drive", street / "drive", "--labels", predicted, "-o", out,
    )  # fmt: skip
    assert code == 0, err
    np.testing.assert_array_equal(ConfusionMatrix.load(out).counts, 2 * one.counts)
    assert "bands" not in json.loads(out.read_text())


def test_an_image_without_prediction_is_left_out_and_said(hdmap, street, predicted):
    next(predicted.rglob("*.png")).unlink()
    out = street / "c.json"
    code, _, err = hdmap(
        "confusion", "--drive", street / "drive", "--truth", street / "labels",
        "--labels", predicted, "-o", out,
    )  # fmt: skip
    assert code == 0
    assert "1 of 3 images" in err
    assert ConfusionMatrix.load(out).counts.sum() == 2 * 640 * 400


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ((), "IMAGES and MASKS"),
        (
            ("--range-bands", "0,10", "i", "m", "--model", "x", "--mask-labels", "y"),
            "--range-bands",
        ),
        (("--drive", "d"), "either --model or --labels"),
        (("--drive", "d", "--labels", "p", "--model", "m"), "either --model or --labels"),
        (("--drive", "d", "--labels", "p", "--labels", "q"), "as many folders"),
        (("i", "m", "--drive", "d", "--labels", "p"), "not both"),
    ],
)
def test_wrong_usage(hdmap, tmp_path, given, says):
    code, _, err = hdmap("confusion", *given, "-o", tmp_path / "c.json")
    assert code == 2
    assert says in err
    assert not (tmp_path / "c.json").exists()


def test_bad_bands_and_missing_truth_are_said(fails, street, predicted):
    given = (
        "confusion",
        "--drive",
        street / "drive",
        "--labels",
        predicted,
        "-o",
        street / "c.json",
    )
    fails(*given, says=("label_images",))
    fails(*given, "--truth", street / "labels", "--range-bands", "5,10", says=("0,10,20,40",))
    fails(*given, "--truth", street / "labels", "--range-bands", "near", says=("--range-bands",))
    assert not (street / "c.json").exists()
