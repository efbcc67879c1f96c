"""One file is enough: what it says is what the run learned."""

import shutil
import sys

import numpy as np
import onnxruntime
import pytest

torch = pytest.importorskip("torch")

from hdmap_tools.errors import CheckpointError, OutputExistsError  # noqa: E402
from hdmap_tools.segmentation.embedded import read_embedded  # noqa: E402
from hdmap_tools.segmentation.training.checkpoint import BEST, read_state, write_state  # noqa: E402
from hdmap_tools.segmentation.training.export_onnx import export_run, onnx_bytes  # noqa: E402
from hdmap_tools.segmentation.training.models import build_model  # noqa: E402
from hdmap_tools.segmentation.training.presets import PRESETS  # noqa: E402
from hdmap_tools.segmentation.training.trainer import CONFUSION_NAME, train  # noqa: E402


@pytest.fixture(autouse=True, scope="module")
def no_tensorboard():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "torch.utils.tensorboard", None)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory, toy_pairs, toy_run_settings):
    folder = tmp_path_factory.mktemp("trained") / "run"
    train(folder, toy_pairs(8), toy_pairs(4, 100), toy_run_settings(epochs=10))
    return folder


@pytest.fixture
def run(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "run")


def test_the_file_alone_labels_images_as_the_run_did(run, tmp_path, toy_pairs):
    out = tmp_path / "toy.onnx"
    assert export_run(run, out) < 1e-4
    embedded = read_embedded(out)
    assert embedded.label_set == toy_pairs().label_set
    assert embedded.confusion.to_json() == (run / CONFUSION_NAME).read_text()
    assert embedded.profile.name == "toy"
    assert embedded.training["seed"] == 0
    assert embedded.training["step"] == read_state(run / BEST)["step"]
    # Through the segmenter that users have, on the images that it was judged on: the
    # matrix that comes out is the one in the file.
    session = onnxruntime.InferenceSession(out)
    pairs = toy_pairs(4, 100)
    counts = np.zeros((3, 3), dtype=int)
    for index in range(4):
        rgb, truth = pairs.read(index)
        images = (rgb / 255 - embedded.profile.mean) / embedded.profile.std
        scores = session.run(None, {"image": images.transpose(2, 0, 1)[None].astype(np.float32)})[0]
        known = truth != 255
        np.add.at(counts, (truth[known], scores[0].argmax(0)[known]), 1)
    judged = embedded.confusion.counts
    assert counts.sum() == judged.sum()
    # Validation may multiply in bfloat16 where the processor can; a few pixels on edges differ.
    assert np.abs(counts - judged).sum() <= 0.01 * judged.sum()


def test_the_same_run_gives_the_same_bytes(run, tmp_path):
    for name in ("a", "b"):
        export_run(run, tmp_path / f"{name}.onnx", name="same")
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()


def test_an_older_file_is_kept_unless_told_otherwise(run, tmp_path):
    out = tmp_path / "toy.onnx"
    out.write_bytes(b"old")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        export_run(run, out)
    assert out.read_bytes() == b"old"
    export_run(run, out, overwrite=True)
    assert read_embedded(out) is not None


def test_a_run_without_validation_says_that_it_has_no_confusion(
    tmp_path, toy_pairs, toy_run_settings, caplog
):
    train(tmp_path / "run", toy_pairs(8), None, toy_run_settings(epochs=1))
    export_run(tmp_path / "run", tmp_path / "x.onnx")
    assert "never validated" in caplog.text
    assert read_embedded(tmp_path / "x.onnx").confusion is None


def test_damaged_weights_are_refused(run, tmp_path):
    content = (run / BEST).read_bytes()
    (run / BEST).write_bytes(content[:-50])
    with pytest.raises(CheckpointError, match="truncated or damaged"):
        export_run(run, tmp_path / "x.onnx")
    (run / BEST).unlink()
    with pytest.raises(CheckpointError, match="cannot be read"):
        export_run(run, tmp_path / "x.onnx")
    assert not (tmp_path / "x.onnx").exists()


@pytest.mark.parametrize("damage", ["nan", "other network"])
def test_weights_that_are_no_networks_are_refused(run, tmp_path, damage):
    state = read_state(run / BEST)
    if damage == "nan":
        state["model"]["scores.bias"][:] = torch.nan
    else:
        del state["model"]["scores.bias"]
    write_state(run / BEST, state)
    with pytest.raises(CheckpointError, match=r"differs .*nan|of another network"):
        export_run(run, tmp_path / "x.onnx")
    assert not (tmp_path / "x.onnx").exists()


@pytest.mark.parametrize("size", [(1, 60, 96), (3, 77, 101)])
def test_small_gives_torchs_scores_for_any_number_and_size_of_images(size):
    torch.manual_seed(0)
    model = build_model(PRESETS["small"], 11).eval()
    for module in model.modules():  # else normalization does nothing, and could be lost
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.2)
            module.running_var.uniform_(0.5, 2)
    session = onnxruntime.InferenceSession(onnx_bytes(model))
    number, height, width = size
    images = torch.randn(number, 3, height, width)
    with torch.inference_mode():
        expected = model(images).numpy()
    found = session.run(None, {"image": images.numpy()})[0]
    np.testing.assert_allclose(found, expected, atol=1e-4)
