"""Tiny networks with known answers, pictures of coloured blocks, and a drive of one camera.

The networks look at colour alone: red is label 1, green 2, blue 3 and black 0.
In pictures of blocks that are whole pixels at both sizes, every label is known exactly.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.labels.label_set import Label, LabelSet
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.segmentation.segmenter import ModelProfile

NAMES = ("other", "red", "green", "blue")
COLORS = np.array([[0, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255]], dtype=np.uint8)


@pytest.fixture(scope="session")
def label_set():
    return LabelSet(
        name="colours",
        labels=tuple(
            Label(id=i, name=name, color=tuple(COLORS[i].tolist())) for i, name in enumerate(NAMES)
        ),
    )


@pytest.fixture(scope="session")
def label_set_file(label_set, tmp_path_factory):
    path = tmp_path_factory.mktemp("sets") / "colours.json"
    path.write_text(label_set.model_dump_json())
    return path


@pytest.fixture(scope="session")
def make_profile(label_set_file):
    def make(**changes):
        fields = {
            "name": "colours-net",
            "label_set": str(label_set_file),
            "input_size_px": (8, 6),
            "mean": (0.0, 0.0, 0.0),
            "std": (1.0, 1.0, 1.0),
        }
        return ModelProfile(**(fields | changes))

    return make


@pytest.fixture(scope="session")
def paint():
    """Blocks of labels (rows, cols) as an RGB picture and its label image, `px` pixels a block."""

    def paint(blocks, px):
        labels = np.kron(np.asarray(blocks, np.uint8), np.ones((px, px), np.uint8))
        return COLORS[labels], labels

    return paint


@pytest.fixture(scope="session")
def make_onnx():
    """Writes a network: a 1x1 convolution from colour to scores, and what `kind` makes of it."""
    onnx = pytest.importorskip("onnx")
    helper, float32 = onnx.helper, onnx.TensorProto.FLOAT

    def make(path: Path, *, height=6, width=8, kind="scores", channels=4, input_shape=None):
        weights = np.zeros((channels, 3, 1, 1), np.float32)
        weights[0] = -1.0  # 1 - r - g - b: black
        for label_id in range(1, min(channels, 4)):
            weights[label_id, label_id - 1] = 1.0
        bias = np.zeros(channels, np.float32)
        bias[0] = 1.0
        nodes = [helper.make_node("Conv", ["image", "w", "b"], ["scores"])]
        outputs = [helper.make_tensor_value_info("scores", float32, None)]
        if kind == "ids":
            nodes.append(helper.make_node("ArgMax", ["scores"], ["ids"], axis=1, keepdims=0))
            outputs = [helper.make_tensor_value_info("ids", onnx.TensorProto.INT64, None)]
        elif kind == "nan":
            nodes.append(helper.make_node("Log", ["scores"], ["logs"]))
            nodes.append(helper.make_node("Sub", ["logs", "logs"], ["bad"]))
            outputs = [helper.make_tensor_value_info("bad", float32, None)]
        elif kind == "two":
            nodes.append(helper.make_node("Neg", ["scores"], ["reversed"]))
            outputs.insert(0, helper.make_tensor_value_info("reversed", float32, None))
        graph = helper.make_graph(
            nodes,
            "colours",
            [helper.make_tensor_value_info("image", float32, input_shape or [1, 3, height, width])],
            outputs,
            [onnx.numpy_helper.from_array(weights, "w"), onnx.numpy_helper.from_array(bias, "b")],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        path.write_bytes(model.SerializeToString())
        return path

    return make


@pytest.fixture
def camera():
    return PinholeCamera("front", 16, 12, 10.0, 10.0, 7.5, 5.5, SE3.identity())


@pytest.fixture
def drive(tmp_path, camera, paint):
    """Three images of the camera `front`, 16x12, of which block 0 tells the number."""
    images = []
    for number in range(3):
        rgb, _ = paint(np.array([[number, 1, 2, 3], [0, 2, 2, 1], [3, 3, 0, 1]]), 4)
        ref = ImageRef("front", 1000 + number, tmp_path / "drive" / f"{number}.png")
        ref.path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(ref.path), rgb[:, :, ::-1])
        images.append(ref)
    return Drive(
        name="blocks",
        layout="test",
        root=tmp_path / "drive",
        frame=MapFrame(),
        trajectory=Trajectory(np.array([1000]), np.eye(3)[None], np.zeros((1, 3))),
        cameras={"front": camera},
        images=tuple(images),
        sweeps=(),
        read_sweep=lambda ref: pytest.fail("no sweep is needed"),
    )


@pytest.fixture
def write_profile(make_profile):
    def write(path, **changes):
        path.write_text(json.dumps(make_profile(**changes).model_dump(mode="json")))
        return path

    return write
