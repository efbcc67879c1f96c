"""The paper's method: clip, project, what hides, labels; held to the plain numpy form."""

import time

import numpy as np
import pytest

from hdmap_tools.association.dense import associate_dense, clip_bounds_m
from hdmap_tools.association.lookup import labels_at, project_city, speaks_of_ground
from hdmap_tools.association.visibility import is_unoccluded
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.camera import Projection
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import Label, LabelSet, load_label_set
from hdmap_tools.point_map.values import MapPoints
from hdmap_tools.testing.street import Street, camera, distance_to_edge, flat, slope, stripes

ADAS = load_label_set("adas-0001")
CONFIG = AssociationConfig()
BOX = (9.0, -1.5, 11.0, 1.5, 1.4)


def dense_ground(street, pose, reach=19.0, step=0.08):
    """Exact ground points around a pose, paint bright."""
    axis = np.arange(-reach, reach, step)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    x, y = x + pose.translation[0], y + pose.translation[1]
    points = np.column_stack([x, y, street.height(x, y)])
    if street.box is not None:
        x0, y0, x1, y1, _ = street.box
        points = points[~((x > x0) & (x < x1) & (y > y0) & (y < y1))]
    bright = np.where(street.label(points[:, 0], points[:, 1]) == 3, 90, 20).astype(np.uint8)
    return MapPoints(points, bright, np.ones(len(points), bool))


def box_points(box, step=0.05):
    x0, y0, x1, y1, top = box
    x, y, z = (
        g.ravel()
        for g in np.meshgrid(
            np.arange(x0, x1, step), np.arange(y0, y1, step), np.arange(0.2, top, step)
        )
    )
    on_side = (x < x0 + step) | (x > x1 - 2 * step) | (y < y0 + step) | (y > y1 - 2 * step)
    return np.column_stack([x, y, z])[on_side | (z > top - 2 * step)]


def joined(ground, standing):
    count = len(standing)
    return MapPoints.joined(
        [ground, MapPoints(standing, np.zeros(count, np.uint8), np.zeros(count, bool))]
    )


@pytest.mark.parametrize("height", [flat, slope])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.3, 0.09, 0.001, -0.0005, -0.01)])
def test_labels_land_where_they_are(height, distortion):
    street, pose, cam = Street(height, stripes), SE3.from_yaw(0.03), camera(distortion=distortion)
    seen = associate_dense(
        street.label_image(cam, pose), ADAS, cam, pose, dense_ground(street, pose), CONFIG
    )
    x, y, z = seen.points_city.T
    clear = distance_to_edge(y) > 0.06
    assert len(seen) > 10_000
    assert (seen.labels == stripes(x, y))[clear].mean() > 0.995
    np.testing.assert_array_equal(z, height(x, y))
    # Paint is bright in the map: intensity belongs to its own point.
    np.testing.assert_array_equal(seen.intensity, np.where(stripes(x, y) == 3, 90, 20))


def test_only_the_clip_at_the_pose_of_the_image_is_labelled():
    street, pose, cam = Street(flat, stripes), SE3.from_yaw(2.1, (40.0, -7.0, 0.0)), camera()
    config = AssociationConfig(clip_ahead_m=12.0, clip_across_m=4.0, min_range_m=5.0)
    points = dense_ground(street, pose)
    seen = associate_dense(street.label_image(cam, pose), ADAS, cam, pose, points, config)
    ego = pose.inverse().transform_from(seen.points_city)
    assert 11.9 < ego[:, 0].max() <= 12.0
    assert 3.9 < np.abs(ego[:, 1]).max() <= 4.0
    from_camera = np.linalg.norm(ego[:, :2] - cam.ego_SE3_cam.translation[:2], axis=1)
    assert 5.0 <= from_camera.min() < 5.1
    x0, y0, x1, y1 = clip_bounds_m(pose, config)
    near = points.points_city
    inside = (near[:, 0] >= x0) & (near[:, 0] <= x1) & (near[:, 1] >= y0) & (near[:, 1] <= y1)
    fewer = MapPoints(near[inside], points.intensity[inside], points.is_ground[inside])
    again = associate_dense(street.label_image(cam, pose), ADAS, cam, pose, fewer, config)
    np.testing.assert_array_equal(again.points_city, seen.points_city)


@pytest.mark.parametrize("where", ["map", "sweep", "nowhere"])
def test_nothing_is_labelled_behind_what_stands_in_the_map_or_in_the_sweep(where):
    street, pose, cam = Street(flat, stripes, BOX), SE3.identity(), camera()
    points, live = dense_ground(street, pose), None
    if where == "map":
        points = joined(points, box_points(BOX))
    if where == "sweep":
        live = box_points(BOX)
    labels = street.label_image(cam, pose)
    seen = associate_dense(labels, ADAS, cam, pose, points, CONFIG, live, 1.3)
    x, y = seen.points_city[:, 0], seen.points_city[:, 1]
    behind = ((x > 11.5) & (np.abs(y) < 1.2)).sum()
    beside = ((x > 9.0) & (x < 14.0) & (np.abs(y) > 3.5)).sum()
    assert beside > 600
    assert behind > 200 if where == "nowhere" else behind == 0


def test_it_equals_the_plain_form():
    street = Street(slope, stripes, BOX)
    pose, cam = SE3.from_yaw(0.1, (0.3, 0.2, 0.0)), camera(distortion=(-0.2, 0.05, 0.001, 0.0, 0.0))
    ground = dense_ground(street, pose, step=0.11)
    points = joined(ground, box_points(BOX))
    labels = street.label_image(cam, pose)
    seen = associate_dense(labels, ADAS, cam, pose, points, CONFIG)

    ego = pose.inverse().transform_from(points.points_city)
    clip = (ego[:, 0] > 0) & (ego[:, 0] <= 15.0) & (np.abs(ego[:, 1]) <= 10.0)
    far = np.linalg.norm(ego[:, :2] - cam.ego_SE3_cam.translation[:2], axis=1) >= CONFIG.min_range_m
    p = project_city(points.points_city, cam, pose)
    p = Projection(p.uv, p.depth_m, p.is_valid & clip)
    use = is_unoccluded(p, ~points.is_ground, cam, gap_h_deg=0.4, gap_v_deg=0.4)
    use &= points.is_ground & far
    found = labels_at(labels, p.uv[use])
    speaks = speaks_of_ground(found, ADAS)
    np.testing.assert_array_equal(seen.points_city, points.points_city[use][speaks])
    np.testing.assert_array_equal(seen.labels, found[speaks])


def test_moving_objects_and_ignored_pixels_say_nothing_of_the_ground():
    label_set = LabelSet(
        name="moving",
        labels=[
            Label(id=0, name="road", color=(1, 1, 1), map_class="road"),
            Label(id=1, name="car", color=(2, 2, 2), moves=True),
        ],
    )
    cam, pose = camera(), SE3.identity()
    image = np.zeros((cam.height_px, cam.width_px), np.uint8)
    image[:, :200], image[:, 400:] = 1, 255
    seen = associate_dense(
        image, label_set, cam, pose, dense_ground(Street(flat, stripes), pose), CONFIG
    )
    assert set(seen.labels.tolist()) == {0}
    uv = project_city(seen.points_city, cam, pose).uv
    assert uv[:, 0].min() >= 199.4
    assert uv[:, 0].max() <= 399.6


def test_a_clip_without_points_gives_none():
    cam, pose = camera(), SE3.identity()
    image = np.zeros((cam.height_px, cam.width_px), np.uint8)
    none = MapPoints.joined([])
    assert len(associate_dense(image, ADAS, cam, pose, none, CONFIG)) == 0
    away = MapPoints(np.full((5, 3), 500.0), np.zeros(5, np.uint8), np.ones(5, bool))
    assert len(associate_dense(image, ADAS, cam, pose, away, CONFIG, np.zeros((0, 3)))) == 0


def test_a_hundred_thousand_points_are_quick():
    cam, pose = camera(), SE3.identity()
    street = Street(flat, stripes)
    points = dense_ground(street, pose, reach=15.0, step=0.095)
    assert len(points) > 95_000
    labels = street.label_image(cam, pose)
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        associate_dense(labels, ADAS, cam, pose, points, CONFIG, box_points(BOX))
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.015  # 3 ms on an idle core
