"""ONNX models through ONNX Runtime: exact label images, and what is said of unusable files."""

import numpy as np
import pytest

from hdmap_tools.errors import ConfigError, ImageError, LabelError
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.onnx import load_onnx

BLOCKS = np.array([[0, 1, 2, 3], [3, 3, 1, 0], [2, 0, 0, 1]])


@pytest.mark.parametrize("kind", ["scores", "ids"])
@pytest.mark.parametrize("px", [1, 2, 4])
def test_labels_are_exact(kind, px, make_onnx, make_profile, paint, tmp_path):
    model = make_onnx(tmp_path / "m.onnx", kind=kind)
    rgb, expected = paint(BLOCKS, px)
    labels = load_onnx(model, make_profile(output=kind), {}).segment_rgb(rgb)
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, expected)


def test_channels_are_fed_in_the_profiles_order(make_onnx, make_profile, paint, tmp_path):
    model = make_onnx(tmp_path / "m.onnx")
    rgb, labels = paint(BLOCKS, 2)
    swapped = load_onnx(model, make_profile(channels="bgr"), {}).segment_rgb(rgb)
    np.testing.assert_array_equal(swapped, np.array([0, 3, 2, 1], np.uint8)[labels])


def test_a_network_for_any_size_takes_the_images_own(make_onnx, make_profile, paint, tmp_path):
    model = make_onnx(tmp_path / "m.onnx", input_shape=[1, 3, "h", "w"])
    rgb, expected = paint(BLOCKS, 7)
    segmenter = load_onnx(model, make_profile(input_size_px=None), {}, threads=1)
    assert segmenter.network.input_shape == (1, 3, None, None)
    np.testing.assert_array_equal(segmenter.segment_rgb(rgb), expected)


def test_an_image_of_the_drive(make_onnx, make_profile, drive, tmp_path):
    segmenter = load_onnx(make_onnx(tmp_path / "m.onnx"), make_profile(), drive.cameras)
    labels = segmenter.segment(drive.images[2])
    assert labels.shape == (12, 16)
    assert labels[::4, ::4].tolist() == [[2, 1, 2, 3], [0, 2, 2, 1], [3, 3, 0, 1]]


def test_an_image_that_does_not_decode(make_onnx, make_profile, drive, tmp_path):
    segmenter = load_onnx(make_onnx(tmp_path / "m.onnx"), make_profile(), drive.cameras)
    drive.images[0].path.write_bytes(drive.images[0].path.read_bytes()[:-20])
    with pytest.raises(ImageError, match=r"0\.png"):
        segmenter.segment(drive.images[0])
    with pytest.raises(ImageError, match=r"nowhere\.png"):
        segmenter.segment(ImageRef("front", 5, tmp_path / "nowhere.png"))


def test_several_outputs_need_a_name(make_onnx, make_profile, paint, tmp_path):
    model = make_onnx(tmp_path / "m.onnx", kind="two")
    rgb, expected = paint(BLOCKS, 2)
    with pytest.raises(ConfigError, match="'reversed', 'scores'; say in profile"):
        load_onnx(model, make_profile(), {})
    with pytest.raises(ConfigError, match="has no output 'logits'"):
        load_onnx(model, make_profile(output_name="logits"), {})
    segmenter = load_onnx(model, make_profile(output_name="scores"), {})
    np.testing.assert_array_equal(segmenter.segment_rgb(rgb), expected)


def test_wrong_channels_and_nan(make_onnx, make_profile, paint, tmp_path):
    rgb, _ = paint(BLOCKS, 2)
    model = make_onnx(tmp_path / "five.onnx", channels=5)
    with pytest.raises(LabelError, match=r"five\.onnx gives 5 channels .*'colours' has 4 labels"):
        load_onnx(model, make_profile(), {})
    model = make_onnx(tmp_path / "nan.onnx", kind="nan")
    with pytest.raises(LabelError, match=r"nan\.onnx.*NaN or infinite"):
        load_onnx(model, make_profile(), {}).segment_rgb(rgb, "picture 7")


@pytest.mark.parametrize("damage", ["empty", "text", "truncated"])
def test_a_damaged_file_is_named(damage, make_onnx, make_profile, tmp_path, capfd):
    model = make_onnx(tmp_path / "m.onnx")
    content = model.read_bytes()
    model.write_bytes({"empty": b"", "text": b"no model", "truncated": content[:-60]}[damage])
    with pytest.raises(ConfigError, match=r"m\.onnx is not a model that ONNX Runtime"):
        load_onnx(model, make_profile(), {})
    assert capfd.readouterr() == ("", "")


def test_a_missing_file_is_named(make_profile, tmp_path):
    with pytest.raises(ConfigError, match=r"no model file .*m\.onnx"):
        load_onnx(tmp_path / "m.onnx", make_profile(), {})


def test_other_weights_are_another_fingerprint(make_onnx, make_profile, tmp_path):
    one = load_onnx(make_onnx(tmp_path / "a.onnx"), make_profile(), {})
    same = load_onnx(make_onnx(tmp_path / "b.onnx"), make_profile(), {})
    other = load_onnx(
        make_onnx(tmp_path / "c.onnx", kind="two"), make_profile(output_name="scores"), {}
    )
    assert one.fingerprint == same.fingerprint != other.fingerprint
    # Weights may lie outside the file, beside it.
    (tmp_path / "a.onnx.data").write_bytes(b"more")
    again = load_onnx(tmp_path / "a.onnx", make_profile(), {})
    assert again.fingerprint != one.fingerprint
