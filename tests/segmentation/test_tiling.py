"""Tiles: each pixel once, and the labels of the whole image away from the rim."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdmap_tools.errors import ConfigError
from hdmap_tools.segmentation.network import Handling
from hdmap_tools.segmentation.onnx import load_onnx
from hdmap_tools.segmentation.tiling import ALIGN_PX, Tiling


@given(
    width=st.integers(1, 700),
    height=st.integers(1, 700),
    tile=st.tuples(st.integers(40, 300), st.integers(40, 300)),
    overlap=st.integers(0, 100),
)
def test_kept_parts_cover_each_pixel_once_and_lie_deep_in_their_tiles(width, height, tile, overlap):
    overlap = min(overlap, min(tile) - ALIGN_PX)
    covered = np.zeros((height, width), int)
    for one in Tiling(tile, overlap).tiles(width, height):
        (left, right), (top, bottom) = one.keep_x, one.keep_y
        covered[top:bottom, left:right] += 1
        assert one.x % ALIGN_PX == one.y % ALIGN_PX == 0
        for start, size, whole, first, last in (
            (one.x, tile[0], width, left, right),
            (one.y, tile[1], height, top, bottom),
        ):
            # Half the overlap away from each edge that is not the image's own.
            assert first - start >= (overlap // 2 if start else 0)
            assert start + size - last >= (overlap // 2 if start + size < whole else 0)
    assert (covered == 1).all()


@pytest.mark.parametrize(("size", "overlap"), [((64, 64), 40), ((64, 300), 33), ((64, 64), -1)])
def test_tiles_that_do_not_get_on_are_refused(size, overlap):
    with pytest.raises(ConfigError, match="overlap must be from 0 to"):
        Tiling(size, overlap)


def test_a_tile_is_always_full_and_goes_on_at_the_rim(paint):
    rgb = np.random.default_rng(0).integers(0, 256, (50, 70, 3), dtype=np.uint8)
    tiling = Tiling((64, 64), 0)
    tiles = list(tiling.tiles(70, 50))
    assert [(t.x, t.y) for t in tiles] == [(0, 0), (32, 0)]
    cut = tiling.cut(rgb, tiles[1])
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
    handling = Handling(batch=batch, tiling=Tiling((160, 128), 2 * REACH_PX))
    tiled = load_onnx(convolutional, profile, {}, threads=1, handling=handling).segment_rgb(rgb)
    inner = np.s_[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX]
    assert len(np.unique(whole[inner])) == 4
    np.testing.assert_array_equal(tiled[inner], whole[inner])
    # Without overlap the seams show: the equality above is not for want of differences.
    bare = Handling(tiling=Tiling((160, 128), 0))
    seams = load_onnx(convolutional, profile, {}, threads=1, handling=bare).segment_rgb(rgb)
    assert (seams[inner] != whole[inner]).mean() > 1e-3


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
