"""The prior of given poses against dense algebra, and the solution against closed forms."""

import numpy as np
import pytest

from hdmap_tools.point_map.pose_graph import (
    Correction,
    Prior,
    drive_prior,
    joined_priors,
    observed_scale,
    sigmas,
    solve,
)
from hdmap_tools.point_map.refine_config import RefineConfig

from .street_drive import Errors, true_path, with_errors

CONFIG = RefineConfig()
NO_BLOCKS = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 6, 6))


def dense(prior: Prior) -> np.ndarray:
    """Precision (6 S, 6 S) with the offsets integrated out, column by column."""
    count = len(prior.own)
    unit = np.eye(6 * count).reshape(-1, count, 6)
    return np.stack([prior.pull(column).ravel() for column in unit], axis=1)


@pytest.fixture
def prior() -> Prior:
    return drive_prior(true_path(20), CONFIG, is_reference=True)


def test_the_prior_of_a_drive_is_a_stationary_process(prior: Prior) -> None:
    covariance = np.linalg.inv(dense(prior))
    spread = covariance.diagonal().reshape(-1, 6)
    expected = sigmas(CONFIG) ** 2 + np.repeat([0.1, np.deg2rad(0.02)], 3) ** 2
    assert np.allclose(spread, expected, rtol=1e-6)
    # Neighbours differ by the noise forgotten in a tenth of a second, and a little drift.
    neighbour = covariance[np.arange(6), np.arange(6) + 6]
    metres = np.linalg.norm(np.diff(true_path(20).translations[:2], axis=0))
    drift = np.repeat([0.1, np.deg2rad(0.02)], 3) ** 2 * metres / 100
    change = 2 * sigmas(CONFIG) ** 2 * (1 - np.exp(-0.1 / 0.5)) + drift
    assert np.allclose(2 * (spread[0] - neighbour), change, rtol=1e-6)


def test_another_drive_may_be_off_as_a_whole_but_not_bent(prior: Prior) -> None:
    other = drive_prior(true_path(20), CONFIG, is_reference=False)
    difference = np.linalg.inv(dense(other)) - np.linalg.inv(dense(prior))
    shared = difference.reshape(len(prior.own), 6, len(prior.own), 6)
    expected = np.repeat([CONFIG.between_drives_m, np.deg2rad(CONFIG.between_drives_deg)], 3) ** 2
    for axis in range(6):
        assert np.allclose(shared[:, axis, :, axis], expected[axis], rtol=1e-5)


def test_without_registration_nothing_is_changed_and_any_correction_is_taken_back(
    prior: Prior,
) -> None:
    other = drive_prior(true_path(20), CONFIG, is_reference=False)
    both = joined_priors([prior, other])
    count = len(both.own)
    gradient = np.zeros((count, 6))
    assert np.all(solve(both, Correction.none(count), *NO_BLOCKS, gradient) == 0)
    start = np.random.default_rng(0).normal(0, 0.01, (count, 6))
    step = solve(both, Correction(start[:, :3], start[:, 3:]), *NO_BLOCKS, gradient)
    assert np.allclose(step, -start, atol=1e-9)


def test_a_measured_pose_moves_to_where_both_agree_and_a_free_direction_does_not(
    prior: Prior,
) -> None:
    count, measured = len(prior.own), 7
    blocks, gradient = np.zeros((1, 6, 6)), np.zeros((count, 6))
    blocks[0] = np.diag(1 / sigmas(CONFIG) ** 2)
    wanted = np.array([0.05, -0.02, 0.01, 0.001, 0.0, -0.002])
    gradient[measured] = -blocks[0] @ wanted
    at = np.array([measured])
    step = solve(prior, Correction.none(count), at, at, blocks, gradient)
    spread = sigmas(CONFIG) ** 2 + np.repeat([0.1, np.deg2rad(0.02)], 3) ** 2
    assert np.allclose(step[measured], wanted * spread / (spread + sigmas(CONFIG) ** 2), rtol=1e-6)

    held = np.array([1, 0, 1, 1, 1, 0])
    ties = np.diag(np.where(held, 1e7, 1e-9) / sigmas(CONFIG) ** 2)
    free = solve(
        *(prior, Correction.none(count), at, at, blocks, gradient),
        np.tile(ties, (count, 1, 1)),
    )
    assert np.allclose(free[:, held == 1], step[:, held == 1], rtol=1e-4, atol=1e-9)
    assert np.abs(free[:, held == 0]).max() < 1e-8


@pytest.mark.parametrize("factor", [0.25, 1.0, 3.0])
def test_the_size_of_the_errors_is_found_from_the_corrections(factor: float) -> None:
    truth = true_path(400)
    errors = Errors(0.02 * factor, 0.05 * factor, 0.1 * factor)
    given = with_errors(truth, errors, seed=3)
    correction = Correction(truth.translations - given.translations, np.zeros((len(truth), 3)))
    prior = drive_prior(truth, CONFIG, is_reference=True)
    is_held = np.ones((len(truth), 6), dtype=bool)
    is_held[:, 3:] = False
    metres, degrees = observed_scale(prior, correction, is_held)
    assert metres == pytest.approx(factor, rel=0.15)
    assert degrees == 1.0  # nothing held, nothing said


def test_a_correction_is_interpolated_in_time_and_kept_beyond_its_ends() -> None:
    times = np.array([0, 10, 20]) + 10**18
    correction = Correction(np.arange(9.0).reshape(3, 3), np.zeros((3, 3)))
    found = correction.at(times, np.array([-5, 0, 5, 20, 99]) + 10**18)
    assert np.allclose(found.shifts[:, 0], [0, 0, 1.5, 6, 6])
