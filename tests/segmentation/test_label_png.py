"""Label PNGs: what was written comes back, and nothing else is taken for labels."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from hdmap_tools.errors import ImageError, ShapeError
from hdmap_tools.segmentation.label_png import (
    read_label_png,
    read_panoptic_png,
    write_label_png,
)


@given(labels=npst.arrays(np.uint8, npst.array_shapes(min_dims=2, max_dims=2, max_side=40)))
def test_written_labels_come_back(labels, tmp_path_factory):
    folder = tmp_path_factory.mktemp("png")
    write_label_png(folder / "new" / "a.png", labels)
    write_label_png(folder / "b.png", labels)
    np.testing.assert_array_equal(read_label_png(folder / "b.png"), labels)
    assert (folder / "new" / "a.png").read_bytes() == (folder / "b.png").read_bytes()


@given(data=st.data())
def test_no_damage_gets_through(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("png") / "a.png"
    labels = np.random.default_rng(0).integers(0, 4, (20, 30), dtype=np.uint8)
    write_label_png(path, labels)
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    with pytest.raises(ImageError, match=r"a\.png"):
        read_label_png(path)


@pytest.mark.parametrize("shape", [(4, 5, 3), (4, 5, 4)])
def test_colours_are_refused(shape, tmp_path):
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros(shape, np.uint8))
    with pytest.raises(ImageError, match="class ids, never colours"):
        read_label_png(tmp_path / "c.png")


def test_a_palette_is_refused(tmp_path):
    image = pytest.importorskip("PIL.Image")
    image.fromarray(np.zeros((4, 5), np.uint8)).convert("P").save(tmp_path / "p.png")
    with pytest.raises(ImageError, match=r"palette colour.*class ids, never colours"):
        read_label_png(tmp_path / "p.png")


def test_sixteen_bits_are_no_label_image_but_a_panoptic_mask(tmp_path):
    mask = np.array([[20_001, 20_999, 65_535], [0, 999, 1000]], np.uint16)
    cv2.imwrite(str(tmp_path / "p.png"), mask)
    with pytest.raises(ImageError, match="16 bits; expected one channel of 8 bits"):
        read_label_png(tmp_path / "p.png")
    assert read_panoptic_png(tmp_path / "p.png", 1000).tolist() == [[20, 20, 65], [0, 0, 1]]
    write_label_png(tmp_path / "l.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(ImageError, match="8 bits; expected one channel of 16 bits"):
        read_panoptic_png(tmp_path / "l.png", 1000)


def test_another_size_is_refused_by_the_header(tmp_path):
    write_label_png(tmp_path / "a.png", np.zeros((4, 5), np.uint8))
    read_label_png(tmp_path / "a.png", size_px=(5, 4))
    with pytest.raises(ImageError, match="is 5x4 pixels, but its camera image is 4x5"):
        read_label_png(tmp_path / "a.png", size_px=(4, 5))


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(ImageError, match=r"nothing\.png is missing"):
        read_label_png(tmp_path / "nothing.png")
    with pytest.raises(ImageError, match="cannot be read"):
        read_label_png(tmp_path)


def test_a_jpeg_by_another_name(tmp_path):
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), np.zeros((8, 8), np.uint8))
    with pytest.raises(ImageError, match="is not a PNG"):
        read_label_png(path.rename(tmp_path / "a.png"))


@pytest.mark.parametrize(
    "labels", [np.zeros((2, 2)), np.zeros((2, 2, 1), np.uint8), np.zeros((0, 2), np.uint8)]
)
def test_only_label_images_are_written(labels, tmp_path):
    with pytest.raises(ShapeError, match="uint8"):
        write_label_png(tmp_path / "a.png", labels)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("step", ["fsync", "rename"])
def test_a_failed_write_leaves_the_good_file(step, tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    write_label_png(path, np.zeros((2, 2), np.uint8))
    good = path.read_bytes()

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((os, "fsync") if step == "fsync" else (Path, "replace")), full)
    with pytest.raises(OSError, match="No space"):
        write_label_png(path, np.ones((2, 2), np.uint8))
    assert path.read_bytes() == good
    assert list(tmp_path.iterdir()) == [path]
