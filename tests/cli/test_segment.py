"""`hdmap segment`: its folder says by itself what is in it."""

import json

import cv2
import numpy as np
import pytest
import yaml

from hdmap_tools.config import Config, ObservationConfig
from hdmap_tools.fusion.observation_model import observation_model
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.map_reading import model_for
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.embedded import EmbeddedModel, write_embedded
from hdmap_tools.segmentation.label_png import read_label_png
from hdmap_tools.segmentation.segmenter import ModelProfile

from .conftest import LABELS


def test_labels_are_used_without_being_told_what_they_mean(street, hdmap):
    # Labels from elsewhere say nothing, so what they mean has to be given.
    code, _, err = hdmap("segment", "drive", "-o", "bare", "--labels", "labels")
    assert code == 1
    assert "--label-set" in err
    code, out, err = hdmap("segment", "drive", "-o", "made", *LABELS)
    assert code == 0, err
    assert "3 label images of precomputed (adas-0001)" in out
    (street / "made" / "model.json").write_text(json.dumps({"model": "my-net"}))
    for name, more in (("plain", LABELS), ("told", ("--labels", "made"))):
        code, _, err = hdmap("build", "drive", "-o", name, *more)
        assert code == 0, err
    plain, told = (SemanticMap.open(street / name) for name in ("plain", "told"))
    assert (plain.meta.model, told.meta.model) == ("precomputed", "my-net")
    assert told.meta.label_set == plain.meta.label_set
    # What made them goes on to labels made of labels.
    code, _, err = hdmap("segment", "drive", "-o", "again", "--labels", "made")
    assert code == 0, err
    assert json.loads((street / "again" / "model.json").read_text()) == {"model": "my-net"}


@pytest.fixture
def greys(street, make_grey_net):
    """A network that reads the street's grey pictures without error, and says all of itself."""
    return make_grey_net(street / "greys.onnx")


@pytest.fixture
def make_grey_net():
    onnx = pytest.importorskip("onnx")
    helper, float32 = onnx.helper, onnx.TensorProto.FLOAT
    labels = load_label_set("adas-0001")

    def make(path, embedded=True, counts=None):
        # The nearest of the greys 0, 60, 120 and 180: of all k the largest 2 g g_k - g_k².
        grey = 60.0 * np.arange(4, dtype=np.float32)
        weights = np.zeros((4, 3, 1, 1), np.float32)
        weights[:, 1, 0, 0] = 2 * grey
        graph = helper.make_graph(
            [helper.make_node("Conv", ["image", "w", "b"], ["scores"])],
            "greys",
            [helper.make_tensor_value_info("image", float32, ["n", 3, "h", "w"])],
            [helper.make_tensor_value_info("scores", float32, ["n", 4, "h", "w"])],
            [
                onnx.numpy_helper.from_array(weights, "w"),
                onnx.numpy_helper.from_array(-(grey**2), "b"),
            ],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        path.write_bytes(model.SerializeToString())
        if embedded:
            profile = ModelProfile(
                name="greys", label_set="adas-0001", scale=1.0, mean=(0,) * 3, std=(1,) * 3
            )
            seen = 10_000 * np.eye(4, dtype=int) + 1 if counts is None else counts
            matrix = ConfusionMatrix(labels, labels, seen, "made up")
            write_embedded(path, EmbeddedModel(profile=profile, label_set=labels, confusion=matrix))
        return path

    return make


def same_labels(folder, other):
    paths = sorted(p.relative_to(folder) for p in folder.glob("*/*.png"))
    assert len(paths) == 3
    for path in paths:
        np.testing.assert_array_equal(read_label_png(folder / path), read_label_png(other / path))


def test_one_file_is_enough_to_segment_and_to_fuse(street, greys, hdmap):
    code, out, err = hdmap("segment", "drive", "-o", "made", "--model", greys, "--no-cache")
    assert code == 0, err
    assert "3 label images of greys (adas-0001)" in out
    same_labels(street / "made", street / "labels")
    # The matrix goes on with the labels, into the map, and is what the map is read with.
    document = json.loads((street / "made" / "confusion.json").read_text())
    assert document["counts"][0] == [10_001, 1, 1, 1]
    for name, more in (("net", ("--model", greys)), ("png", ("--labels", "made"))):
        code, _, err = hdmap("build", "drive", "-o", name, *more)
        assert code == 0, err
        meta = SemanticMap.open(street / name).meta
        assert (meta.model, meta.confusion) == ("greys", document)
        classes = Config().classes
        found = model_for(meta, Config()).log_likelihood
        mine = ConfusionMatrix.load(street / "made" / "confusion.json")
        expected = observation_model(ObservationConfig(), meta, classes, mine).log_likelihood
        np.testing.assert_array_equal(found, expected)
        shipped = ConfusionMatrix.load("road-segmentation-adas-0001")
        other = observation_model(ObservationConfig(), meta, classes, shipped).log_likelihood
        assert not np.array_equal(found, other)


def test_maps_read_with_other_matrices_are_not_added(street, greys, make_grey_net, fails, hdmap):
    other = make_grey_net(street / "other.onnx", counts=np.ones((4, 4), int))
    for name, model in (("a", greys), ("b", other)):
        code, _, err = hdmap("build", "drive", "-o", name, "--model", model)
        assert code == 0, err
    fails("merge", "a", "b", "-o", "c", says=("confusion matrix", "'greys'"))


def test_batches_and_tiles_give_the_same_labels(street, greys, hdmap):
    for name, more in (
        ("batched", ("--batch", "2")),
        ("tiled", ("--tile", "256x192", "--overlap", "32", "--batch", "4")),
    ):
        code, _, err = hdmap("segment", "drive", "-o", name, "--model", greys, "--no-cache", *more)
        assert code == 0, err
        same_labels(street / name, street / "labels")
    config = yaml.safe_load((street / "tiled" / "hdmap.yaml").read_text())["segmentation"]
    assert (config["tile_px"], config["tile_overlap_px"], config["batch"]) == ([256, 192], 32, 4)


def test_a_part_of_a_batch_is_taken_from_the_cache(street, greys, hdmap):
    shared = ("--model", greys, "--cache", "kept")
    code, _, err = hdmap("segment", "drive", "-o", "first", *shared)
    assert code == 0, err
    kept = sorted((street / "kept").rglob("*.png"))
    assert len(kept) == 3
    kept[1].unlink()
    code, _, err = hdmap("segment", "drive", "-o", "second", *shared, "--batch", "3")
    assert code == 0, err
    same_labels(street / "second", street / "labels")
    assert sorted((street / "kept").rglob("*.png")) == kept


def test_overlays_are_for_people_and_not_taken_for_labels(street, hdmap):
    code, _, err = hdmap("segment", "drive", "-o", "made", *LABELS, "--overlays")
    assert code == 0, err
    pictures = sorted((street / "made" / "overlays").rglob("*.jpg"))
    labels = sorted((street / "made").glob("*/*.png"))
    legend = street / "made" / "overlays" / "legend.png"
    assert [p.stem for p in pictures] == [p.stem for p in labels if p != legend]
    assert legend.is_file()
    assert cv2.imread(str(pictures[0])).shape == (400, 640, 3)
    code, _, err = hdmap("build", "drive", "-o", "map", "--labels", "made")
    assert code == 0, err


def test_a_network_that_says_nothing_needs_its_labels(street, make_grey_net, fails, hdmap):
    model = make_grey_net(street / "plain.onnx", embedded=False)
    fails(
        "segment", "drive", "-o", "made", "--model", model,
        says=("plain.onnx", "none in its metadata", "--label-set", "--profile"),
    )  # fmt: skip
    code, out, err = hdmap(
        "segment", "drive", "-o", "made", "--model", model, "--label-set", "adas-0001",
        "--input-size", "320x200",
    )  # fmt: skip
    assert code == 0, err
    assert "plain (adas-0001)" in out
    fails(
        "segment", "drive", "-o", "no", "--model", model, "--label-set", "paz2020",
        says=("gives 4 channels", "'paz2020' has 19 labels"),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--tile", "256", "expected WIDTHxHEIGHT"),
        ("--tile", "0x8", "expected WIDTHxHEIGHT"),
        ("--tile", "99999x9", "tile_px"),
        ("--tile", "100x100", "overlap"),
        ("--input-size", "axb", "expected WIDTHxHEIGHT"),
        ("--batch", "0", "batch"),
        ("--overlap", "-1", "tile_overlap_px"),
    ],
)
def test_sizes_that_cannot_be_are_refused(option, value, says, street, greys, fails):
    fails("segment", "drive", "-o", "no", "--model", greys, option, value, says=(says,))
    assert not (street / "no").exists()
