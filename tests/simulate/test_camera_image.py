"""Images and their labels against exact geometry, and what light must do."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toy_scene import ORIGIN, street

from hdmap_tools.errors import CalibrationError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.simulate.camera_image import CameraImage, render_image
from hdmap_tools.simulate.light import CameraLook, light_of
from hdmap_tools.simulate.ray_caster import RayCaster
from hdmap_tools.simulate.sensor_rigs import GROUND_Z_EGO_M, cameras_of
from hdmap_tools.simulate.settings import CameraRig, Difficulty, Weather

LABELS = {label.name: label.id for label in load_label_set("paz2020").labels}
CAMERA = cameras_of(CameraRig.FRONT, 960, 600)[0]
POSE = SE3.from_yaw(0.06, tuple(ORIGIN + (-5.0, -1.6, -GROUND_Z_EGO_M)))


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(street(with_car=True))


@pytest.fixture(scope="module")
def image(caster: RayCaster) -> CameraImage:
    return render_image(caster, CAMERA, POSE, -100.0, CameraLook(seed=1), 5)


def project(points: np.ndarray, camera: PinholeCamera = CAMERA) -> np.ndarray:
    return camera.project(POSE.inverse().transform_from(points + ORIGIN)).uv


def test_corners_of_stripes_are_on_their_pixels(image: CameraImage) -> None:
    """Just inside a corner the label is the stripe's, just outside it is not."""
    corners, inside, outside = [], [], []
    for y in range(-3, 3):
        for x, sx in ((10.0, 1), (13.0, -1)):
            for dy, sy in ((0.0, 1), (0.5, -1)):
                corners.append((x, y + dy, 0.0))
                inside.append((x + 0.3 * sx, y + dy + 0.1 * sy, 0.0))
                outside.append((x - 0.3 * sx, y + dy + 0.1 * sy, 0.0))
    labels = image.labels
    u, v = np.rint(project(np.array(inside))).astype(int).T
    assert (labels[v, u] == LABELS["crosswalk"]).all()
    u, v = np.rint(project(np.array(outside))).astype(int).T
    assert not (labels[v, u] == LABELS["crosswalk"]).any()
    # The near edge, x = 10, between road and zebra, falls where projection puts it.
    for y in np.linspace(-2.9, 2.9, 30):
        u, v = project(np.array([(10.0, y, 0.0)]))[0]
        column = labels[:, round(u)]
        rows = np.flatnonzero(column == LABELS["crosswalk"])
        assert abs(rows.max() + 0.5 - v) <= 1.0


def test_a_checker_of_ground_cells_is_seen_to_the_pixel(image: CameraImage) -> None:
    """Every ground pixel carries the label of the cell that its own ray, in float64, meets."""
    scene = street(with_car=True)
    v, u = np.mgrid[300:600, 0:960]
    uv = np.column_stack([u.ravel(), v.ravel()])
    rays = CAMERA.rays_ego(uv.astype(float)) @ POSE.rotation.T
    origin = (POSE @ CAMERA.ego_SE3_cam).translation
    depth = (ORIGIN[2] - origin[2]) / rays[:, 2]
    near = (depth > 0) & (depth < 40)
    points = origin + depth[:, None] * rays
    grid = scene.surface.grid
    # Where the ray is within 1 mm of a cell's edge, float32 may take the other side.
    rest = np.abs(points[:, :2] / grid.resolution_m - np.rint(points[:, :2] / grid.resolution_m))
    near &= (rest > 0.05).all(axis=1)
    cells = grid.rows_cols_of(points)
    near &= grid.contains(cells)
    labels = image.labels[uv[:, 1], uv[:, 0]]
    ground = near & np.isclose(image.depth_m[uv[:, 1], uv[:, 0]], depth, rtol=1e-3)
    assert ground.sum() > 150_000
    paint = np.isin(scene.surface.codes[tuple(cells[ground].T)], (4, 5))
    np.testing.assert_array_equal(paint, labels[ground] == LABELS["lane marking"])


def test_depth_is_along_the_optical_axis(image: CameraImage) -> None:
    corner = np.array([(20.0, 8.0, 3.0)])
    seen = CAMERA.project(POSE.inverse().transform_from(corner + ORIGIN))
    u, v = np.rint(seen.uv[0]).astype(int)
    assert image.depth_m[v, u - 1 : u + 2].min() == pytest.approx(seen.depth_m[0], abs=0.15)
    assert np.isinf(image.depth_m[image.labels == LABELS["sky"]]).all()


def test_one_seed_one_image(caster: RayCaster, image: CameraImage) -> None:
    again = render_image(RayCaster(caster.scene), CAMERA, POSE, -100.0, CameraLook(seed=1), 5)
    np.testing.assert_array_equal(again.rgb, image.rgb)
    np.testing.assert_array_equal(again.labels, image.labels)
    other = render_image(caster, CAMERA, POSE, -100.0, CameraLook(seed=1), 6)
    assert (other.rgb != image.rgb).mean() > 0.3
    np.testing.assert_array_equal(other.labels, image.labels)


@pytest.mark.parametrize("weather", list(Weather))
def test_every_weather_shows_marks_brighter_than_road(caster: RayCaster, weather: Weather) -> None:
    camera = CAMERA.scaled(480, 300)
    look = CameraLook(weather=weather, difficulty=Difficulty.HARD, seed=3)
    seen = render_image(caster, camera, POSE, -100.0, look, 1)
    grey = seen.rgb.mean(axis=2)
    near = seen.depth_m < 15
    road = grey[near & (seen.labels == LABELS["road"])]
    marks = grey[near & (seen.labels == LABELS["lane marking"])]
    assert 30 < np.median(road) < 170
    assert np.median(marks) > np.median(road) + 25
    assert (grey > 252).mean() < 0.3


def test_far_marks_fade_instead_of_flickering(caster: RayCaster) -> None:
    """Averaged over a pixel's footprint, far dashes keep their brightness as the camera moves."""
    look = CameraLook(weather=Weather.OVERCAST, difficulty=Difficulty.EASY, seed=1)
    sums = []
    for step in range(6):
        pose = SE3(np.eye(3), ORIGIN + (-10.0 + 0.37 * step, -1.6, -GROUND_Z_EGO_M))
        seen = render_image(caster, CAMERA, pose, -100.0, look, 1)
        # The left edge line, always there, between 40 and 55 m ahead of the start.
        line = np.column_stack([np.linspace(30, 45, 60), np.full(60, 3.2), np.zeros(60)])
        u, v = (
            np.rint(CAMERA.project(pose.inverse().transform_from(line + ORIGIN)).uv).astype(int).T
        )
        rows = np.unique(v)
        at = [round(float(u[v == row].mean())) for row in rows]
        peak = [
            seen.rgb[row, x - 2 : x + 3].mean(axis=1).max() for row, x in zip(rows, at, strict=True)
        ]
        sums.append(np.mean(peak))
    assert np.std(sums) < 0.05 * np.mean(sums)


def test_a_shadow_lies_on_the_side_away_from_the_sun(caster: RayCaster) -> None:
    look = CameraLook(seed=4)
    sun = np.array(light_of(look).sun_direction)
    # Beside the car, on its shadow side and on its sunny side, seen from so high above that
    # its roof hides neither.
    car = np.array([0.0, -5.0, 0.0])
    side = -sun[:2] / np.linalg.norm(sun[:2])
    reach = (0.9 if abs(side[1]) > abs(side[0]) else 2.2) + 0.25
    down = SE3(np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]), np.zeros(3))
    camera = PinholeCamera("above", 200, 200, 660.0, 660.0, 99.5, 99.5, down)
    pose = SE3(np.eye(3), ORIGIN + car + (0, 0, 40.0))
    seen = render_image(caster, camera, pose, 0.0, look, 1)
    grey = seen.rgb.mean(axis=2)

    def at(xy: np.ndarray) -> float:
        point = np.array([[*xy, 0.0]]) + ORIGIN + car
        u, v = np.rint(camera.project(pose.inverse().transform_from(point)).uv[0]).astype(int)
        return float(grey[v - 1 : v + 2, u - 1 : u + 2].mean())

    step = np.array([0.0, np.sign(side[1])]) if reach < 2 else np.array([np.sign(side[0]), 0.0])
    assert at(step * reach) < 0.7 * at(-step * reach)


def test_a_camera_with_distortion_is_refused(caster: RayCaster) -> None:
    camera = replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(CalibrationError, match="rectified"):
        render_image(caster, camera, POSE, 0.0, CameraLook(), 0)


@pytest.mark.parametrize("rig", list(CameraRig))
def test_rigs_have_argoverse_names_and_look_level(rig: CameraRig) -> None:
    cameras = cameras_of(rig, 640, 400)
    assert (
        len({c.name for c in cameras}) == len(cameras) == {"front": 1, "front3": 3, "ring6": 6}[rig]
    )
    for camera in cameras:
        assert camera.name.startswith("ring_")
        assert (camera.width_px, camera.height_px) == (640, 400)
        view = camera.ego_SE3_cam.rotation[:, 2]
        assert -0.1 < view[2] <= 0
        assert camera.ego_SE3_cam.translation[2] == pytest.approx(1.55 + GROUND_Z_EGO_M)
    ahead = cameras[0].project(np.array([[30.0, 0.0, 1.0]]))
    assert ahead.is_valid[0]
