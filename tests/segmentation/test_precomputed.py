"""Label PNGs in a folder, each checked against its image and label set."""

import cv2
import numpy as np
import pytest

from hdmap_tools.errors import CalibrationError, ConfigError, ImageError, LabelError
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.label_png import write_label_png
from hdmap_tools.segmentation.precomputed import PrecomputedSegmenter, label_path


@pytest.fixture
def labels():
    return np.random.default_rng(0).choice(np.array([0, 1, 2, 3, 255], np.uint8), (12, 16))


@pytest.fixture
def segmenter(tmp_path, drive, label_set, labels):
    for image in drive.images:
        write_label_png(label_path(tmp_path / "labels", image), labels)
    return PrecomputedSegmenter(tmp_path / "labels", label_set, drive.cameras)


def test_labels_are_read_as_they_are(segmenter, drive, labels):
    np.testing.assert_array_equal(segmenter.segment(drive.images[1]), labels)
    assert segmenter.label_set.name == "colours"


def test_the_layout_is_camera_and_time(tmp_path):
    image = ImageRef("CAM_FRONT", 1532402927612460000, tmp_path / "x.jpg")
    path = label_path(tmp_path, image)
    assert path == tmp_path / "CAM_FRONT" / "1532402927612460000.png"
    assert path == tmp_path / f"{image.key}.png"


def test_the_image_itself_need_not_exist(segmenter, drive, labels):
    drive.images[0].path.unlink()
    np.testing.assert_array_equal(segmenter.segment(drive.images[0]), labels)


def test_a_missing_label_image_is_named(segmenter, drive):
    label_path(segmenter.folder, drive.images[0]).unlink()
    with pytest.raises(ImageError, match=r"front/1000\.png is missing"):
        segmenter.segment(drive.images[0])


def test_an_id_outside_the_label_set(segmenter, drive, labels):
    labels[3, 4] = 4
    write_label_png(label_path(segmenter.folder, drive.images[0]), labels)
    with pytest.raises(LabelError, match=r"1000\.png holds label id 4 .*'colours' has ids 0\.\.3"):
        segmenter.segment(drive.images[0])


def test_another_size(segmenter, drive, labels):
    write_label_png(label_path(segmenter.folder, drive.images[0]), labels.T)
    with pytest.raises(ImageError, match="is 12x16 pixels, but its camera image is 16x12"):
        segmenter.segment(drive.images[0])


def test_colours(segmenter, drive, labels):
    path = label_path(segmenter.folder, drive.images[0])
    cv2.imwrite(str(path), np.dstack([labels] * 3))
    with pytest.raises(ImageError, match="class ids, never colours"):
        segmenter.segment(drive.images[0])


def test_an_unknown_camera(segmenter, tmp_path):
    with pytest.raises(CalibrationError, match="'rear'"):
        segmenter.segment(ImageRef("rear", 0, tmp_path))


def test_a_missing_folder(tmp_path, label_set):
    with pytest.raises(ConfigError, match=r"no folder of label images .*nowhere"):
        PrecomputedSegmenter(tmp_path / "nowhere", label_set, {})


def test_the_fingerprint_follows_the_files(segmenter, drive, labels):
    before = segmenter.fingerprint
    assert segmenter.fingerprint == before
    write_label_png(label_path(segmenter.folder, drive.images[0]), np.zeros_like(labels))
    assert segmenter.fingerprint != before


def test_what_made_the_labels_is_their_name(segmenter, label_set, drive):
    assert segmenter.name == "precomputed"
    (segmenter.folder / "model.json").write_text('{"model": "net-7"}')
    assert PrecomputedSegmenter(segmenter.folder, label_set, drive.cameras).name == "net-7"


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"model": ""}', '{"model": 3}', "\ud800"])
def test_what_made_the_labels_must_be_readable(text, segmenter, label_set):
    (segmenter.folder / "model.json").write_text(text, errors="surrogatepass")
    with pytest.raises(ConfigError, match=r"model\.json"):
        PrecomputedSegmenter(segmenter.folder, label_set, {})
