"""A lens with distortion: straight lines for the network, labels for the recorded pixels.

The scene is a chess board on the plane one metre ahead, drawn exactly, a ray a pixel.
"""

import dataclasses

import cv2
import numpy as np
import pytest

from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import IGNORE_ID
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.network import Handling, Network, NetworkSegmenter
from hdmap_tools.segmentation.undistortion import MAX_MARGIN, Rectification, _rectified_places

SQUARE_M = 0.08
LENSES = {
    "barrel": (-0.3, 0.1, 0.001, -0.002, 0.0),
    "pincushion": (0.15, 0.02, -0.001, 0.001, 0.0),
}
MOUNT = SE3.from_yaw(0.4, (1.0, 2.0, 1.5))


def camera(distortion=LENSES["barrel"]):
    return PinholeCamera("front", 320, 240, 250.0, 255.0, 163.2, 115.7, MOUNT, distortion)


def chess(lens):
    """(h, w) uint8: 1 and 2 by turns, 0 beyond what the lens model reaches."""
    u, v = np.meshgrid(np.arange(lens.width_px), np.arange(lens.height_px))
    rays = lens.rays_ego(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    xy = (rays @ lens.ego_SE3_cam.rotation)[:, :2]
    parity = np.floor(np.nan_to_num(xy) / SQUARE_M).sum(axis=1) % 2
    board = np.where(np.isfinite(xy).all(axis=1), 1 + parity, 0).astype(np.uint8)
    return board.reshape(v.shape)


def away_from_edges(board, by_px=2):
    """Where all pixels within that distance are of one square."""
    kernel = np.ones((2 * by_px + 1,) * 2, np.uint8)
    return cv2.erode(board, kernel) == cv2.dilate(board, kernel)


@pytest.mark.parametrize("lens", LENSES)
def test_the_rectified_picture_is_the_one_of_a_camera_without_distortion(lens):
    recorded = camera(LENSES[lens])
    way = Rectification(recorded)
    assert not way.camera.is_distorted
    assert (way.camera.fx, way.camera.fy) == (recorded.fx, recorded.fy)
    grey = np.array([0, 60, 200], np.uint8)
    rectified = way.rectify(np.repeat(grey[chess(recorded)][:, :, None], 3, axis=2), (9, 9, 9))
    ideal = grey[chess(way.camera)]
    assert rectified.shape == (*ideal.shape, 3)
    shown = way.rectify(np.full((240, 320, 3), 255, np.uint8))[:, :, 0] == 255
    sure = away_from_edges(ideal) & shown
    assert sure.mean() > 0.4
    np.testing.assert_array_equal(rectified[:, :, 0][sure], ideal[sure])
    # The board as recorded is bent: it is not already the ideal one.
    height, width = (min(a, b) for a, b in zip(ideal.shape, chess(recorded).shape, strict=True))
    bent = grey[chess(recorded)][:height, :width] != ideal[:height, :width]
    assert bent.mean() > 0.1


@pytest.mark.parametrize("lens", LENSES)
def test_labels_come_back_to_the_pixels_they_were_seen_at(lens):
    recorded = camera(LENSES[lens])
    way = Rectification(recorded)
    back = way.to_recorded(chess(way.camera))
    truth = chess(recorded)
    assert back.shape == truth.shape == (240, 320)
    known = back != IGNORE_ID
    assert known.mean() > 0.99
    sure = away_from_edges(truth) & known
    assert sure.mean() > 0.4
    np.testing.assert_array_equal(back[sure], truth[sure])


def test_a_lens_that_sees_very_wide_is_cut_and_the_rest_is_not_judged():
    wide = dataclasses.replace(camera((-0.32, 0.12, 0.0, 0.0, -0.018)), fx=120.0, fy=120.0)
    way = Rectification(wide)
    assert way.camera.width_px <= 320 * (1 + 2 * MAX_MARGIN)
    assert way.camera.height_px <= 240 * (1 + 2 * MAX_MARGIN)
    back = way.to_recorded(np.ones((way.camera.height_px, way.camera.width_px), np.uint8))
    assert back[120, 160] == 1
    assert back[0, 0] == back[-1, -1] == IGNORE_ID


@pytest.mark.parametrize("lens", LENSES)
def test_places_between_those_solved_are_right(lens):
    recorded = camera(LENSES[lens])
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    rays = recorded.rays_ego(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    exact = (rays @ MOUNT.rotation)[:, :2] * (250.0, 255.0) + (163.2, 115.7)
    np.testing.assert_allclose(_rectified_places(recorded), exact, atol=0.1)


def seeing_straight(recorded, label_set, make_profile, handling=None):
    """A network that knows what a camera without distortion would see, and looks at nothing."""
    ideal = Rectification(recorded).camera

    def run(batch):
        height, width = batch.shape[2:]
        lens = ideal if (width, height) == (ideal.width_px, ideal.height_px) else None
        if lens is None:
            lens = dataclasses.replace(recorded, distortion=(0.0,) * 5)
        return chess(lens)[None].astype(np.int64)

    return NetworkSegmenter(
        Network("straight.onnx", "none 1", "0" * 64, (1, 3, None, None), run),
        make_profile(input_size_px=None, output="ids"),
        {recorded.name: recorded},
        label_set=label_set,
        handling=handling,
    )


@pytest.mark.parametrize("lens", LENSES)
def test_a_network_that_sees_straight_lines_labels_the_recorded_image(
    lens, label_set, make_profile, tmp_path
):
    recorded = camera(LENSES[lens])
    truth = chess(recorded)
    image = ImageRef("front", 5, tmp_path / "5.png")
    cv2.imwrite(str(image.path), truth * 80)
    sure = away_from_edges(truth)
    labels = seeing_straight(recorded, label_set, make_profile).segment(image)
    judged = sure & (labels != IGNORE_ID)
    assert judged.sum() > 0.99 * sure.sum()
    np.testing.assert_array_equal(labels[judged], truth[judged])
    # Fed as recorded the same network is wrong: the lens is what makes the difference.
    plain = Handling(undistort=False)
    bent = seeing_straight(recorded, label_set, make_profile, plain).segment(image)
    assert (bent[sure] != truth[sure]).mean() > 0.1


def test_lenses_are_in_the_fingerprint_and_only_where_they_matter(label_set, make_profile):
    def fingerprint(distortion, undistort=True):
        lens = camera(distortion)
        handling = Handling(undistort=undistort)
        return seeing_straight(lens, label_set, make_profile, handling).fingerprint

    none = (0.0,) * 5
    assert fingerprint(LENSES["barrel"]) != fingerprint(LENSES["pincushion"])
    assert fingerprint(LENSES["barrel"], undistort=False) == fingerprint(none)
    assert fingerprint(none, undistort=False) == fingerprint(none)
