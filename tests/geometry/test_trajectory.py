"""Trajectory: poses between poses, at real nanosecond times."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from hdmap_tools.errors import PoseError, ShapeError
from hdmap_tools.geometry.se3 import SE3, Trajectory

from .strategies import poses

START_NS = 1_700_000_000_123_456_789
"""A time of our days: beyond 2**53, where float64 no longer holds every nanosecond."""


def trajectory(times_ns: list[int], transforms: list[SE3]) -> Trajectory:
    return Trajectory(
        np.array(times_ns),
        np.array([t.rotation for t in transforms]),
        np.array([t.translation for t in transforms]),
    )


@pytest.fixture
def quarter_turn() -> Trajectory:
    """A left turn from east to north in 100 ms, then straight on for 1 s."""
    return trajectory(
        [START_NS, START_NS + 100_000_000, START_NS + 1_100_000_000],
        [
            SE3.from_yaw(0.0),
            SE3.from_yaw(np.pi / 2, (2.0, 4.0, 1.0)),
            SE3.from_yaw(np.pi / 2, (2.0, 14.0, 1.0)),
        ],
    )


def test_midpoint_turns_half_and_moves_half(quarter_turn: Trajectory) -> None:
    pose = quarter_turn.interpolate(START_NS + 50_000_000)
    assert pose.yaw_rad == pytest.approx(np.pi / 4, abs=1e-12)
    np.testing.assert_allclose(pose.translation, [1.0, 2.0, 0.5], atol=1e-12)


@given(st.lists(poses(), min_size=1, max_size=5), st.data())
def test_own_times_give_the_very_poses(transforms: list[SE3], data: st.DataObject) -> None:
    steps = data.draw(
        st.lists(st.integers(1, 10**12), min_size=len(transforms) - 1, max_size=len(transforms) - 1)
    )
    times = np.cumsum([START_NS, *steps])
    track = trajectory(list(times), transforms)
    for k, time_ns in enumerate(times):
        pose = track.interpolate(int(time_ns), max_gap_s=1e-9)
        assert np.array_equal(pose.rotation, transforms[k].rotation)
        assert np.array_equal(pose.translation, transforms[k].translation)


@given(poses(), poses(), st.floats(0.0, 1.0))
def test_between_two_poses_the_way_is_shared_evenly(a: SE3, b: SE3, share: float) -> None:
    between_ns = 10**9
    at_ns = round(share * between_ns)
    pose = trajectory([START_NS, START_NS + between_ns], [a, b]).interpolate(START_NS + at_ns, 2.0)
    share = at_ns / between_ns
    np.testing.assert_allclose(
        pose.translation, (1 - share) * a.translation + share * b.translation, atol=1e-9
    )
    angle = Rotation.from_matrix(a.rotation.T @ b.rotation).magnitude()
    turned = Rotation.from_matrix(a.rotation.T @ pose.rotation).magnitude()
    left = Rotation.from_matrix(pose.rotation.T @ b.rotation).magnitude()
    assert turned == pytest.approx(share * angle, abs=1e-6)
    assert left == pytest.approx((1 - share) * angle, abs=1e-6)


def test_single_nanoseconds_count() -> None:
    """One metre in one microsecond, read at 250 ns: float64 seconds since 1970 would give 0 or 1."""
    track = trajectory(
        [START_NS, START_NS + 1000], [SE3.identity(), SE3.from_yaw(0.0, (1.0, 0.0, 0.0))]
    )
    pose = track.interpolate(START_NS + 250)
    assert pose.translation[0] == pytest.approx(0.25, abs=1e-9)


def test_outside_and_in_gaps_there_is_no_pose(quarter_turn: Trajectory) -> None:
    times = START_NS + np.array([-1, 0, 1, 100_000_000, 100_000_001, 1_100_000_000, 1_100_000_001])
    assert quarter_turn.covers(times, 0.5).tolist() == [False, True, True, True, False, True, False]
    # A gap of exactly the length allowed is allowed.
    assert quarter_turn.covers(times, 1.0).tolist() == [False, True, True, True, True, True, False]
    for time_ns in (START_NS - 1, START_NS + 1_100_000_001, START_NS + 600_000_000):
        with pytest.raises(PoseError, match=rf"No ego pose at {time_ns} ns.*max_pose_gap_s"):
            quarter_turn.interpolate(time_ns, 0.5)
    assert quarter_turn.interpolate(START_NS + 600_000_000, 1.0).translation[1] == pytest.approx(
        9.0
    )


def test_one_pose_covers_its_own_time_only() -> None:
    track = trajectory([START_NS], [SE3.from_yaw(0.5, (1.0, 2.0, 3.0))])
    assert track.covers(START_NS + np.array([-1, 0, 1]), 10.0).tolist() == [False, True, False]
    assert track.interpolate(START_NS).yaw_rad == pytest.approx(0.5)
    assert track.length_m == 0.0


def test_many_at_once_equal_one_by_one(quarter_turn: Trajectory) -> None:
    times = START_NS + np.array([0, 7, 50_000_000, 100_000_000, 333_333_333, 1_100_000_000])
    rotations, translations = quarter_turn.interpolate_many(times)
    for k, time_ns in enumerate(times):
        pose = quarter_turn.interpolate(int(time_ns), 2.0)
        np.testing.assert_array_equal(rotations[k], pose.rotation)
        np.testing.assert_array_equal(translations[k], pose.translation)
    empty = quarter_turn.interpolate_many(np.array([], dtype=np.int64))
    assert empty[0].shape == (0, 3, 3)
    assert empty[1].shape == (0, 3)


@pytest.fixture(scope="module")
def long_track() -> Trajectory:
    """20,000 poses at uneven times, far from the origin."""
    rng = np.random.default_rng(5)
    times = START_NS + np.cumsum(rng.integers(1, 10_000_000, 20_000))
    return Trajectory(
        times,
        Rotation.random(len(times), random_state=5).as_matrix(),
        rng.normal(0, 5000, (len(times), 3)),
    )


def poses_by_all_knots(track: Trajectory, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What SciPy gives when handed the whole trajectory."""
    times = np.clip(times, track.timestamps_ns[0], track.timestamps_ns[-1])
    knots, query = ((t - track.timestamps_ns[0]) / 1e9 for t in (track.timestamps_ns, times))
    rotations = Slerp(knots, Rotation.from_matrix(track.rotations))(query).as_matrix()
    translations = [np.interp(query, knots, column) for column in track.translations.T]
    return rotations, np.column_stack(translations)


@given(st.data())
@settings(max_examples=40)
def test_a_stretch_is_interpolated_as_the_whole_is(
    long_track: Trajectory, data: st.DataObject
) -> None:
    start = data.draw(st.integers(-3, len(long_track) + 3))
    length = data.draw(st.sampled_from([1, 2, 5, 500, len(long_track)]))
    knots = long_track.timestamps_ns[np.clip([start, start + length], 0, len(long_track) - 1)]
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    times = rng.integers(knots[0] - 1000, knots[1] + 1000, 30)
    times = times[
        ~np.isin(np.clip(times, *long_track.timestamps_ns[[0, -1]]), long_track.timestamps_ns)
    ]
    rotations, translations = long_track.interpolate_many(times)
    by_all = poses_by_all_knots(long_track, times)
    np.testing.assert_array_equal(rotations, by_all[0])
    np.testing.assert_array_equal(translations, by_all[1])


@pytest.mark.parametrize("at", [-1, 0, 1, 9_999, 19_998, 19_999, 20_000])
def test_poses_at_and_beside_a_knot(long_track: Trajectory, at: int) -> None:
    knot = np.clip(at, 0, len(long_track) - 1)
    time_ns = long_track.timestamps_ns[knot] + (at - knot)  # a nanosecond beyond the ends
    rotations, translations = long_track.interpolate_many(np.array([time_ns]))
    np.testing.assert_array_equal(rotations[0], long_track.rotations[knot])
    np.testing.assert_array_equal(translations[0], long_track.translations[knot])


def test_the_rotations_are_prepared_once(
    long_track: Trajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    knots_given: list[int] = []

    def counted(knots: np.ndarray, rotations: Rotation) -> Slerp:
        knots_given.append(len(knots))
        return Slerp(knots, rotations)

    monkeypatch.setattr("hdmap_tools.geometry.se3.Slerp", counted)
    track = replace(long_track)  # without what other tests had prepared
    times = track.timestamps_ns
    for wanted in ([times[7000] + 1], times[7000:7003] + 1, [times[-1]], [times[0]], []):
        track.interpolate_many(np.array(wanted, dtype=np.int64))
    assert knots_given == [len(track)]


def test_length_is_that_of_the_path_in_the_plane(quarter_turn: Trajectory) -> None:
    assert quarter_turn.length_m == pytest.approx(np.hypot(2.0, 4.0) + 10.0)
    assert len(quarter_turn) == 3


def test_rows_are_sorted_and_the_first_of_equal_times_kept() -> None:
    track = Trajectory.from_quaternions(
        np.array([30, 10, 20, 10]),
        np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)),
        np.array([[3.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [99.0, 0, 0]]),
    )
    assert track.timestamps_ns.tolist() == [10, 20, 30]
    assert track.translations[:, 0].tolist() == [1.0, 2.0, 3.0]


EYES = np.tile(np.eye(3), (2, 1, 1))


@pytest.mark.parametrize(
    ("times", "rotations", "translations", "error", "message"),
    [
        ([], np.zeros((0, 3, 3)), np.zeros((0, 3)), PoseError, "at least one pose"),
        ([2, 1], EYES, np.zeros((2, 3)), PoseError, "strictly increase"),
        ([1, 1], EYES, np.zeros((2, 3)), PoseError, "strictly increase"),
        ([1, 2], EYES, np.zeros((3, 3)), ShapeError, r"translations \(3, 3\)"),
        ([1, 2], EYES, [[0, 0, 0], [0, np.nan, 0]], PoseError, "NaN or infinite"),
        ([1, 2], np.stack([np.eye(3), 0 * np.eye(3)]), np.zeros((2, 3)), PoseError, "of pose 1"),
        ([1, 2], -EYES, np.zeros((2, 3)), PoseError, "of pose 0"),
    ],
)
def test_unusable_poses_are_refused(times, rotations, translations, error, message: str) -> None:
    with pytest.raises(error, match=message):
        Trajectory(np.array(times, dtype=np.int64), rotations, translations)


def test_a_time_span_beyond_int64_is_still_ordered() -> None:
    limits = np.iinfo(np.int64)
    track = Trajectory(np.array([limits.min, limits.max]), EYES, np.zeros((2, 3)))
    assert len(track) == 2


@pytest.mark.parametrize(
    ("wxyz", "xyz", "error", "message"),
    [
        ([[0.0] * 4, [1, 0, 0, 0]], np.zeros((2, 3)), PoseError, "Pose 0 has no usable quaternion"),
        ([[1, 0, 0, 0], [np.nan] * 4], np.zeros((2, 3)), PoseError, "Pose 1 has no usable"),
        ([[1, 0, 0, 0], [1e300] * 4], np.zeros((2, 3)), PoseError, "Pose 1 has no usable"),
        ([[1, 0, 0, 0]], np.zeros((2, 3)), ShapeError, r"found \(1, 4\) and \(2, 3\)"),
        ([[1, 0, 0], [1, 0, 0]], np.zeros((2, 3)), ShapeError, r"found \(2, 3\)"),
        ([[1, 0, 0, 0]] * 2, np.zeros((1, 3)), ShapeError, r"and \(1, 3\)"),
    ],
)
def test_unusable_rows_are_refused(wxyz, xyz, error, message: str) -> None:
    with pytest.raises(error, match=message):
        Trajectory.from_quaternions(np.array([1, 2]), np.array(wxyz), xyz)
    with pytest.raises(PoseError, match="at least one pose"):
        Trajectory.from_quaternions(np.array([]), np.zeros((0, 4)), np.zeros((0, 3)))
