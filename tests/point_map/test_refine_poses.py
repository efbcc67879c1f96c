"""Refined poses against the truth of streets driven through."""

import dataclasses

import numpy as np
import pytest

from hdmap_tools.errors import CRSMismatchError, PointMapError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.point_map.refine_poses import refine_poses

from .street_drive import (
    Errors,
    Street,
    aligned_errors,
    drive_through,
    mutual_error_m,
    true_path,
    with_errors,
)


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(40)


def test_a_short_drive_has_less_than_a_quarter_of_its_error_left(street: Street) -> None:
    truth = true_path(40)
    given = with_errors(truth, Errors(), seed=1)
    told = []
    [refined] = refine_poses(
        [drive_through(street, truth, given)],
        progress=lambda done, total: told.append((done, total)),
    )
    before_m, before_deg = aligned_errors(given, truth)
    after_m, after_deg = aligned_errors(refined.trajectory, truth)
    assert after_m < before_m / 4
    assert after_deg < before_deg / 4
    assert refined.is_changed
    assert np.array_equal(refined.trajectory.timestamps_ns, given.timestamps_ns)
    assert min(refined.report.held.values()) > 0.9
    # Registration saw how large the errors are, whatever was assumed.
    assert refined.report.found_noise_m == pytest.approx(0.02, rel=0.4)
    assert [done for done, _ in told] == list(range(1, told[-1][1] + 1))


def test_two_drives_of_a_street_are_aligned_to_each_other(street: Street) -> None:
    first, second = true_path(40), true_path(40, is_back=True, t0_s=1000)
    given = with_errors(first, Errors(), seed=1), with_errors(second, Errors(), seed=2)
    off = np.array([0.25, -0.2, 0.1])
    moved = Trajectory(given[1].timestamps_ns, given[1].rotations, given[1].translations + off)
    refined = refine_poses(
        [
            drive_through(street, first, given[0], name="there"),
            drive_through(street, second, moved, name="back", seed=5),
        ]
    )
    assert mutual_error_m(given[0], moved, first, second) > 0.2
    assert mutual_error_m(refined[0].trajectory, refined[1].trajectory, first, second) < 0.015
    # The first one's place is believed.
    assert refined[1].report.correction_m > 2 * refined[0].report.correction_m


def test_drives_that_saw_another_place_do_not_bend_each_other(street: Street) -> None:
    first, second = true_path(40), true_path(40, t0_s=1000)
    given = with_errors(first, Errors(), seed=1), with_errors(second, Errors(), seed=2)
    refined = refine_poses(
        [
            drive_through(street, first, given[0], name="before"),
            drive_through(Street(40, seed=8, wave_m=0.6), second, given[1], name="rebuilt", seed=5),
        ]
    )
    for poses, before, truth in zip(refined, given, (first, second), strict=True):
        assert aligned_errors(poses.trajectory, truth)[0] < aligned_errors(before, truth)[0] / 2
        assert poses.report.reason is not None
        assert "contradicts the other drives" in poses.report.reason


def test_a_straight_road_between_lawns_is_known_to_hold_nothing_along_it() -> None:
    truth = true_path(40)
    given = with_errors(truth, Errors(), seed=1)
    [refined] = refine_poses([drive_through(Street(40, is_bare=True), truth, given)])
    held = refined.report.held
    assert held["along"] == held["across"] == held["yaw"] == 0.0
    assert min(held["up"], held["roll"], held["pitch"]) > 0.8
    change = refined.trajectory.translations - given.translations
    assert np.abs(change[:, 0]).max() < 0.001
    # The crown of the road ties a part of the roll to the position across.
    assert np.sqrt((change[:, 1] ** 2).mean()) < 0.01
    before_m, before_deg = aligned_errors(given, truth)
    after_m, after_deg = aligned_errors(refined.trajectory, truth)
    assert after_m <= before_m
    assert after_deg <= before_deg
    assert refined.report.reason == "the scene does not hold along, across, yaw: as given"


@pytest.mark.parametrize("is_bare", [False, True])
def test_perfect_poses_are_not_made_worse(is_bare: bool) -> None:
    truth = true_path(40)
    [refined] = refine_poses([drive_through(Street(40, is_bare=is_bare), truth, truth)])
    after_m, after_deg = aligned_errors(refined.trajectory, truth)
    assert after_m < 0.001
    assert after_deg < 0.005


def test_drives_without_sweeps_or_surfaces_are_left_alone(street: Street) -> None:
    truth = true_path(40)
    whole = drive_through(street, truth, truth)
    [none] = refine_poses([dataclasses.replace(whole, sweeps=())])
    [one] = refine_poses([dataclasses.replace(whole, sweeps=whole.sweeps[:1])])
    assert not none.is_changed
    assert none.report.reason == "no sweep has a pose"
    assert not one.is_changed
    assert one.trajectory is truth
    assert one.report.reason is not None
    assert "pieces of plane surface" in one.report.reason


def test_a_drive_without_sweeps_does_not_keep_another_from_being_refined(street: Street) -> None:
    truth = true_path(40)
    given = with_errors(truth, Errors(), seed=1)
    whole = drive_through(street, truth, given)
    empty = dataclasses.replace(drive_through(street, truth, given, name="empty"), sweeps=())
    first, second = refine_poses([empty, whole])
    assert not first.is_changed
    assert second.is_changed
    assert aligned_errors(second.trajectory, truth)[0] < aligned_errors(given, truth)[0] / 4


def test_drives_that_cannot_be_refined_together_are_named(street: Street) -> None:
    truth = true_path(40)
    drive = drive_through(street, truth, truth)
    with pytest.raises(PointMapError, match="No drive"):
        refine_poses([])
    with pytest.raises(PointMapError, match="toy:street is given twice"):
        refine_poses([drive, drive])
    elsewhere = dataclasses.replace(drive, name="b", frame=MapFrame.from_origin(49.0, 8.0))
    with pytest.raises(CRSMismatchError, match="toy:street and toy:b"):
        refine_poses([drive, elsewhere])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_figures_that_refinement_must_reach(seed: int) -> None:
    street = Street(150, seed=seed)
    first = true_path(150)
    second = true_path(150, is_back=seed % 2 == 0, y_m=-1.2, t0_s=1000)
    sensor = {"rings": 32, "azimuths": 600}
    given = with_errors(first, Errors(), 10 * seed), with_errors(second, Errors(), 10 * seed + 1)
    refined = refine_poses(
        [
            drive_through(street, first, given[0], name="first", seed=1, **sensor),
            drive_through(street, second, given[1], name="second", seed=2, **sensor),
        ]
    )
    for poses, before, truth in zip(refined, given, (first, second), strict=True):
        before_m, before_deg = aligned_errors(before, truth)
        after_m, after_deg = aligned_errors(poses.trajectory, truth)
        assert after_m < before_m / 4
        assert after_deg < before_deg / 4
    assert mutual_error_m(refined[0].trajectory, refined[1].trajectory, first, second) < 0.015
