"""The real street-scene network on real images: the shipped matrix, and what it must see."""

import numpy as np
import pytest

from hdmap_tools.config import SegmentationConfig
from hdmap_tools.labels.label_set import Label, LabelSet, load_label_set
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.measure_confusion import (
    confusion_from_folders,
    read_mask,
    read_rgb_of_size,
)
from hdmap_tools.segmentation.open_segmenter import open_model, open_segmenter

pytestmark = pytest.mark.realdata

NAME = "road-segmentation-adas-0001"
DRIVABLE = ["TYPE_ROAD", "TYPE_LANE_MARKER", "TYPE_ROAD_MARKER"]
MARKS = DRIVABLE[1:]


@pytest.fixture(scope="module")
def segmenter(data_root):
    pytest.importorskip("openvino")
    return open_model(data_root / "models" / NAME / f"{NAME}.xml", None, {})


@pytest.fixture(scope="module")
def measured(data_root, segmenter):
    folder = data_root / "waymo_panoptic"
    return confusion_from_folders(
        folder,
        folder,
        segmenter,
        load_label_set("waymo-panoptic"),
        mask_suffix="_panoptic",
        divisor=1000,
        ignore=["TYPE_UNDEFINED"],
    )


def test_the_shipped_matrix_is_what_is_measured(measured):
    shipped = ConfusionMatrix.load(NAME)
    np.testing.assert_array_equal(measured.counts.sum(axis=1), shipped.counts.sum(axis=1))
    # The kernels that a runtime picks for a CPU round differently in the last
    # bit, which moves single pixels on the edges between labels.
    off = np.abs(measured.counts - shipped.counts)
    assert (off <= 1e-3 * shipped.counts.sum(axis=1, keepdims=True)).all(), off.max()


def test_the_shipped_matrix_leaves_out_no_pixel_but_undefined_ones(data_root, measured):
    truth = load_label_set("waymo-panoptic")
    masks = sorted((data_root / "waymo_panoptic").glob("*_panoptic.png"))
    pixels = sum(np.bincount(read_mask(m, truth, 1000).ravel(), minlength=29) for m in masks)
    assert len(masks) == 5
    np.testing.assert_array_equal(measured.counts.sum(axis=1)[1:], pixels[1:])
    assert measured.counts[0].sum() == 0


@pytest.mark.parametrize(
    ("camera", "road_iou", "mark_iou"),
    # Intersection over union as published with the data, to two places.
    [("FRONT", 0.94, 0.41), ("FRONT_RIGHT", None, 0.69)],
)
def test_each_camera_as_well_as_known(camera, road_iou, mark_iou, data_root, segmenter):
    folder = data_root / "waymo_panoptic"
    truth_set = load_label_set("waymo-panoptic")
    truth = read_mask(folder / f"{camera}_panoptic.png", truth_set, 1000)
    truth[truth == 0] = 255
    rgb = read_rgb_of_size(folder / f"{camera}.jpg", truth.shape[1], truth.shape[0])
    one = ConfusionMatrix.measure(truth, segmenter.segment_rgb(rgb), truth_set, segmenter.label_set)
    if road_iou is not None:
        assert round(one.agreement(DRIVABLE, ["road", "mark"]).iou, 2) == road_iou
    assert round(one.agreement(MARKS, ["mark"]).iou, 2) == mark_iou


def test_the_front_camera_sees_road_ahead_and_sky_above(data_root):
    pytest.importorskip("openvino")
    drive = open_drive(data_root / "nuscenes")
    segmenter = open_segmenter(SegmentationConfig(), drive)
    assert segmenter.name == NAME
    (image,) = [image for image in drive.images if image.camera == "CAM_FRONT"]
    labels = segmenter.segment(image)
    assert labels.shape == (900, 1600)
    names = np.array(segmenter.label_set.names)
    # Whatever is not road or mark right ahead of the car, up to 30 m, is a mistake.
    ahead = names[labels[620:880, 500:1100]]
    assert np.isin(ahead, ["road", "mark"]).mean() > 0.99
    assert (names[labels[:300]] == "background").mean() > 0.999
    # The dashes between the lanes, left of the middle at the bottom, and an arrow right of it.
    assert (names[labels[755:800, 760:785]] == "mark").mean() > 0.5
    assert (names[labels[630:655, 1005:1030]] == "mark").mean() > 0.5
    # The trees and buildings on the other side are none.
    assert not (names[labels[100:450]] == "mark").any()


def test_a_real_onnx_model_with_a_profile_of_ones_own(data_root, make_profile, tmp_path):
    """TwinLiteNet: one of its two outputs tells drivable ground from everything else."""
    drivable = LabelSet(
        name="drivable",
        labels=(
            Label(id=0, name="other", color=(0, 0, 0)),
            Label(id=1, name="drivable", color=(128, 64, 128), map_class="road"),
        ),
    )
    (tmp_path / "drivable.json").write_text(drivable.model_dump_json())
    profile = make_profile(
        name="twinlitenet",
        label_set="drivable.json",
        input_size_px=(640, 360),
        output_name="da",
    )
    (tmp_path / "profile.json").write_text(profile.model_dump_json())
    drive = open_drive(data_root / "nuscenes")
    config = SegmentationConfig(
        model=data_root / "models" / "twinlitenet" / "best.onnx",
        profile=str(tmp_path / "profile.json"),
    )
    segmenter = open_segmenter(config, drive)
    (image,) = [image for image in drive.images if image.camera == "CAM_FRONT"]
    labels = segmenter.segment(image)
    assert labels.shape == (900, 1600)
    assert (labels[620:880, 500:1100] == 1).mean() > 0.95
    assert (labels[:400] == 1).mean() < 0.001
