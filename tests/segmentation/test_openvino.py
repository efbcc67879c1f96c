"""OpenVINO models: the same answers as ONNX Runtime's, and what is said of unusable files."""

import sys

import numpy as np
import pytest

from hdmap_tools.errors import ConfigError, MissingExtraError
from hdmap_tools.segmentation.openvino import load_openvino

BLOCKS = np.array([[0, 1, 2, 3], [3, 3, 1, 0], [2, 0, 0, 1]])


@pytest.fixture
def make_ir(make_onnx, tmp_path):
    openvino = pytest.importorskip("openvino")

    def make(name="m", **changes):
        onnx_model = make_onnx(tmp_path / "source.onnx", **changes)
        path = tmp_path / f"{name}.xml"
        openvino.save_model(
            openvino.Core().read_model(str(onnx_model)), str(path), compress_to_fp16=False
        )
        return path

    return make


@pytest.mark.parametrize("kind", ["scores", "ids"])
@pytest.mark.parametrize("px", [1, 2, 4])
def test_labels_are_exact(kind, px, make_ir, make_profile, paint):
    rgb, expected = paint(BLOCKS, px)
    segmenter = load_openvino(make_ir(kind=kind), make_profile(output=kind), {}, threads=1)
    np.testing.assert_array_equal(segmenter.segment_rgb(rgb), expected)


def test_an_answer_is_not_overwritten_by_the_next(make_ir, make_profile):
    segmenter = load_openvino(make_ir(), make_profile(), {})
    first = segmenter.network.run(np.zeros((1, 3, 6, 8), np.float32))
    kept = first.copy()
    segmenter.network.run(np.ones((1, 3, 6, 8), np.float32))
    np.testing.assert_array_equal(first, kept)


def test_a_network_for_any_size_takes_the_images_own(make_ir, make_profile, paint):
    rgb, expected = paint(BLOCKS, 7)
    model = make_ir(input_shape=[1, 3, "h", "w"])
    segmenter = load_openvino(model, make_profile(input_size_px=None), {})
    np.testing.assert_array_equal(segmenter.segment_rgb(rgb), expected)


def test_several_outputs_need_a_name(make_ir, make_profile, paint):
    model = make_ir(kind="two")
    rgb, expected = paint(BLOCKS, 2)
    with pytest.raises(ConfigError, match="'reversed', 'scores'; say in profile"):
        load_openvino(model, make_profile(), {})
    segmenter = load_openvino(model, make_profile(output_name="scores"), {})
    np.testing.assert_array_equal(segmenter.segment_rgb(rgb), expected)


def test_an_input_that_does_not_fit_the_profile(make_ir, make_profile):
    with pytest.raises(ConfigError, match=r"takes input \(1, 3, 6, 8\), but profile"):
        load_openvino(make_ir(), make_profile(input_size_px=(16, 12)), {})


@pytest.mark.parametrize("damage", ["empty", "text", "truncated", "weights"])
def test_a_damaged_file_is_named(damage, make_ir, make_profile):
    model = make_ir()
    content = model.read_bytes()
    if damage == "weights":
        model.with_suffix(".bin").write_bytes(b"")
    else:
        model.write_bytes({"empty": b"", "text": b"no", "truncated": content[:-200]}[damage])
    with pytest.raises(ConfigError, match=r"m\.xml with m\.bin is not a model that OpenVINO"):
        load_openvino(model, make_profile(), {})


@pytest.mark.parametrize("suffix", [".xml", ".bin"])
def test_a_missing_file_is_named(suffix, make_ir, make_profile):
    model = make_ir()
    model.with_suffix(suffix).unlink()
    with pytest.raises(ConfigError, match=rf"no model file .*m\{suffix}"):
        load_openvino(model, make_profile(), {})


def test_without_openvino_the_pip_line_is_given(monkeypatch, make_profile, tmp_path):
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(MissingExtraError, match=r'pip install "hdmap-tools\[openvino\]"'):
        load_openvino(tmp_path / "m.xml", make_profile(), {})
