"""Ego-motion compensation against scenes whose truth is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.errors import PoseError, ShapeError
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.motion import compensate_ego_motion, undo_ego_motion_compensation

T0_NS = 1_600_000_000_000_000_000
SPEED_M_S, TURN_RAD_S = 15.0, 0.6


def true_pose(offset_ns: int) -> SE3:
    """On a circle, far from the city origin, on a slope across the city's axes, pitching a little.

    The slope keeps the pose at time 0 from being a mere shift, and the turns from commuting.
    """
    t = offset_ns / 1e9
    yaw, radius = TURN_RAD_S * t, SPEED_M_S / TURN_RAD_S
    pitch = SE3.from_quaternion(np.cos(0.01 * t), 0.0, np.sin(0.01 * t), 0.0, np.zeros(3))
    xyz = (5000 + radius * np.sin(yaw), 2000 + radius * (1 - np.cos(yaw)), 60.0)
    slope = SE3.from_quaternion(0.95, 0.1, -0.2, 0.2, np.zeros(3))
    return SE3(np.eye(3), np.array(xyz)) @ slope @ SE3.from_yaw(yaw) @ pitch


def true_trajectory(offsets_ns: np.ndarray) -> Trajectory:
    poses = [true_pose(int(offset)) for offset in offsets_ns]
    return Trajectory(
        T0_NS + offsets_ns,
        np.array([p.rotation for p in poses]),
        np.array([p.translation for p in poses]),
    )


def test_a_wall_seen_from_a_moving_turning_ego_becomes_a_wall() -> None:
    # The lidar fires 200 times in 0.1 s; poses are known at just these times.
    firings = np.arange(200, dtype=np.int64) * 500_000
    offsets = np.repeat(firings, 5)
    rng = np.random.default_rng(1)
    wall_city = np.column_stack(
        [np.full(1000, 5030.0), 2000 + rng.uniform(-15, 15, 1000), 60 + rng.uniform(0, 4, 1000)]
    )
    seen = np.vstack(
        [
            true_pose(int(offset)).inverse().transform_from(point[None])
            for offset, point in zip(offsets, wall_city, strict=True)
        ]
    )

    compensated = compensate_ego_motion(seen, offsets, T0_NS, true_trajectory(firings))

    in_city = true_pose(0).transform_from(compensated)
    np.testing.assert_allclose(in_city, wall_city, rtol=0, atol=1e-9)
    smeared = true_pose(0).transform_from(seen)
    assert np.abs(smeared[:, 0] - 5030.0).max() > 1.0  # without compensation it is no wall


def test_the_reference_may_lie_inside_or_after_the_sweep() -> None:
    knots = np.arange(-100, 101, dtype=np.int64) * 1_000_000
    point_city = np.array([[5020.0, 2003.0, 61.0]])
    for offset in (-60_000_000, 0, 60_000_000):
        seen = true_pose(offset).inverse().transform_from(point_city)
        compensated = compensate_ego_motion(seen, np.array([offset]), T0_NS, true_trajectory(knots))
        np.testing.assert_allclose(
            true_pose(0).transform_from(compensated), point_city, rtol=0, atol=1e-9
        )


@settings(deadline=None, max_examples=50)
@given(
    offsets=st.lists(st.integers(-90_000_000, 90_000_000), min_size=0, max_size=30),
    seed=st.integers(0, 2**32 - 1),
)
def test_undoing_is_the_exact_inverse_and_rows_are_independent(
    offsets: list[int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-100, 100, (len(offsets), 3))
    offsets_ns = np.array(offsets, dtype=np.int64)
    trajectory = true_trajectory(np.arange(-5, 6, dtype=np.int64) * 20_000_000)

    compensated = compensate_ego_motion(points, offsets_ns, T0_NS, trajectory)

    back = undo_ego_motion_compensation(compensated, offsets_ns, T0_NS, trajectory)
    np.testing.assert_allclose(back, points, rtol=0, atol=1e-9)
    shuffled = rng.permutation(len(points))
    np.testing.assert_array_equal(
        compensate_ego_motion(points[shuffled], offsets_ns[shuffled], T0_NS, trajectory),
        compensated[shuffled],
    )


def test_points_at_the_reference_time_do_not_move() -> None:
    points = np.random.default_rng(0).uniform(-50, 50, (20, 3))
    knots = np.arange(-2, 3, dtype=np.int64) * 30_000_000
    result = compensate_ego_motion(
        points, np.zeros(20, dtype=np.int64), T0_NS, true_trajectory(knots)
    )
    np.testing.assert_allclose(result, points, rtol=0, atol=1e-12)


def test_times_without_a_pose_are_refused() -> None:
    trajectory = true_trajectory(np.array([0, 50_000_000], dtype=np.int64))
    with pytest.raises(PoseError, match=r"No ego pose at 1 of 2 times .* compensate the sweep"):
        compensate_ego_motion(np.zeros((1, 3)), np.array([50_000_001]), T0_NS, trajectory)
    with pytest.raises(PoseError, match=r"gaps of at most 0\.01 s"):
        compensate_ego_motion(
            np.zeros((1, 3)), np.array([20_000_000]), T0_NS, trajectory, max_gap_s=0.01
        )


def test_offsets_must_match_the_points() -> None:
    with pytest.raises(ShapeError, match=r"found \(2, 3\) and \(3,\)"):
        compensate_ego_motion(
            np.zeros((2, 3)), np.zeros(3), T0_NS, true_trajectory(np.array([0], dtype=np.int64))
        )
