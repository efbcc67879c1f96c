"""Sweeps against analytic planes, images and themselves."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toy_scene import HOUSE, ORIGIN, street

from hdmap_tools.errors import PoseError
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.simulate.camera_image import render_image
from hdmap_tools.simulate.lidar_sweep import SimulatedSweep, scan_sweep
from hdmap_tools.simulate.light import CameraLook
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.ray_caster import RayCaster
from hdmap_tools.simulate.scene import label_ids_by_material
from hdmap_tools.simulate.sensor_rigs import GROUND_Z_EGO_M, cameras_of, lidar_of
from hdmap_tools.simulate.settings import CameraRig, LidarPreset, Weather

LIDAR = lidar_of(LidarPreset.RINGS32)
START = ORIGIN + (-5.0, -1.6, -GROUND_Z_EGO_M)


def driving(speed_mps: float = 12.0, yaw_rate: float = 0.5) -> Trajectory:
    """Ahead and turning, 100 Hz, one second."""
    times = np.arange(101, dtype=np.int64) * 10_000_000
    poses = [SE3.from_yaw(yaw_rate * t) for t in times / 1e9]
    places = START + np.column_stack([speed_mps * times / 1e9, 0.3 * times / 1e9, 0 * times])
    return Trajectory(times, np.array([p.rotation for p in poses]), places)


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(street())


@pytest.fixture(scope="module")
def exact(caster: RayCaster) -> SimulatedSweep:
    return scan_sweep(caster, LIDAR, driving(), 200_000_000, 1, with_noise=False)


def to_toy(sweep: SimulatedSweep, trajectory: Trajectory) -> np.ndarray:
    pose = trajectory.interpolate(sweep.timestamp_ns)
    return pose.transform_from(sweep.points_ego.astype(float)) - ORIGIN


def test_points_of_a_moving_lidar_lie_on_the_planes(exact: SimulatedSweep) -> None:
    """Ego-motion compensated: a wall is flat although each ray left from elsewhere."""
    points = to_toy(exact, driving())
    house = exact.materials == Mat.BUILDING_PLASTER
    assert np.abs(points[~house, 2]).max() < 2e-3
    walls = np.abs(points[house][:, None, :2] - np.array([HOUSE[0][:2], HOUSE[1][:2]])[None])
    assert house.sum() > 200
    assert walls.reshape(house.sum(), -1).min(axis=1).max() < 2e-3


def test_rays_leave_at_their_own_time(exact: SimulatedSweep) -> None:
    """Seen from where the lidar was at a point's time, the point is in its firing's direction."""
    trajectory = driving()
    points = to_toy(exact, trajectory) + ORIGIN
    rotations, places = trajectory.interpolate_many(
        exact.timestamp_ns + exact.offset_ns.astype(np.int64)
    )
    origins = np.einsum("nij,j->ni", rotations, LIDAR.ego_SE3_lidar.translation) + places
    local = np.einsum("nji,nj->ni", rotations, points - origins)
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    fired = np.pi - 2 * np.pi * exact.offset_ns / LIDAR.turn_ns
    off = (azimuth - fired + np.pi) % (2 * np.pi) - np.pi
    far = np.linalg.norm(local, axis=1) > 3
    assert np.abs(off[far]).max() < 1e-3
    elevation = np.degrees(np.arcsin(local[:, 2] / np.linalg.norm(local, axis=1)))
    np.testing.assert_allclose(elevation, LIDAR.elevations_deg[exact.laser_number], atol=0.05)
    assert exact.offset_ns.min() >= 0
    assert exact.offset_ns.max() < LIDAR.turn_ns


def test_range_noise_is_as_large_as_it_says(caster: RayCaster, exact: SimulatedSweep) -> None:
    noisy = scan_sweep(caster, LIDAR, driving(0.0, 0.0), 0, 3)
    points = noisy.points_ego.astype(float)
    origin = LIDAR.ego_SE3_lidar.translation
    ranges = np.linalg.norm(points - origin, axis=1)
    ground = noisy.materials != Mat.BUILDING_PLASTER
    true = (origin[2] - GROUND_Z_EGO_M) / -((points - origin)[:, 2] / ranges)
    error = (ranges - true)[ground]
    assert abs(error.mean()) < 0.001
    assert error.std() == pytest.approx(LIDAR.range_sigma_m, rel=0.05)
    assert len(noisy.points_ego) < len(exact.points_ego)


def test_paint_stands_out_and_worn_paint_less(caster: RayCaster) -> None:
    scene = street()
    worn = replace(scene, surface=replace(scene.surface, wear=np.full_like(scene.surface.wear, 60)))
    means = []
    for each in (caster, RayCaster(worn)):
        sweep = scan_sweep(each, lidar_of(LidarPreset.RINGS64), driving(0.0, 0.0), 0, 3)
        distance = np.linalg.norm(sweep.points_ego[:, :2], axis=1)
        near = (distance > 7) & (distance < 13)
        asphalt = sweep.intensity[near & (sweep.materials == Mat.ASPHALT)].mean()
        paint = sweep.intensity[near & (sweep.materials == Mat.PAINT_WHITE)].mean()
        assert 10 <= asphalt <= 25
        means.append(paint)
    assert 60 <= means[0] <= 110
    assert 15 < means[1] < 0.6 * means[0]


def test_far_and_wet_ground_gives_fewer_points(caster: RayCaster) -> None:
    lidar = lidar_of(LidarPreset.RINGS64)
    shares = {}
    for weather in (Weather.CLEAR, Weather.WET):
        sweep = scan_sweep(caster, lidar, driving(0.0, 0.0), 0, 3, weather=weather)
        full = scan_sweep(caster, lidar, driving(0.0, 0.0), 0, 3, with_noise=False)
        # The same rays that could have come back.
        reach = np.linalg.norm(sweep.points_ego[:, :2], axis=1)
        could = np.linalg.norm(full.points_ego[:, :2], axis=1)
        shares[weather] = [
            ((reach > a) & (reach < b)).sum() / max(((could > a) & (could < b)).sum(), 1)
            for a, b in ((6, 12), (25, 40))
        ]
    assert shares[Weather.CLEAR][0] > 0.95
    assert shares[Weather.CLEAR][1] < shares[Weather.CLEAR][0]
    assert shares[Weather.WET][1] < shares[Weather.CLEAR][1]


def test_one_seed_one_sweep(caster: RayCaster) -> None:
    first, again, other = (scan_sweep(caster, LIDAR, driving(), 0, seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.points_ego, again.points_ego)
    np.testing.assert_array_equal(first.intensity, again.intensity)
    assert len(first.points_ego) != len(other.points_ego)


def test_a_turn_without_poses_is_refused(caster: RayCaster) -> None:
    with pytest.raises(PoseError, match="not covered"):
        scan_sweep(caster, LIDAR, driving(), 950_000_000, 0)


def test_image_and_sweep_agree_to_a_pixel(caster: RayCaster) -> None:
    """Exact points, projected, lie on pixels of their own material, but for one pixel at edges."""
    names = tuple(label.name for label in load_label_set("paz2020").labels)
    trajectory = driving()
    sweep = scan_sweep(
        caster, lidar_of(LidarPreset.RINGS64), trajectory, 300_000_000, 1, with_noise=False
    )
    pose = trajectory.interpolate(300_000_000)
    camera = cameras_of(CameraRig.FRONT)[0]
    image = render_image(caster, camera, pose, -100.0, CameraLook(), 0)
    seen = camera.project(sweep.points_ego.astype(float))
    u, v = np.rint(seen.uv[seen.is_valid]).astype(int).T
    depth = seen.depth_m[seen.is_valid]
    # The camera sees what the lidar, elsewhere on the roof, sees: not what stands before it.
    # Beyond 25 m a mark may be narrower than two pixels, and no pixel's centre need meet it.
    visible = (image.depth_m[v, u] > depth - 0.3) & (depth < 25)
    labels = label_ids_by_material(names)[sweep.materials[seen.is_valid]]
    rows = np.clip(v[:, None] + [-1, -1, -1, 0, 0, 0, 1, 1, 1], 0, camera.height_px - 1)
    cols = np.clip(u[:, None] + [-1, 0, 1, -1, 0, 1, -1, 0, 1], 0, camera.width_px - 1)
    agrees = (image.labels[rows, cols] == labels[:, None]).any(axis=1)
    assert visible.sum() > 20_000
    # The tip of a sharp corner can lie between pixel centres; nothing else may.
    assert (~agrees[visible]).sum() <= 2
    assert (image.labels[v, u] == labels)[visible].mean() > 0.97
