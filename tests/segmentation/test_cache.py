"""The cache gives back what was computed, and nothing else."""

import logging
import threading

import cv2
import numpy as np
import pytest

from hdmap_tools.errors import CalibrationError, ImageError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.segmentation.cache import LabelCache, default_folder, segment_drive
from hdmap_tools.segmentation.label_png import write_label_png
from hdmap_tools.segmentation.precomputed import PrecomputedSegmenter, label_path


class RedIsOne:
    """Counts how often it is asked; labels red pixels 1."""

    name = "red-is-one"
    fingerprint = "version 1"

    def __init__(self, label_set, cameras):
        self.label_set = label_set
        self.cameras = cameras
        self.asked = []

    def segment(self, image):
        self.asked.append(image.timestamp_ns)
        rgb = read_image(image, self.cameras[image.camera])
        return (rgb[:, :, 0] > 0).astype(np.uint8)


@pytest.fixture
def segmenter(label_set, drive):
    return RedIsOne(label_set, drive.cameras)


@pytest.fixture
def cache(tmp_path):
    return LabelCache(tmp_path / "cache")


def run(drive, segmenter, cache, images=None):
    return [labels for _, labels in segment_drive(drive, segmenter, images or drive.images, cache)]


def files(cache):
    return [path for path in cache.folder.rglob("*") if path.is_file()]


def test_a_second_run_computes_nothing_and_gives_the_same(drive, segmenter, cache):
    first = run(drive, segmenter, cache)
    assert segmenter.asked == [1000, 1001, 1002]
    assert [labels[0, 0] for labels in first] == [0, 1, 0]
    second = run(drive, segmenter, LabelCache(cache.folder))
    assert segmenter.asked == [1000, 1001, 1002]
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(files(cache)) == 3


def test_a_changed_image_or_segmenter_is_computed_anew(drive, segmenter, cache):
    run(drive, segmenter, cache)
    cv2.imwrite(str(drive.images[0].path), np.zeros((12, 16, 3), np.uint8))
    assert not run(drive, segmenter, cache)[0].any()
    assert segmenter.asked[3:] == [1000]
    segmenter.fingerprint = "version 2"
    run(drive, segmenter, cache)
    assert len(segmenter.asked) == 4 + 3


def test_the_same_picture_at_another_time_is_known(drive, segmenter, cache):
    run(drive, segmenter, cache)
    again = ImageRef("front", 5000, drive.images[1].path)
    assert run(drive, segmenter, cache, [again])[0][0, 0] == 1
    assert 5000 not in segmenter.asked


def test_another_image_size_is_another_entry(drive, segmenter, cache):
    larger = PinholeCamera("front", 32, 24, 1.0, 1.0, 0.0, 0.0, SE3.identity())
    image = drive.images[0]
    paths = {cache.path_of(segmenter, image, camera) for camera in (larger, drive.cameras["front"])}
    assert len(paths) == 2


def png(labels):
    return cv2.imencode(".png", labels)[1].tobytes()


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: content[:-1],
        lambda content: content[:50] + bytes([content[50] ^ 1]) + content[51:],
        lambda content: b"not a picture",
        lambda content: png(np.zeros((12, 16, 3), np.uint8)),
        lambda content: png(np.zeros((16, 12), np.uint8)),
        lambda content: png(np.full((12, 16), 4, np.uint8)),
    ],
    ids=["empty", "half", "cut", "bit", "text", "colour", "size", "id"],
)
def test_a_damaged_entry_is_computed_anew_and_replaced(damage, drive, segmenter, cache, caplog):
    image = drive.images[1]
    (good,) = run(drive, segmenter, cache, [image])
    (path,) = files(cache)
    content = path.read_bytes()
    path.write_bytes(damage(content))
    with caplog.at_level(logging.WARNING):
        (labels,) = run(drive, segmenter, cache, [image])
    np.testing.assert_array_equal(labels, good)
    assert segmenter.asked == [1001, 1001]
    assert "Computed anew" in caplog.text
    assert path.read_bytes() == content


def test_a_cache_that_cannot_be_written_is_one_warning(drive, segmenter, tmp_path, caplog):
    (tmp_path / "file").write_text("in the way")
    cache = LabelCache(tmp_path / "file" / "cache")
    with caplog.at_level(logging.WARNING):
        labels = run(drive, segmenter, cache)
    assert [one[0, 0] for one in labels] == [0, 1, 0]
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "are not cached" in caplog.text


def test_an_image_that_does_not_decode_comes_at_its_turn(drive, segmenter, cache):
    drive.images[1].path.write_bytes(b"\xff\xd8 no picture")
    results = segment_drive(drive, segmenter, drive.images, cache)
    assert next(results)[0] is drive.images[0]
    with pytest.raises(ImageError, match=r"1\.png"):
        next(results)
    assert len(files(cache)) == 1


def test_a_missing_image_is_the_segmenters_error(drive, segmenter, cache):
    drive.images[0].path.unlink()
    with pytest.raises(ImageError, match=r"0\.png"):
        run(drive, segmenter, cache)


def test_an_unknown_camera(drive, segmenter, cache, tmp_path):
    with pytest.raises(CalibrationError, match="'rear'"):
        run(drive, segmenter, cache, [ImageRef("rear", 0, tmp_path / "x.png")])


def test_nothing_is_computed_before_it_is_taken(drive, segmenter, cache):
    threads_before = threading.active_count()
    results = segment_drive(drive, segmenter, drive.images, cache)
    assert segmenter.asked == []
    next(results)
    assert segmenter.asked == [1000]
    results.close()
    assert segmenter.asked == [1000]
    assert threading.active_count() == threads_before


def test_progress_counts_up_to_the_total(drive, segmenter):
    told = []
    list(segment_drive(drive, segmenter, drive.images, None, lambda d, t: told.append((d, t))))
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    told.clear()
    assert list(segment_drive(drive, segmenter, (), None, lambda d, t: told.append((d, t)))) == []
    assert told == [(0, 0)]


def test_precomputed_labels_are_not_cached(drive, label_set, cache, tmp_path):
    for image in drive.images:
        write_label_png(label_path(tmp_path / "labels", image), np.zeros((12, 16), np.uint8))
    precomputed = PrecomputedSegmenter(tmp_path / "labels", label_set, drive.cameras)
    assert len(run(drive, precomputed, cache)) == 3
    assert files(cache) == []


def test_the_default_folder_is_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_folder() == tmp_path / "xdg" / "hdmap_tools" / "labels"
    assert LabelCache().folder == default_folder()
    for value in ("", "relative/path"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert default_folder() == tmp_path / ".cache" / "hdmap_tools" / "labels"
