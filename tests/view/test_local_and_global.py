"""The local map turned nose up beside the global one: the right cells in the right corners."""

import numpy as np
import pytest
import shapely

from hdmap_tools.errors import OutputExistsError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.testing.scenes import window_from_shapes
from hdmap_tools.view.local_and_global import global_panel, local_and_global_picture, local_panel
from hdmap_tools.view.overview import CameraPicture
from hdmap_tools.view.palette import CLASS_COLORS

LOCAL = BevGrid(0.5, -20, -30, 60, 30)  # x -10..30 m, y -15..15 m
FAR = SE3.from_yaw(0.0, (500.0, 0.0, 0.0))


def nearest_class(pixel) -> str:
    gaps = {
        str(n): np.abs(np.subtract(c, pixel, dtype=float)).sum() for n, c in CLASS_COLORS.items()
    }
    return min(gaps, key=gaps.get)


def test_ahead_is_up_and_left_is_left():
    shapes = {
        "sidewalk": shapely.box(25, -15, 30, 15),  # far ahead
        "crosswalk": shapely.box(-10, 10, 24, 15),  # to the left
        "road": shapely.box(-10, -15, 24, -10),  # to the right
    }
    window = window_from_shapes(shapes, LOCAL, accuracy=0.999)
    picture = local_panel(window, FAR, 10.0)
    assert picture.shape == (400, 300, 3)
    assert nearest_class(picture[20, 150]) == "sidewalk"
    assert nearest_class(picture[250, 20]) == "crosswalk"
    assert nearest_class(picture[250, 280]) == "road"
    assert nearest_class(picture[250, 150]) == "vegetation"


def test_the_vehicle_lies_over_the_rear_axle_and_turns_with_its_pose():
    window = window_from_shapes({}, LOCAL, accuracy=0.999)
    straight = local_panel(window, SE3.identity(), 10.0).astype(int)
    bare = local_panel(window, FAR, 10.0).astype(int)
    changed = np.abs(straight - bare).sum(axis=2) > 30
    rows, cols = np.nonzero(changed)
    # 3.8 m ahead of the axle (row 300) and 1 m behind it, 1.9 m wide, and a thin white edge.
    assert rows.min() == pytest.approx(300 - 38, abs=3)
    assert rows.max() == pytest.approx(300 + 10, abs=3)
    assert (cols.min(), cols.max()) == pytest.approx((150 - 9.5, 150 + 9.5), abs=3)
    left = local_panel(window, SE3.from_yaw(np.pi / 2), 10.0).astype(int)
    rows, cols = np.nonzero(np.abs(left - bare).sum(axis=2) > 30)
    assert cols.min() == pytest.approx(150 - 38, abs=3)
    assert rows.mean() == pytest.approx(300, abs=3)


def test_the_global_panel_shows_the_same_place_north_up():
    city_SE3_ego = SE3.from_yaw(np.pi / 2, (10.0, 20.0, 0.0))
    grid = BevGrid(0.5, -40, -20, 80, 120)
    whole = window_from_shapes({"road": shapely.box(0, -10, 20, 60)}, grid, accuracy=0.999)
    corners = city_SE3_ego.transform_from(
        np.array([[-10, -15, 0], [30, -15, 0], [30, 15, 0], [-10, 15, 0.0]])
    )
    picture = global_panel(whole, (-10.0, 5.0, 30.0, 55.0), 10.0, corners, city_SE3_ego)
    assert picture.shape == (500, 400, 3)
    assert nearest_class(picture[250, 200]) == "road"
    assert nearest_class(picture[250, 20]) == "vegetation"
    # The dashed edge runs along x = -5 m (the vehicle's left) and not along x = 0.
    dark = (picture.astype(int).sum(axis=2) < 200).mean(axis=0)
    assert dark[48:53].max() > 0.3
    assert dark[95:105].max() < 0.1


def test_the_page_is_whole_and_repeatable(tmp_path):
    local = window_from_shapes({"road": shapely.box(-10, -5, 30, 5)}, LOCAL)
    whole = window_from_shapes(
        {"road": shapely.box(-20, -5, 40, 5)}, BevGrid(0.5, -40, -40, 80, 40)
    )
    image = CameraPicture("FRONT", np.full((60, 90, 3), 90, np.uint8))
    pose = SE3.from_yaw(0.02, (1.0, 0.5, 3.0))
    paths = [tmp_path / name for name in ("a.png", "b.png")]
    for path in paths:
        local_and_global_picture(
            path, image, local, SE3.identity(), whole, pose,
            trajectory_xy=np.array([[0.0, 0.0], [1.0, 0.5]]), title="t",
        )  # fmt: skip
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with pytest.raises(OutputExistsError):
        local_and_global_picture(paths[0], None, local, SE3.identity(), whole, pose)
    local_and_global_picture(paths[0], None, local, SE3.identity(), whole, pose, overwrite=True)
    assert paths[0].read_bytes() != paths[1].read_bytes()
