"""Which segmenter a configuration opens, and the models that lie with a drive."""

import hashlib
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.config import SegmentationConfig
from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation import model_profile
from hdmap_tools.segmentation.network import NetworkSegmenter
from hdmap_tools.segmentation.open_segmenter import find_model, open_segmenter
from hdmap_tools.segmentation.precomputed import PrecomputedSegmenter


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """The working directory, where nothing lies."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def models(make_onnx, make_profile, tmp_path, monkeypatch, elsewhere):
    """Two model files that profiles know, and one that none does, in a folder of their own."""
    folder = tmp_path / "store"
    folder.mkdir()
    paths = {
        "one": make_onnx(folder / "one.onnx"),
        "two": make_onnx(folder / "two.onnx", kind="ids"),
        "unknown": make_onnx(folder / "unknown.onnx", channels=5),
    }
    known = {
        name: make_profile(
            name=name,
            sha256=(hashlib.sha256(paths[name].read_bytes()).hexdigest(),),
            output=output,
        )
        for name, output in (("one", "scores"), ("two", "ids"))
    }
    monkeypatch.setattr(model_profile, "builtin_profiles", lambda: known)
    return paths


def put(model, folder):
    folder.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copy(model, folder))


@pytest.mark.parametrize("place", ["drive/models", "models", "models/deep/er", "elsewhere/models"])
def test_the_one_known_model_with_the_drive_is_used_and_logged(
    place, models, drive, tmp_path, caplog
):
    model = put(models["one"], tmp_path / place)
    put(models["unknown"], tmp_path / place)
    with caplog.at_level(logging.INFO):
        segmenter = open_segmenter(SegmentationConfig(), drive)
    assert segmenter.name == "one"
    assert str(model) in caplog.text
    assert segmenter.segment(drive.images[1])[0, 0] == 1


def test_no_known_model_says_where_it_looked_and_what_to_give(models, drive, tmp_path):
    put(models["unknown"], tmp_path / "models")
    with pytest.raises(ConfigError, match=r"--model PATH .*--labels FOLDER") as caught:
        open_segmenter(SegmentationConfig(), drive)
    message = str(caught.value)
    for place in ("drive/models", "models", "elsewhere/models"):
        assert str(tmp_path / place) in message
    assert "unknown.onnx have no known profile" in message


def test_several_known_models_are_listed(models, drive, tmp_path):
    put(models["one"], tmp_path / "drive" / "models")
    put(models["two"], tmp_path / "models")
    with pytest.raises(ConfigError, match=r"Several.*one\.onnx.*two\.onnx.*--model"):
        find_model(drive.root)


def test_the_same_weights_twice_are_one_choice(models, drive, tmp_path):
    first = put(models["one"], tmp_path / "drive" / "models")
    put(models["one"], tmp_path / "models")
    assert find_model(drive.root) == first


def test_an_openvino_graph_without_weights_is_no_model(models, drive, tmp_path):
    put(models["one"], tmp_path / "models")
    (tmp_path / "models" / "annotation.xml").write_text("<annotation/>")
    assert find_model(drive.root).name == "one.onnx"


def test_a_model_that_is_given_wins(models, drive, tmp_path):
    put(models["one"], tmp_path / "models")
    segmenter = open_segmenter(SegmentationConfig(model=models["two"]), drive)
    assert isinstance(segmenter, NetworkSegmenter)
    assert segmenter.name == "two"


def test_a_profile_that_is_given_is_used(models, drive, write_profile, tmp_path):
    profile = write_profile(tmp_path / "mine.json", name="mine")
    config = SegmentationConfig(model=models["one"], profile=str(profile))
    assert open_segmenter(config, drive).name == "mine"


def test_a_model_without_a_profile(models, drive):
    with pytest.raises(ConfigError, match=r"No profile is known for model .*unknown\.onnx"):
        open_segmenter(SegmentationConfig(model=models["unknown"]), drive)


def test_a_file_of_another_kind(models, drive, tmp_path):
    with pytest.raises(ConfigError, match=r"suffix '.pth'; expected .onnx or .xml"):
        open_segmenter(SegmentationConfig(model=tmp_path / "net.pth"), drive)


def test_labels_that_exist(drive, label_set_file, tmp_path):
    (tmp_path / "labels").mkdir()
    config = SegmentationConfig(labels=tmp_path / "labels", label_set=str(label_set_file))
    segmenter = open_segmenter(config, drive)
    assert isinstance(segmenter, PrecomputedSegmenter)
    np.testing.assert_array_equal(segmenter.label_set.names, ["other", "red", "green", "blue"])


def test_the_label_set_in_a_folder_of_labels_is_used(drive, label_set_file, tmp_path):
    labels = tmp_path / "labels"
    labels.mkdir()
    shutil.copy(label_set_file, labels / "label_set.json")
    segmenter = open_segmenter(SegmentationConfig(labels=labels), drive)
    assert segmenter.label_set == load_label_set(label_set_file)
    # One that is named wins.
    named = open_segmenter(SegmentationConfig(labels=labels, label_set="adas-0001"), drive)
    assert named.label_set == load_label_set("adas-0001")


def test_a_folder_of_labels_that_is_missing_is_named_so(drive, tmp_path):
    with pytest.raises(ConfigError, match=r"no folder of label images .*none"):
        open_segmenter(SegmentationConfig(labels=tmp_path / "none"), drive)


def test_labels_need_their_label_set(drive, tmp_path):
    with pytest.raises(ConfigError, match="--label-set"):
        open_segmenter(SegmentationConfig(labels=tmp_path), drive)
    with pytest.raises(LabelError, match="neither a label set"):
        open_segmenter(SegmentationConfig(labels=tmp_path, label_set="none-such"), drive)


def test_what_contradicts_itself_is_refused(models, drive, tmp_path):
    with pytest.raises(ConfigError, match="Both a model"):
        open_segmenter(
            SegmentationConfig(model=models["one"], labels=tmp_path, label_set="adas-0001"), drive
        )
    with pytest.raises(ConfigError, match=r"'adas-0001' is asked for, .* gives 'colours'"):
        open_segmenter(SegmentationConfig(model=models["one"], label_set="adas-0001"), drive)
