"""A vehicle on a plane of known slope stands as the plane does."""

import numpy as np

from hdmap_tools.simulate.vehicle_motion import AXLE_HEIGHT_M, vehicle_trajectory

TIMES_NS = (np.arange(200) * 10_000_000).astype(np.int64)


def plane(east: float, north: float):
    return lambda xy: 7.0 + east * xy[:, 0] + north * xy[:, 1]


def test_on_a_plane_the_vehicle_stands_perpendicular_on_it():
    yaw = np.linspace(0.3, 0.5, 200)
    xy = np.column_stack([np.linspace(0, 14, 200), np.linspace(5, 9, 200)])
    poses = vehicle_trajectory(TIMES_NS, xy, yaw, plane(0.08, -0.03))
    up = np.array([-0.08, 0.03, 1.0]) / np.linalg.norm([-0.08, 0.03, 1.0])
    middle = slice(60, 140)  # the suspension has not seen beyond the ends
    np.testing.assert_allclose(poses.rotations[middle, :, 2], np.tile(up, (80, 1)), atol=5e-5)
    # Seen from above, the nose points where the vehicle drives.
    nose = poses.rotations[:, :2, 0]
    np.testing.assert_allclose(np.arctan2(nose[:, 1], nose[:, 0]), yaw, atol=1e-12)
    wheel = poses.translations - AXLE_HEIGHT_M * poses.rotations[:, :, 2]
    height = plane(0.08, -0.03)(wheel[:, :2])
    np.testing.assert_allclose(wheel[middle, 2], height[middle], atol=1e-3)


def test_uphill_the_nose_is_up_and_on_a_bank_to_the_right_the_left_side_is_up():
    xy = np.column_stack([np.linspace(0, 20, 200), np.zeros(200)])
    uphill = vehicle_trajectory(TIMES_NS, xy, np.zeros(200), plane(0.1, 0.0))
    assert (uphill.rotations[:, 2, 0] > 0.09).all()
    banked = vehicle_trajectory(TIMES_NS, xy, np.zeros(200), plane(0.0, 0.05))
    assert (banked.rotations[:, 2, 1] > 0.045).all()
    assert np.abs(banked.rotations[:, 2, 0]).max() < 1e-9


def test_a_bump_is_rounded_off():
    def bump(xy):
        return np.where(np.abs(xy[:, 0] - 10) < 0.2, 0.05, 0.0)

    xy = np.column_stack([np.linspace(0, 20, 200), np.zeros(200)])
    poses = vehicle_trajectory(TIMES_NS, xy, np.zeros(200), bump)
    lift = poses.translations[:, 2] - AXLE_HEIGHT_M
    assert 0.0 < lift.max() < 0.025
