"""Measuring a matrix on folders of images and masks, 8-bit and panoptic."""

import cv2
import numpy as np
import pytest

from hdmap_tools.errors import ConfigError, ImageError, LabelError
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.measure_confusion import (
    confusion_from_folders,
    measure_confusion,
    read_mask,
)
from hdmap_tools.segmentation.onnx import load_onnx

BLOCKS = np.array([[0, 1, 2, 3], [3, 3, 1, 0], [2, 0, 0, 1]])
BLOCK_PIXELS = np.bincount(BLOCKS.ravel()) * 16


@pytest.fixture
def segmenter(make_onnx, make_profile, tmp_path):
    return load_onnx(make_onnx(tmp_path / "m.onnx"), make_profile(), {})


@pytest.fixture
def folder(tmp_path, paint):
    """Two images of blocks, `a` with a panoptic mask, `b` with its labels; and one without any."""
    rgb, labels = paint(BLOCKS, 4)
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("a", "b", "lonely"):
        cv2.imwrite(str(folder / f"{name}.png"), rgb[:, :, ::-1])
    cv2.imwrite(str(folder / "a_panoptic.png"), labels.astype(np.uint16) * 1000 + 7)
    cv2.imwrite(str(folder / "b_mask.png"), labels)
    return folder


@pytest.mark.parametrize(("suffix", "divisor"), [("_panoptic", 1000), ("_mask", 1)])
def test_a_perfect_network_has_a_diagonal(suffix, divisor, folder, segmenter, label_set):
    measured = confusion_from_folders(
        folder, folder, segmenter, label_set, mask_suffix=suffix, divisor=divisor, source="blocks"
    )
    np.testing.assert_array_equal(measured.counts, np.diag(BLOCK_PIXELS))
    assert measured.source == "blocks"


def test_ignored_labels_are_not_counted(folder, segmenter, label_set):
    def measure(ignore):
        return confusion_from_folders(
            folder,
            folder,
            segmenter,
            label_set,
            mask_suffix="_panoptic",
            divisor=1000,
            ignore=ignore,
        )

    np.testing.assert_array_equal(
        measure(["other", "blue"]).counts, np.diag(BLOCK_PIXELS * [0, 1, 1, 0])
    )
    with pytest.raises(LabelError, match="no label 'void'"):
        measure(["void"])


def test_pairs_are_summed(label_set, paint):
    rgb, labels = paint(BLOCKS, 2)
    pairs = [(rgb, labels), (rgb, np.full_like(labels, 255)), (rgb, np.zeros_like(labels))]
    measured = measure_confusion(pairs, lambda image: labels, label_set, label_set, "s")
    expected = np.diag(BLOCK_PIXELS // 4)
    expected[0] += BLOCK_PIXELS // 4
    assert measured == ConfusionMatrix(label_set, label_set, expected)


def test_nothing_to_measure_on(tmp_path, folder, segmenter, label_set):
    with pytest.raises(ConfigError, match="no annotated image"):
        measure_confusion([], lambda image: image, label_set, label_set)
    with pytest.raises(ConfigError, match=r"has a mask <name>_other\.png"):
        confusion_from_folders(folder, folder, segmenter, label_set, mask_suffix="_other")
    # An image is not its own mask.
    with pytest.raises(ConfigError, match="has a mask"):
        confusion_from_folders(folder, folder, segmenter, label_set)
    with pytest.raises(ConfigError, match="no folder"):
        confusion_from_folders(tmp_path / "nowhere", folder, segmenter, label_set)
    with pytest.raises(ConfigError, match="divisor must be 1 or more, found 0"):
        confusion_from_folders(folder, folder, segmenter, label_set, divisor=0)


def test_masks_that_do_not_fit(tmp_path, folder, segmenter, label_set):
    with pytest.raises(ImageError, match="16 bits; expected one channel of 8 bits"):
        read_mask(folder / "a_panoptic.png", label_set)
    with pytest.raises(LabelError, match=r"holds class 300 \(value // 10\).*check the divisor"):
        read_mask(folder / "a_panoptic.png", label_set, 10)
    cv2.imwrite(str(folder / "b_mask.png"), np.zeros((6, 8), np.uint8))
    with pytest.raises(ImageError, match=r"b\.png is 16x12"):
        confusion_from_folders(folder, folder, segmenter, label_set, mask_suffix="_mask")
    (folder / "b.png").write_bytes(b"")
    with pytest.raises(ImageError, match=r"b\.png"):
        confusion_from_folders(folder, folder, segmenter, label_set, mask_suffix="_mask")


def test_masks_of_another_label_set_are_warned_of(caplog):
    label_set = load_label_set("adas-0001")  # 1 is road, 2 kerb
    image, truth = np.zeros((8, 8, 3), np.uint8), np.full((8, 8), 1, np.uint8)

    def measured(predicted):
        caplog.clear()
        measure_confusion([(image, truth)], lambda _: predicted, label_set, label_set)
        return caplog.text

    assert measured(truth) == ""
    partly = truth.copy()
    partly[:7] = 0
    assert measured(partly) == ""
    said = measured(np.full((8, 8), 2, np.uint8))
    assert "agree on no class of the map" in said
    assert "is 'adas-0001' what the ids in the masks mean?" in said
