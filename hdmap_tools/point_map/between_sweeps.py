"""Poses at times between the sweeps that were refined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.point_map.pose_graph import Correction
from hdmap_tools.types import NDArrayFloat, NDArrayInt

_MIN_SWEEPS: Final = 20
_MAX_GAP_S: Final = 0.25
"""Longer gaps between sweeps are not bridged by a smooth motion."""


@dataclass(frozen=True)
class Bridging:
    """Which of the two ways serves better; decided apart for positions and attitudes.

    Attributes:
        is_smooth_position, is_smooth_attitude: A smooth motion through the refined poses
            beats the given poses with their correction interpolated.
    """

    is_smooth_position: bool
    is_smooth_attitude: bool


def refined_between(
    given: Trajectory,
    sweeps: Trajectory,
    correction: Correction,
    *,
    may_smooth_position: bool = True,
    may_smooth_attitude: bool = True,
) -> tuple[Trajectory, Bridging]:
    """The refined trajectory at all times of the given one.

    Between two sweeps the given poses may be better than any smooth motion (an inertial
    unit feels each bump), or worse (noise that changes within a tenth of a second). Which,
    the sweeps tell: every second one is predicted from the others in both ways.

    Args:
        given: All given poses.
        sweeps: Given poses at the sweeps' times.
        correction: Of those.
        may_smooth_position: False where not all directions were refined: the given
            poses are to stay as they are in the others.
        may_smooth_attitude: Likewise.
    """
    times = given.timestamps_ns
    everywhere = correction.at(sweeps.timestamps_ns, times)
    rotations, translations = everywhere.applied(given.rotations, given.translations)
    refined = Trajectory(
        sweeps.timestamps_ns, *correction.applied(sweeps.rotations, sweeps.translations)
    )
    better = _better_way(sweeps, refined, correction)
    bridging = Bridging(
        better.is_smooth_position and may_smooth_position,
        better.is_smooth_attitude and may_smooth_attitude,
    )
    after = np.searchsorted(refined.timestamps_ns, times)
    inside = (after > 0) & (after < len(refined))
    after = np.clip(after, 1, max(len(refined) - 1, 1))
    if len(refined) > 1:
        gaps_s = (refined.timestamps_ns[after] - refined.timestamps_ns[after - 1]) / 1e9
        inside &= gaps_s <= _MAX_GAP_S
    if bridging.is_smooth_position:
        translations[inside] = _smooth_positions(refined, times[inside])
    if bridging.is_smooth_attitude:
        rotations[inside] = _smooth_attitudes(refined, times[inside])
    return Trajectory(times, rotations, translations), bridging


def _better_way(sweeps: Trajectory, refined: Trajectory, correction: Correction) -> Bridging:
    if len(sweeps) < _MIN_SWEEPS:
        return Bridging(False, False)
    known, asked = slice(0, None, 2), slice(1, len(sweeps) - 1, 2)
    times = sweeps.timestamps_ns
    part = Correction(correction.shifts[known], correction.turns[known])
    by_given = part.at(times[known], times[asked]).applied(
        sweeps.rotations[asked], sweeps.translations[asked]
    )
    base = Trajectory(times[known], refined.rotations[known], refined.translations[known])
    smooth = _smooth_attitudes(base, times[asked]), _smooth_positions(base, times[asked])
    truth = refined.rotations[asked], refined.translations[asked]
    near = np.diff(times[known])[: len(truth[1])] <= 2 * _MAX_GAP_S * 1e9
    if not near.any():
        return Bridging(False, False)

    def errors(poses: tuple[NDArrayFloat, NDArrayFloat]) -> tuple[float, float]:
        off = np.linalg.norm(poses[1] - truth[1], axis=1)[near]
        turned = Rotation.from_matrix(poses[0].transpose(0, 2, 1) @ truth[0]).magnitude()[near]
        return float((off**2).mean()), float((turned**2).mean())

    position, attitude = errors(smooth)
    given_position, given_attitude = errors(by_given)
    return Bridging(position < given_position, attitude < given_attitude)


def _seconds(trajectory: Trajectory, times_ns: NDArrayInt) -> tuple[NDArrayFloat, NDArrayFloat]:
    origin = trajectory.timestamps_ns[0]
    return (trajectory.timestamps_ns - origin) / 1e9, (times_ns - origin) / 1e9


def _smooth_positions(trajectory: Trajectory, times_ns: NDArrayInt) -> NDArrayFloat:
    from scipy.interpolate import CubicSpline

    knots, query = _seconds(trajectory, times_ns)
    result: NDArrayFloat = CubicSpline(knots, trajectory.translations)(query)
    return result


def _smooth_attitudes(trajectory: Trajectory, times_ns: NDArrayInt) -> NDArrayFloat:
    from scipy.spatial.transform import RotationSpline

    knots, query = _seconds(trajectory, times_ns)
    result: NDArrayFloat = RotationSpline(knots, Rotation.from_matrix(trajectory.rotations))(
        query
    ).as_matrix()
    return result
