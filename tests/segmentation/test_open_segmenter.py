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
from hdmap_tools.segmentation import model_profile, shipped
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.embedded import METADATA_KEY, EmbeddedModel, write_embedded
from hdmap_tools.segmentation.known_confusion import confusion_of
from hdmap_tools.segmentation.network import Handling, NetworkSegmenter
from hdmap_tools.segmentation.onnx_metadata import with_metadata
from hdmap_tools.segmentation.open_segmenter import find_model, open_segmenter
from hdmap_tools.segmentation.precomputed import PrecomputedSegmenter
from hdmap_tools.segmentation.tiling import Tiling


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


@pytest.fixture(autouse=True)
def networks(tmp_path, monkeypatch):
    """Where networks ship; none does."""
    folder = tmp_path / "networks"
    folder.mkdir()
    monkeypatch.setattr(shipped, "networks_folder", lambda: folder)
    return folder


@pytest.fixture
def speaking(make_onnx, make_profile, label_set, tmp_path):
    """A model that says all of itself; its matrix is told by its counts."""
    (tmp_path / "speaking").mkdir()
    model = make_onnx(tmp_path / "speaking" / "net.onnx")
    matrix = ConfusionMatrix(label_set, label_set, np.full((4, 4), 7), "measured")
    profile = make_profile(name="speaking", label_set="colours")
    write_embedded(model, EmbeddedModel(profile=profile, label_set=label_set, confusion=matrix))
    return model


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


def test_a_model_of_which_nothing_is_known_says_what_to_give(models, drive):
    with pytest.raises(ConfigError, match=r"No profile is known for model .*unknown\.onnx") as told:
        open_segmenter(SegmentationConfig(model=models["unknown"]), drive)
    for word in ("sha256", "none in its metadata", "--label-set", "--profile", "input_size_px"):
        assert word in str(told.value)


def test_a_model_that_says_all_of_itself_needs_nothing(speaking, drive, label_set, paint):
    segmenter = open_segmenter(SegmentationConfig(model=speaking), drive)
    assert (segmenter.name, segmenter.label_set) == ("speaking", label_set)
    assert segmenter.confusion.counts.tolist() == [[7] * 4] * 4
    assert confusion_of(segmenter) is segmenter.confusion
    _, expected = paint([[1, 1, 2, 3], [0, 2, 2, 1], [3, 3, 0, 1]], 4)
    np.testing.assert_array_equal(segmenter.segment(drive.images[1]), expected)


def test_a_profile_that_is_given_wins_over_what_the_file_says(
    speaking, drive, write_profile, tmp_path
):
    profile = write_profile(tmp_path / "mine.json", name="mine", channels="bgr")
    segmenter = open_segmenter(SegmentationConfig(model=speaking, profile=str(profile)), drive)
    assert (segmenter.name, segmenter.profile.channels) == ("mine", "bgr")
    # The matrix was measured on the network fed otherwise.
    assert segmenter.confusion is None


def test_what_contradicts_the_file_is_refused(speaking, drive, label_set_file):
    same = SegmentationConfig(model=speaking, label_set=str(label_set_file))
    assert open_segmenter(same, drive).name == "speaking"
    with pytest.raises(ConfigError, match=r"'adas-0001' is asked for, .* gives 'colours'"):
        open_segmenter(SegmentationConfig(model=speaking, label_set="adas-0001"), drive)
    with pytest.raises(
        ConfigError, match=r"\(16, 12\) is asked for, but profile 'speaking'.*\(8, 6\)"
    ):
        open_segmenter(SegmentationConfig(model=speaking, input_size_px=(16, 12)), drive)


@pytest.mark.parametrize("kind", ["scores", "ids", "two"])
def test_a_label_set_is_enough_for_a_network_that_is_fed_as_most(
    kind, make_onnx, drive, label_set_file, label_set, tmp_path
):
    # With two outputs of four channels nobody knows which.
    model = make_onnx(tmp_path / "plain.onnx", kind=kind)
    config = SegmentationConfig(model=model, label_set=str(label_set_file))
    if kind == "two":
        with pytest.raises(ConfigError, match="of which 2 have a channel for each of the 4 labels"):
            open_segmenter(config, drive)
        return
    segmenter = open_segmenter(config, drive)
    assert (segmenter.name, segmenter.label_set) == ("plain", label_set)
    assert segmenter.profile.output == kind
    assert segmenter.profile.input_size_px == (8, 6)
    assert segmenter.profile.mean == (0.485, 0.456, 0.406)
    assert confusion_of(segmenter) is None


def test_an_input_size_is_for_networks_of_any_size(make_onnx, drive, label_set_file, tmp_path):
    model = make_onnx(tmp_path / "any.onnx", input_shape=[1, 3, "h", "w"])
    config = SegmentationConfig(model=model, label_set=str(label_set_file))
    assert open_segmenter(config, drive).profile.input_size_px is None
    given = config.model_copy(update={"input_size_px": (32, 24)})
    assert open_segmenter(given, drive).profile.input_size_px == (32, 24)
    fixed = make_onnx(tmp_path / "fixed.onnx")
    with pytest.raises(ConfigError, match=r"takes input \(1, 3, 6, 8\), but profile"):
        open_segmenter(given.model_copy(update={"model": fixed}), drive)


def test_outputs_that_do_not_match_the_label_set(make_onnx, drive, label_set_file, tmp_path):
    model = make_onnx(tmp_path / "five.onnx", channels=5)
    config = SegmentationConfig(model=model, label_set=str(label_set_file))
    with pytest.raises(LabelError, match=r"five\.onnx gives 5 channels .* 'colours' has 4 labels"):
        open_segmenter(config, drive)


def test_metadata_that_cannot_be_read_and_a_truncated_model(make_onnx, drive, tmp_path):
    model = make_onnx(tmp_path / "m.onnx")
    whole = model.read_bytes()
    model.write_bytes(with_metadata(whole, METADATA_KEY, '{"profile": '))
    with pytest.raises(ConfigError, match=r"m\.onnx says of itself .* is not JSON"):
        open_segmenter(SegmentationConfig(model=model), drive)
    model.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigError, match=r"m\.onnx is not an ONNX model, or not all of one"):
        open_segmenter(SegmentationConfig(model=model), drive)


def test_a_model_that_says_all_of_itself_is_found_by_the_drive(speaking, models, drive, tmp_path):
    model = put(speaking, tmp_path / "models")
    put(models["unknown"], tmp_path / "models")
    assert find_model(drive.root) == model
    # One that is damaged is left out, with a word.
    model.write_bytes(model.read_bytes()[:100])
    put(models["one"], tmp_path / "models")
    assert find_model(drive.root).name == "one.onnx"


def test_the_shipped_network_is_used_where_none_lies_with_the_drive(
    speaking, models, networks, drive, tmp_path, caplog
):
    with pytest.raises(
        ConfigError, match=r"'street-small' is not in this installation.*--model PATH"
    ):
        open_segmenter(SegmentationConfig(model=Path("street-small")), drive)
    shutil.copy(speaking, networks / "street-small.onnx")
    assert open_segmenter(SegmentationConfig(model=Path("street-small")), drive).name == "speaking"
    assert find_model(drive.root) == Path("street-small")
    assert "has seen simulated images only" in caplog.text
    with caplog.at_level(logging.INFO):
        assert open_segmenter(SegmentationConfig(), drive).name == "speaking"
    assert "Using the model street-small" in caplog.text
    put(models["unknown"], tmp_path / "models")
    with caplog.at_level(logging.WARNING):
        assert find_model(drive.root) == Path("street-small")
    assert "unknown.onnx have no known profile" in caplog.text
    put(models["one"], tmp_path / "models")
    assert find_model(drive.root).name == "one.onnx"


def test_how_images_are_brought_follows_the_configuration(
    make_onnx, drive, label_set_file, tmp_path
):
    model = make_onnx(tmp_path / "any.onnx", input_shape=["n", 3, "h", "w"])
    config = SegmentationConfig(
        model=model,
        label_set=str(label_set_file),
        batch=3,
        tile_px=(64, 96),
        tile_overlap_px=16,
        undistort=False,
    )
    segmenter = open_segmenter(config, drive)
    assert segmenter.handling == Handling(3, Tiling((64, 96), 16), undistort=False)
    assert segmenter.batch == 3


def test_a_file_of_another_kind(models, drive, tmp_path):
    with pytest.raises(ConfigError, match=r"suffix '.pth'; expected .onnx or .xml .*street-small"):
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
