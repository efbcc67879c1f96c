"""Points drawn into a picture, pixel by pixel."""

import numpy as np
import pytest

from hdmap_tools.calibration.overlay import overlay_points
from hdmap_tools.errors import ConfigError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3

CAMERA = PinholeCamera("CAM", 320, 200, 200.0, 200.0, 160.0, 100.0, SE3.identity())
GREY = np.full((200, 320, 3), 128, dtype=np.uint8)


def drawn(points, **given):
    overlay = overlay_points(GREY, CAMERA, np.array(points, dtype=np.float64), **given)
    return overlay, (overlay.picture[:200] != 128).any(axis=2)


def test_a_point_is_drawn_where_it_is_seen():
    overlay, changed = drawn([[1.0, -0.5, 10.0]], radius_px=1)
    rows, columns = np.nonzero(changed)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (89, 91, 179, 181)
    assert changed.sum() == 9
    assert (overlay.num_drawn, overlay.num_points) == (1, 1)
    assert (GREY == 128).all()


def test_the_near_point_lies_on_top_whatever_the_order():
    near, far = [0.0, 0, 5.0], [0.0, 0, 50.0]
    alone = drawn([near], radius_px=2)[0].picture[100, 160]
    for points in ([near, far], [far, near]):
        np.testing.assert_array_equal(drawn(points, radius_px=2)[0].picture[100, 160], alone)
    # Whole dots: a corner that both cover too.
    beside = [0.05, 0, 5.0]  # two pixels to the right
    picture = drawn([far, beside], radius_px=2)[0].picture
    np.testing.assert_array_equal(picture[100, 161], alone)


def test_colour_goes_from_red_to_blue():
    near, far = (drawn([[0.0, 0, z]])[0].picture[100, 160].astype(int) for z in (2.0, 59.0))
    assert near[0] > near[2] + 50
    assert far[2] > far[0]


def test_points_behind_beside_and_beyond_are_left_out():
    points = [[0, 0, -5.0], [50.0, 0, 5], [0, 0, 61.0], [0, 0, 59.0]]
    overlay, _ = drawn(points)
    assert (overlay.num_drawn, overlay.num_points) == (1, 4)


def test_dots_are_cut_at_the_edge():
    overlay, changed = drawn([[-160 / 200 * 10, -100 / 200 * 10, 10.0]], radius_px=3)
    assert overlay.num_drawn == 1
    assert changed.sum() == 16
    assert changed[:4, :4].all()


def test_no_points_leave_the_picture_as_it_is():
    overlay, changed = drawn(np.empty((0, 3)))
    assert not changed.any()
    assert overlay.picture.shape[0] > 200


def test_bad_input():
    with pytest.raises(ShapeError, match="calibrated for"):
        overlay_points(GREY[:100], CAMERA, np.zeros((1, 3)))
    for max_range_m in (0.0, np.nan):
        with pytest.raises(ConfigError):
            overlay_points(GREY, CAMERA, np.zeros((1, 3)), max_range_m=max_range_m)
