"""Pictures for people: the colours of the labels, half over the image."""

import cv2
import numpy as np
import pytest

from hdmap_tools.errors import LabelError, OutputExistsError, ShapeError
from hdmap_tools.segmentation.overlay import legend_picture, overlay_picture, write_picture


def test_a_pixel_is_half_image_and_half_colour(label_set):
    rgb = np.full((2, 3, 3), 100, np.uint8)
    labels = np.array([[0, 1, 2], [3, 255, 0]], np.uint8)
    mixed = overlay_picture(rgb, labels, label_set)
    assert mixed.tolist() == [
        [[50, 50, 50], [178, 50, 50], [50, 178, 50]],
        [[50, 50, 178], [50, 50, 50], [50, 50, 50]],
    ]
    np.testing.assert_array_equal(overlay_picture(rgb, labels, label_set, 0.0), rgb)


def test_sizes_and_ids_must_fit(label_set):
    rgb = np.zeros((2, 3, 3), np.uint8)
    with pytest.raises(ShapeError, match="of one size"):
        overlay_picture(rgb, np.zeros((3, 2), np.uint8), label_set)
    with pytest.raises(LabelError):
        overlay_picture(rgb, np.full((2, 3), 9, np.uint8), label_set)


def test_the_legend_has_a_patch_of_each_colour_in_its_row(label_set):
    legend = legend_picture(label_set)
    assert legend.shape[0] == 4 * 28
    for row, label in enumerate(label_set.labels):
        assert tuple(legend[row * 28 + 14, 10].tolist()) == label.color
        # And dark letters beside it, on white.
        text = legend[row * 28 : row * 28 + 28, 46:]
        assert text.max() == 255
        assert text.min() < 60


def test_pictures_are_written_in_their_colours_and_not_over_others(tmp_path):
    rgb = np.zeros((16, 16, 3), np.uint8)
    rgb[:, :, 0] = 200
    for name in ("a.png", "deep/er/a.jpg"):
        write_picture(tmp_path / name, rgb)
        found = cv2.imread(str(tmp_path / name))
        np.testing.assert_allclose(found[8, 8], [0, 0, 200], atol=3)
    with pytest.raises(OutputExistsError):
        write_picture(tmp_path / "a.png", rgb)
