"""What is wrong with the poses and mounts that a simulated drive hands out; the truth is kept beside."""

from __future__ import annotations

import zlib
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.simulate.settings import PoseErrors
from hdmap_tools.types import NDArrayFloat

DRIFT_REACHED_AFTER_M: Final = 100.0
"""Distance after which the drift of each axis has the sigma that is asked for."""

_DRIFT_KNOT_M: Final = 10.0
_STEPS_PER_CORRELATION_TIME: Final = 50


def disturbed_trajectory(truth: Trajectory, errors: PoseErrors, seed: int) -> Trajectory:
    """The poses as a localization with these errors gives them.

    Two errors add up on each axis. Noise is an Ornstein-Uhlenbeck process in the ego
    frame: of one sigma at all times, forgetting itself over `correlation_s`. Drift is a
    random walk over the distance driven, in the city frame, zero at the start; its
    knots, 10 m apart, are joined by monotone cubics, so that it has no corners that
    a registration could see.

    Args:
        truth: True poses.
        errors: Sigmas; a trajectory whose sigmas are all zero comes back as it is.
        seed: The same seed gives the same errors.

    Returns:
        Poses at the same times.
    """
    noise_sigma = np.repeat([errors.noise_m, np.radians(errors.noise_deg)], 3)
    drift_sigma = np.repeat([errors.drift_m, np.radians(errors.drift_deg)], 3)
    if not noise_sigma.any() and not drift_sigma.any():
        return truth
    noise_rng, drift_rng = np.random.default_rng([seed, 0x905E]).spawn(2)
    seconds = (truth.timestamps_ns - truth.timestamps_ns[0]) / 1e9
    steps_m = np.linalg.norm(np.diff(truth.translations[:, :2], axis=0), axis=1)
    driven_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    noise = noise_sigma * _ornstein_uhlenbeck(seconds, errors.correlation_s, noise_rng)
    drift = drift_sigma * _random_walk(driven_m, drift_rng)
    turned = Rotation.from_rotvec(noise[:, 3:] + drift[:, 3:]).as_matrix()
    moved = np.einsum("nij,nj->ni", truth.rotations, noise[:, :3]) + drift[:, :3]
    return Trajectory(truth.timestamps_ns, truth.rotations @ turned, truth.translations + moved)


def disturbed_mount(
    ego_SE3_sensor: SE3, sensor: str, sigma_m: float, sigma_deg: float, seed: int
) -> SE3:
    """A mount as a calibration with these errors gives it.

    Args:
        ego_SE3_sensor: The true mount.
        sensor: Its name: each sensor has an error of its own.
        sigma_m: One sigma of the shift along each axis of the sensor.
        sigma_deg: One sigma of the turn about each.
        seed: The same seed gives the same errors.
    """
    if sigma_m == 0 and sigma_deg == 0:
        return ego_SE3_sensor
    rng = np.random.default_rng([seed, 0xCA11, zlib.crc32(sensor.encode())])
    shift, turn = rng.normal(0.0, sigma_m, 3), rng.normal(0.0, np.radians(sigma_deg), 3)
    return ego_SE3_sensor @ SE3(Rotation.from_rotvec(turn).as_matrix(), shift)


def _ornstein_uhlenbeck(
    seconds: NDArrayFloat, correlation_s: float, rng: np.random.Generator
) -> NDArrayFloat:
    """(N, 6) of variance one at any time, correlation exp(-dt / correlation_s)."""
    step_s = correlation_s / _STEPS_PER_CORRELATION_TIME
    # A process that has forgotten itself before the next pose needs no finer steps.
    if len(seconds) > 1:
        step_s = max(step_s, float(np.median(np.diff(seconds))) / 2)
    num_steps = int(np.ceil(seconds[-1] / step_s)) + 2
    kept = np.exp(-step_s / correlation_s)
    shocks = rng.standard_normal((num_steps, 6))
    shocks[1:] *= np.sqrt(1 - kept**2)
    values = lfilter([1.0], [1.0, -kept], shocks, axis=0)
    grid = step_s * np.arange(num_steps)
    return np.column_stack([np.interp(seconds, grid, column) for column in values.T])


def _random_walk(driven_m: NDArrayFloat, rng: np.random.Generator) -> NDArrayFloat:
    """(N, 6), zero at the start, variance one after `DRIFT_REACHED_AFTER_M`, rising linearly."""
    num_knots = int(np.ceil(driven_m[-1] / _DRIFT_KNOT_M)) + 2
    increments = rng.standard_normal((num_knots - 1, 6))
    increments *= np.sqrt(_DRIFT_KNOT_M / DRIFT_REACHED_AFTER_M)
    walk = np.vstack([np.zeros(6), np.cumsum(increments, axis=0)])
    values: NDArrayFloat = PchipInterpolator(_DRIFT_KNOT_M * np.arange(num_knots), walk)(driven_m)
    return values
