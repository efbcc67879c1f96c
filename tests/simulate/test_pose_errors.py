"""Noise and drift of poses: of the sizes asked for, smooth, and none where none is asked for."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.simulate.pose_errors import disturbed_mount, disturbed_trajectory
from hdmap_tools.simulate.settings import PoseErrors

RATE_HZ, SPEED_MPS = 100, 10.0


def bend(seconds: float) -> Trajectory:
    """A vehicle that drives in a circle of 100 m radius."""
    t = np.arange(round(seconds * RATE_HZ) + 1) / RATE_HZ
    yaw = SPEED_MPS * t / 100.0
    return Trajectory(
        (1e18 + t * 1e9).astype(np.int64),
        Rotation.from_euler("z", yaw[:, None]).as_matrix(),
        np.column_stack([100 * np.sin(yaw), 100 * (1 - np.cos(yaw)), 0 * t]),
    )


def in_ego(truth: Trajectory, given: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, 3) in metres and degrees, in the true ego frame."""
    shift = np.einsum("nji,nj->ni", truth.rotations, given.translations - truth.translations)
    turn = truth.rotations.transpose(0, 2, 1) @ given.rotations
    return shift, np.degrees(Rotation.from_matrix(turn).as_rotvec())


def test_without_errors_the_poses_are_the_true_ones():
    truth = bend(5)
    assert disturbed_trajectory(truth, PoseErrors(), seed=1) is truth
    assert disturbed_mount(mount := SE3.identity(), "cam", 0.0, 0.0, 1) is mount


def test_noise_has_the_sigma_and_the_correlation_asked_for():
    truth = bend(400)
    errors = PoseErrors(noise_m=0.03, noise_deg=0.1, correlation_s=0.5)
    for values, sigma in zip(
        in_ego(truth, disturbed_trajectory(truth, errors, seed=4)), (0.03, 0.1), strict=True
    ):
        # 800 correlation times: sigma to a few percent.
        np.testing.assert_allclose(values.std(axis=0), sigma, rtol=0.12)
        np.testing.assert_allclose(values.mean(axis=0), 0, atol=sigma / 5)
        for lag_s, expected in ((0.05, np.exp(-0.1)), (0.5, np.exp(-1.0)), (3.0, 0.0)):
            lag = round(lag_s * RATE_HZ)
            for axis in values.T:
                assert np.corrcoef(axis[:-lag], axis[lag:])[0, 1] == pytest.approx(
                    expected, abs=0.15
                )
        # The axes know nothing of one another.
        assert np.abs(np.corrcoef(values.T) - np.eye(3)).max() < 0.2


def test_noise_is_the_same_size_from_the_first_pose_on():
    truth = bend(1)
    firsts = [
        in_ego(truth, disturbed_trajectory(truth, PoseErrors(noise_m=0.05), seed))[0][0]
        for seed in range(200)
    ]
    np.testing.assert_allclose(np.std(firsts, axis=0), 0.05, rtol=0.2)


def test_drift_starts_at_nothing_and_reaches_its_sigma_after_100_m():
    truth = bend(30)
    errors = PoseErrors(drift_m=0.2, drift_deg=0.05)
    apart = [in_ego(truth, disturbed_trajectory(truth, errors, seed)) for seed in range(150)]
    shifts, turns = (np.array([a[k] for a in apart]) for k in range(2))
    assert np.abs(shifts[:, 0]).max() < 1e-12
    for metres, share in ((25, 0.5), (100, 1.0), (300, np.sqrt(3))):
        pose = round(metres / SPEED_MPS * RATE_HZ)
        np.testing.assert_allclose(shifts[:, pose].std(), 0.2 * share, rtol=0.15)
        np.testing.assert_allclose(turns[:, pose].std(), 0.05 * share, rtol=0.15)
    # Slow: a knot of 10 m moves by 6 cm (one sigma), the steepest of 13,500 by five times
    # that, and a cubic is up to half as steep again; a step is 10 cm.
    step = np.diff(shifts, axis=1)
    assert np.abs(step).max() < 0.2 * np.sqrt(0.1) * 5 * 1.5 / 100
    # Smooth: neighbouring steps are nearly the same.
    assert np.abs(np.diff(step, axis=1)).max() < 0.05 * np.abs(step).max()


def test_errors_follow_from_the_seed():
    truth = bend(3)
    errors = PoseErrors(noise_m=0.02, drift_deg=0.1)
    one, same, other = (disturbed_trajectory(truth, errors, seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one.translations, same.translations)
    np.testing.assert_array_equal(one.rotations, same.rotations)
    assert np.abs(one.translations - other.translations).max() > 1e-3


def test_very_short_and_very_long_correlation_times_are_possible():
    truth = bend(60)
    for correlation_s in (1e-6, 1e4):
        errors = PoseErrors(noise_m=0.02, correlation_s=correlation_s)
        shift, _ = in_ego(truth, disturbed_trajectory(truth, errors, seed=2))
        assert np.isfinite(shift).all()
        assert np.abs(shift).max() < 0.12
        assert (np.abs(np.diff(shift, axis=0)).max() < 1e-3) == (correlation_s > 1)


def test_one_pose_is_enough():
    truth = Trajectory(np.array([5]), np.eye(3)[None], np.zeros((1, 3)))
    given = disturbed_trajectory(truth, PoseErrors(noise_m=0.1, drift_m=0.1), seed=0)
    assert 0 < np.abs(given.translations).max() < 0.6


def test_each_mount_has_an_error_of_its_own_and_of_its_size():
    mount = SE3.from_yaw(0.7, (1.0, 0.2, 1.5))
    shifts, turns = [], []
    for k in range(300):
        given = disturbed_mount(mount, f"camera_{k}", 0.01, 0.2, seed=5)
        error = mount.inverse() @ given
        shifts.append(error.translation)
        turns.append(np.degrees(Rotation.from_matrix(error.rotation).as_rotvec()))
    np.testing.assert_allclose(np.std(shifts, axis=0), 0.01, rtol=0.15)
    np.testing.assert_allclose(np.std(turns, axis=0), 0.2, rtol=0.15)
