"""Tiles: each pixel once, and the labels of the whole image away from the rim."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdmap_tools.errors import ConfigError
from hdmap_tools.segmentation.network import Handling, Network, NetworkSegmenter
from hdmap_tools.segmentation.onnx import load_onnx
from hdmap_tools.segmentation.tiling import ALIGN_PX, Tiling


@given(
    width=st.integers(1, 700),
    height=st.integers(1, 700),
    tile=st.tuples(st.integers(40, 300), st.integers(40, 300)),
    overlap=st.integers(0, 100),
)
def test_shares_add_up_to_one_and_are_taken_deep_in_each_tile(width, height, tile, overlap):
    overlap = min(overlap, min(tile) - ALIGN_PX)
    tiling = Tiling(tile, overlap)
    for spans, size, length in (
        (tiling.columns(width), tile[0], width),
        (tiling.rows(height), tile[1], height),
    ):
        shares, owned = np.zeros(length), np.zeros(length, int)
        for one in spans:
            shares[one.begin : one.end] += one.weights
            owned[slice(*one.own)] += 1
            assert one.start % ALIGN_PX == 0
            assert (one.weights > 0).all()
            # A quarter of the overlap away from each edge that is not the image's own.
            after = min(one.start + size, length)
            assert one.begin - one.start >= (overlap // 4 - ALIGN_PX // 4 if one.start else 0)
            assert after - one.end >= (overlap // 4 - ALIGN_PX // 4 if after < length else 0)
        np.testing.assert_allclose(shares, 1.0, atol=1e-6)
        assert (owned == 1).all()


@pytest.mark.parametrize(("size", "overlap"), [((64, 64), 40), ((64, 300), 33), ((64, 64), -1)])
def test_tiles_that_do_not_get_on_are_refused(size, overlap):
    with pytest.raises(ConfigError, match="overlap must be from 0 to"):
        Tiling(size, overlap)


def test_a_tile_is_always_full_and_goes_on_at_the_rim(paint):
    rgb = np.random.default_rng(0).integers(0, 256, (50, 70, 3), dtype=np.uint8)
    tiling = Tiling((64, 64), 0)
    columns, (row,) = tiling.columns(70), tiling.rows(50)
    assert [column.start for column in columns] == [0, 32]
    cut = tiling.cut(rgb, columns[1], row)
    assert cut.shape == (64, 64, 3)
    np.testing.assert_array_equal(cut[:50, :38], rgb[:, 32:])
    np.testing.assert_array_equal(cut[:50, 38:], np.repeat(rgb[:, -1:], 26, axis=1))
    np.testing.assert_array_equal(cut[50:], np.repeat(cut[49:50], 14, axis=0))


@pytest.fixture(scope="module")
def convolutional(tmp_path_factory):
    """A network of any size and batch: stride 4, then enlarged fourfold; random, fixed weights."""
    onnx = pytest.importorskip("onnx")
    helper, float32 = onnx.helper, onnx.TensorProto.FLOAT
    rng = np.random.default_rng(3)
    weights = {
        "w1": rng.normal(size=(8, 3, 3, 3)) * 0.4,
        "w2": rng.normal(size=(8, 8, 3, 3)) * 0.3,
        "w3": rng.normal(size=(4, 8, 3, 3)) * 0.3,
    }
    nodes = [
        helper.make_node("Conv", ["image", "w1"], ["a"], strides=[2, 2], pads=[1] * 4),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Conv", ["b", "w2"], ["c"], strides=[2, 2], pads=[1] * 4),
        helper.make_node("Relu", ["c"], ["d"]),
        helper.make_node("Conv", ["d", "w3"], ["scores"], pads=[1] * 4),
    ]
    graph = helper.make_graph(
        nodes,
        "convolutional",
        [helper.make_tensor_value_info("image", float32, ["n", 3, "h", "w"])],
        [helper.make_tensor_value_info("scores", float32, ["n", 4, "h4", "w4"])],
        [
            onnx.numpy_helper.from_array(array.astype(np.float32), name)
            for name, array in weights.items()
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path = tmp_path_factory.mktemp("net") / "convolutional.onnx"
    path.write_bytes(model.SerializeToString())
    return path


REACH_PX = 24
"""More than the convolutions (1 + 2 + 4 px) and the enlarging (4 px) look at, each way."""


@pytest.mark.parametrize("batch", [1, 3, 100])
@pytest.mark.parametrize("size", [(448, 320), (451, 333)])
def test_tiles_give_the_labels_of_the_whole_image(size, batch, convolutional, make_profile):
    import cv2

    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 256, (size[1] // 4, size[0] // 4, 3), dtype=np.uint8)
    rgb = cv2.resize(coarse, size)
    profile = make_profile(input_size_px=None, size_multiple_px=4, mean=(0.5,) * 3, std=(0.2,) * 3)
    whole = load_onnx(convolutional, profile, {}, threads=1).segment_rgb(rgb)
    handling = Handling(batch=batch, tiling=Tiling((192, 160), 4 * REACH_PX))
    tiled = load_onnx(convolutional, profile, {}, threads=1, handling=handling).segment_rgb(rgb)
    inner = np.s_[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX]
    assert len(np.unique(whole[inner])) == 4
    np.testing.assert_array_equal(tiled[inner], whole[inner])
    if batch == 1 and size == (448, 320):
        # Without overlap the seams show: the equality above is not for want of differences.
        bare = Handling(tiling=Tiling((64, 64), 0))
        seams = load_onnx(convolutional, profile, {}, threads=1, handling=bare).segment_rgb(rgb)
        assert (seams[inner] != whole[inner]).mean() > 1e-3


@pytest.mark.parametrize("output", ["scores", "ids"])
def test_tiles_that_disagree_are_blended_or_share_their_overlap(output, label_set, make_profile):
    """Tiles that see red in their left half and green in their right one, by how far they are in."""
    width, overlap = 160, 64

    def run(batch):
        far = np.broadcast_to((np.arange(width) + 0.5) / width, (len(batch), 64 + 32, width))
        if output == "ids":
            return np.where(far < 0.5, 1, 2)
        none = np.full_like(far, -1.0)
        return np.stack([none, 1 - far, far, none], axis=1).astype(np.float32)

    segmenter = NetworkSegmenter(
        Network("halves.onnx", "none 1", "0" * 64, (None, 3, None, None), run),
        make_profile(input_size_px=None, output=output),
        {},
        label_set=label_set,
        handling=Handling(tiling=Tiling((width, 96), overlap)),
    )
    (row,) = segmenter.segment_rgb(np.zeros((1, 256, 3), np.uint8))
    # Tiles begin at 0 and 96 and overlap from 96 to 160: the middle of that is 128.
    assert (row[:80] == 1).all()
    assert (row[80:112] == 2).all()
    assert (row[144:176] == 1).all()
    assert (row[176:] == 2).all()
    (change,) = np.flatnonzero(np.diff(row[112:144].astype(int)))
    # Blended where both are equally sure; cut in the very middle where there are only ids.
    shares = (np.arange(32) + 0.5) / 32
    x = np.arange(112, 144) + 0.5
    red = (1 - shares) * (1 - x / width) + shares * (1 - (x - 96) / width)
    expected = int(np.argmax(red > 0.5)) if output == "scores" else 16
    assert change + 1 == expected


def test_images_at_once_give_what_they_give_alone(convolutional, make_profile, drive):
    profile = make_profile(input_size_px=None, size_multiple_px=8)
    one = load_onnx(convolutional, profile, drive.cameras)
    three = load_onnx(convolutional, profile, drive.cameras, handling=Handling(batch=3))
    assert (one.batch, three.batch) == (1, 3)
    fed = []
    run = three.network.run
    object.__setattr__(three.network, "run", lambda batch: fed.append(batch.shape) or run(batch))
    together = three.segment_many(drive.images)
    assert fed == [(3, 3, 16, 16)]
    for labels, image in zip(together, drive.images, strict=True):
        np.testing.assert_array_equal(labels, one.segment(image))
    assert one.fingerprint == three.fingerprint


def test_images_of_different_sizes_are_not_put_together(convolutional, make_profile):
    profile = make_profile(input_size_px=None, size_multiple_px=4)
    segmenter = load_onnx(convolutional, profile, {}, handling=Handling(batch=8))
    rng = np.random.default_rng(1)
    shapes = [(16, 20, 3), (16, 20, 3), (20, 16, 3), (16, 20, 3)]
    images = [rng.integers(0, 256, shape, dtype=np.uint8) for shape in shapes]
    found = segmenter._segment(images, ["a", "b", "c", "d"])
    for labels, rgb in zip(found, images, strict=True):
        np.testing.assert_array_equal(labels, segmenter.segment_rgb(rgb))


def test_a_network_for_one_image_gets_them_one_by_one(make_onnx, make_profile, drive, tmp_path):
    segmenter = load_onnx(
        make_onnx(tmp_path / "m.onnx"), make_profile(), drive.cameras, handling=Handling(batch=4)
    )
    assert segmenter.batch == 1
    many = segmenter.segment_many(drive.images)
    for labels, image in zip(many, drive.images, strict=True):
        np.testing.assert_array_equal(labels, segmenter.segment(image))


def test_tiles_of_another_size_than_the_networks_are_refused(make_onnx, make_profile, tmp_path):
    handling = Handling(tiling=Tiling((64, 64), 0))
    with pytest.raises(ConfigError, match=r"input \(1, 3, 6, 8\) only, so tiles of 64x64"):
        load_onnx(make_onnx(tmp_path / "m.onnx"), make_profile(), {}, handling=handling)


def test_tiles_are_in_the_fingerprint(convolutional, make_profile):
    def fingerprint(tiling):
        handling = Handling(tiling=tiling)
        profile = make_profile(input_size_px=None)
        return load_onnx(convolutional, profile, {}, handling=handling).fingerprint

    found = {fingerprint(t) for t in (None, Tiling((64, 64), 0), Tiling((64, 64), 16))}
    assert len(found) == 3
