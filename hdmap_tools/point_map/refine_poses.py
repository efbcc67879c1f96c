"""Refine the poses of drives: register their sweeps to the map they make, and solve a pose graph.

Sweeps a metre or two apart (keyframes) of all drives make the map: pieces of plane
surface. Each pass cuts the map anew from the poses found so far and solves for all
keyframes at once, so that a place seen twice closes a loop and drives of one place are
aligned to one another without a step of their own. Then every sweep is registered to
the finished map. What the scene does not hold keeps the given poses.

Why all at once, and not one sweep after another: a factor between a sweep and a map made
of many others has no single pose at its other end, and a chain of such factors drifts.
Why registration of our own: small_gicp (GICP) places a sweep in a finished map as well
(0.02, 0.04 and 0.01 cm along x, y and z, ours 0.07, 0.04 and 0.02, its point-to-plane 0.12,
0.08 and 0.08; 25 simulated sweeps with 32 rings, map from true poses), but takes 29 ms
where ours takes 12, knows nothing of the tilt of its normals, which makes knowledge of
directions that hold nothing, and is an optional dependency.

Measured on simulated drives (32 rings, 2 cm, 0.05 degrees, drift of 10 cm in 100 m): 11.2 cm
become 0.3 over 300 m, 15.0 become 1.1 over 1.1 km; two drives differ by 0.3 cm. One pass
leaves 1.5 cm over 150 m, two 1.1, three 0.4, five 0.24, eight 0.19.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from hdmap_tools.errors import CRSMismatchError, PointMapError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.point_map.between_sweeps import refined_between
from hdmap_tools.point_map.pose_graph import (
    Correction,
    Prior,
    drive_prior,
    joined_priors,
    observed_scale,
    sigmas,
    solve,
)
from hdmap_tools.point_map.refine_config import RefineConfig, RefineReport
from hdmap_tools.point_map.registration import (
    DIRECTIONS,
    Hold,
    Observations,
    SurfaceMap,
    SweepPoints,
    find_surfaces,
    held_directions,
    jacobians,
    observe_known,
    thin_sweep,
    variances,
)
from hdmap_tools.readers.drive import Drive, SweepRef
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

Scale = tuple[float, float]
_log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
"""Told how many sweeps of how many are done."""

_MAX_KEYFRAMES: Final = 4000
_VISIT_M: Final = 50.0
"""Sweeps within so many metres of driving are one visit: their poses agree but for noise."""

_MIN_SURFACES: Final = 30
_MIN_SEEN: Final = 3
_MIN_SHARED: Final = 1000
_CONTRADICTION: Final = 0.08
_USUAL: Final = 0.94
"""Drives are compared on surfaces that each saw so often, if on so many; and may agree so
much less with one another than with themselves, which is usually `_USUAL`."""

_MOSTLY: Final = 0.9
_SCALES: Final = (0.05, 5.0)
"""Between these, the errors assumed of given poses are adapted to those found."""

_MAX_POSE_GAP_S: Final = 0.5


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """What refinement made of one drive's poses.

    Attributes:
        drive_id: Of the drive.
        trajectory: At the very times of the drive's own.
        is_changed: False if it is the drive's own.
        report: What was done and why.
    """

    drive_id: str
    trajectory: Trajectory
    is_changed: bool
    report: RefineReport


@dataclass(frozen=True, eq=False)
class _Place:
    """Keyframes of all drives, one drive after another.

    Attributes:
        refs: The keyframes.
        given: Their given poses, by drive.
        parts: Where each drive's keyframes lie among all.
        visits: (K,) number of the visit each belongs to.
    """

    refs: list[tuple[Drive, SweepRef]]
    given: list[Trajectory | None]
    parts: list[slice]
    visits: NDArrayInt

    @cached_property
    def rotations(self) -> NDArrayFloat:
        """(K, 3, 3) as given."""
        return np.concatenate([given.rotations for given in self.given if given])

    @cached_property
    def translations(self) -> NDArrayFloat:
        """(K, 3) as given."""
        return np.concatenate([given.translations for given in self.given if given])

    def priors(self, scales: list[Scale], config: RefineConfig) -> list[Prior]:
        """Of each drive."""
        return [
            drive_prior(given, config, is_reference=index == 0, scale=scale)
            for index, (given, scale) in enumerate(zip(self.given, scales, strict=True))
            if given
        ]


def refine_poses(
    drives: Sequence[Drive], config: RefineConfig | None = None, progress: Progress | None = None
) -> list[RefinedPoses]:
    """Refine the poses of drives of one place.

    Args:
        drives: In one city frame. The first one's place is believed; the others are
            aligned to it.
        config: Defaults if None.
        progress: Told after each sweep read.

    Returns:
        One for each drive, in order.

    Raises:
        PointMapError: If there is no drive, or two are one and the same.
        CRSMismatchError: If their city frames differ.
    """
    config = config or RefineConfig()
    start = time.perf_counter()
    _check(drives)
    used = [_sweeps_with_pose(drive) for drive in drives]
    chosen = [_keyframes(drive, refs, config) for drive, refs in zip(drives, used, strict=True)]
    total = sum(map(len, used)) + sum(map(len, chosen))
    done = 0

    def read(drive: Drive, ref: SweepRef) -> tuple[NDArrayFloat, NDArrayFloat]:
        nonlocal done
        points, weights = thin_sweep(drive.read_sweep(ref).points_ego, config)
        done += 1
        if progress is not None:
            progress(done, total)
        return points, weights

    place = _place(drives, chosen)
    if not place.refs:
        return [
            _left_alone(drive, RefineReport(num_sweeps=0, reason="no sweep has a pose"))
            for drive in drives
        ]
    thinned = [read(drive, ref) for drive, ref in place.refs]
    correction, surfaces, scales, contradicted = _refine_keyframes(
        place, SweepPoints.joined(thinned), config
    )
    del thinned
    if contradicted:
        return _each_alone(drives, config, progress, [drives[k].id for k in contradicted])
    results = []
    for index, (drive, refs, keys) in enumerate(zip(drives, used, chosen, strict=True)):
        part = place.parts[index]
        results.append(
            _refine_sweeps(
                *(drive, refs, keys),
                Correction(correction.shifts[part], correction.turns[part]),
                *(scales[index], surfaces, config),
                read=read,
                is_reference=index == 0,
            )
        )
    seconds = time.perf_counter() - start
    _log.info("Refined the poses of %d sweeps in %.1f s.", sum(map(len, used)), seconds)
    return results


def _each_alone(
    drives: Sequence[Drive], config: RefineConfig, progress: Progress | None, ids: list[str]
) -> list[RefinedPoses]:
    note = f"{', '.join(ids)} contradicts the other drives of the place: each refined alone"
    _log.warning("%s.", note)
    results = []
    for drive in drives:
        [result] = refine_poses([drive], config, progress)
        reason = f"{note}; {result.report.reason}" if result.report.reason else note
        report = result.report.model_copy(update={"reason": reason})
        results.append(replace(result, report=report))
    return results


def _left_alone(drive: Drive, report: RefineReport) -> RefinedPoses:
    return RefinedPoses(drive.id, drive.trajectory, False, report)


def _check(drives: Sequence[Drive]) -> None:
    if not drives:
        raise PointMapError("No drive to refine the poses of; expected at least one.")
    ids = [drive.id for drive in drives]
    twice = sorted({name for name in ids if ids.count(name) > 1})
    if twice:
        raise PointMapError(
            f"Drive {twice[0]} is given twice; each drive of a place may be given once."
        )
    for drive in drives[1:]:
        if drive.frame != drives[0].frame:
            raise CRSMismatchError(
                f"Drives {drives[0].id} and {drive.id} have different city frames; refine "
                "drives of one frame together, the others alone."
            )


def _sweeps_with_pose(drive: Drive) -> list[SweepRef]:
    if not drive.sweeps:
        return []
    times = np.array([ref.timestamp_ns for ref in drive.sweeps], dtype=np.int64)
    covered = drive.trajectory.covers(times, _MAX_POSE_GAP_S)
    # Two sensors may share a time, and a chain needs one node for each.
    first = np.diff(times, prepend=times[0] - 1) > 0
    return [ref for ref, usable in zip(drive.sweeps, covered & first, strict=True) if usable]


def _times(refs: Sequence[SweepRef]) -> NDArrayInt:
    return np.array([ref.timestamp_ns for ref in refs], dtype=np.int64)


def _given(drive: Drive, refs: Sequence[SweepRef]) -> Trajectory:
    times = _times(refs)
    return Trajectory(times, *drive.trajectory.interpolate_many(times))


def _keyframes(drive: Drive, refs: list[SweepRef], config: RefineConfig) -> list[SweepRef]:
    """Sweeps at least `keyframe_distance_m` apart."""
    if not refs:
        return []
    driven = _driven(_given(drive, refs))
    spacing = max(config.keyframe_distance_m, driven[-1] / _MAX_KEYFRAMES)
    steps = np.floor(driven / spacing)
    return [ref for ref, new in zip(refs, np.diff(steps, prepend=-1.0) > 0, strict=True) if new]


def _driven(trajectory: Trajectory) -> NDArrayFloat:
    """(S,) metres driven at each pose."""
    steps = np.linalg.norm(np.diff(trajectory.translations, axis=0), axis=1)
    result: NDArrayFloat = np.concatenate([[0.0], np.cumsum(steps)])
    return result


def _place(drives: Sequence[Drive], chosen: list[list[SweepRef]]) -> _Place:
    refs: list[tuple[Drive, SweepRef]] = []
    place = _Place(refs, [], [], np.zeros(0, np.int64))
    visits = [np.zeros(0, np.int64)]
    next_visit = 0
    for drive, keys in zip(drives, chosen, strict=True):
        place.parts.append(slice(len(refs), len(refs) + len(keys)))
        place.given.append(_given(drive, keys) if keys else None)
        refs += [(drive, ref) for ref in keys]
        if keys:
            visits.append(next_visit + (_driven(_given(drive, keys)) / _VISIT_M).astype(np.int64))
            next_visit = int(visits[-1][-1]) + 1
    return replace(place, visits=np.concatenate(visits))


def _refine_keyframes(
    place: _Place, points: SweepPoints, config: RefineConfig
) -> tuple[Correction, SurfaceMap, list[Scale], list[int]]:
    """Solve for all keyframes at once, as often as `passes` says.

    Returns:
        Corrections of all keyframes, the map of the poses so corrected, for each drive
        how large its errors are against what was assumed, and the drives that contradict
        the others.
    """
    correction = Correction.none(len(place.refs))
    scales: list[Scale] = [(1.0, 1.0)] * len(place.given)
    for index in range(config.passes):
        surfaces, seen, poses = _cut(place, points, correction, index, config)
        if len(surfaces) < _MIN_SURFACES:
            break
        step, hold = _joint_step(
            place, scales, correction, poses, surfaces, seen, _robust_m(index), config
        )
        correction = correction.plus(step)
        scales = _observed_scales(place, scales, correction, hold, config)
        _log.debug(
            "Pass %d: %d surfaces, %d observations, RMS step %.4f m, errors %s of those assumed.",
            index,
            len(surfaces),
            len(seen.sweep),
            float(np.sqrt((step[:, :3] ** 2).sum(axis=1).mean())),
            scales,
        )
    surfaces, seen, _ = _cut(place, points, correction, config.passes, config)
    contradicted = _contradicted(place, surfaces, seen, config)
    return correction, _without_outliers(surfaces, seen, config), scales, contradicted


def _contradicted(
    place: _Place, surfaces: SurfaceMap, seen: Observations, config: RefineConfig
) -> list[int]:
    """Drives that agree with the others much less than with themselves.

    Where the place was rebuilt, or the poses are off by more than registration finds,
    drives would bend one another. Measured: two drives of one place agree within 2 % with
    themselves and with each other; two that contradict each other, 11 to 20 % less.
    """
    _, weights, _ = _weighed(surfaces, seen, _robust_m(config.passes), config)
    information = 1 / variances(seen.counts, config)
    drive_of = np.searchsorted([part.stop for part in place.parts], seen.sweep, side="right")
    result = []
    for index in range(len(place.parts)):
        own = drive_of == index
        counts = [np.bincount(seen.surface[rows], minlength=len(surfaces)) for rows in (own, ~own)]
        is_shared = np.minimum(*counts)[seen.surface] >= _MIN_SEEN
        if (own & is_shared).sum() < _MIN_SHARED:
            continue
        agreed, itself = (
            weights[rows].sum() / information[rows].sum() if rows.sum() >= _MIN_SHARED else _USUAL
            for rows in (own & is_shared, own & ~is_shared)
        )
        if agreed < itself - _CONTRADICTION:
            result.append(index)
    return result


def _observed_scales(
    place: _Place,
    scales: list[Scale],
    correction: Correction,
    hold: Hold,
    config: RefineConfig,
) -> list[Scale]:
    is_held = np.einsum("skk->sk", hold.keep) > 0.9
    priors = iter(place.priors(scales, config))
    result = []
    for given, part, scale in zip(place.given, place.parts, scales, strict=True):
        if given is None:
            result.append(scale)
            continue
        factors = observed_scale(
            next(priors),
            Correction(correction.shifts[part], correction.turns[part]),
            is_held[part],
        )
        metres, degrees = (
            float(np.clip(old * factor, *_SCALES))
            for old, factor in zip(scale, factors, strict=True)
        )
        result.append((metres, degrees))
    return result


def _without_outliers(surfaces: SurfaceMap, seen: Observations, config: RefineConfig) -> SurfaceMap:
    """The surfaces moved along their normals to where most sweeps saw them."""
    _, _, offsets = _weighed(surfaces, seen, _robust_m(config.passes), config)
    return replace(surfaces, means=surfaces.means + surfaces.normals * offsets[:, None])


def _weighed(
    surfaces: SurfaceMap, seen: Observations, robust_m: float, config: RefineConfig
) -> tuple[NDArrayFloat, NDArrayFloat, NDArrayFloat]:
    """How far observations (O,) lie off their planes, robust weights (O,), offsets (V,)."""
    from hdmap_tools.point_map.surfel_kernels import weigh

    normals, means = surfaces.normals[seen.surface], surfaces.means[seen.surface]
    off = np.einsum("ij,ij->i", normals, seen.means - means)
    weights, offsets = weigh(seen.starts, off, 1 / variances(seen.counts, config), robust_m)
    return off, weights, offsets


def _robust_m(index: int) -> float:
    """Residual from which an observation counts less; smaller once the poses agree."""
    return max(0.3 * 0.5**index, 0.05)


def _cut(
    place: _Place, points: SweepPoints, correction: Correction, index: int, config: RefineConfig
) -> tuple[SurfaceMap, Observations, NDArrayFloat]:
    """Surfaces, what saw them, and positions (S, 3), of the corrected poses."""
    rotations, translations = correction.applied(place.rotations, place.translations)
    points_city, _ = points.in_city(rotations, translations)
    # The golden ratio's multiples never come back to the same faces.
    shift = np.array([0.618, 0.382, 0.854]) * (index + 1) % 1.0
    middle = np.round(place.translations.mean(axis=0)) if len(place.refs) else np.zeros(3)
    surfaces, seen = find_surfaces(
        points_city,
        points.weights,
        points.sweeps,
        place.visits,
        origin=middle + shift * config.surface_size_m,
        thickness_m=max(0.07 - 0.015 * index, 0.04),
        config=config,
    )
    return surfaces, seen, translations


def _joint_step(
    place: _Place,
    scales: list[Scale],
    correction: Correction,
    positions: NDArrayFloat,
    surfaces: SurfaceMap,
    seen: Observations,
    robust_m: float,
    config: RefineConfig,
) -> tuple[NDArrayFloat, Hold]:
    from hdmap_tools.point_map.surfel_kernels import assemble, informations, mark_pairs

    count = len(place.refs)
    normals = surfaces.normals[seen.surface]
    arms = seen.means - positions[seen.sweep]
    off, weights, offsets = _weighed(surfaces, seen, robust_m, config)
    information = informations(
        *(seen.starts, seen.sweep, seen.surface, arms, weights),
        *(surfaces.normals, surfaces.tilts, count, False),
    )
    given_sigmas = np.concatenate(
        [
            np.tile(sigmas(config) * np.repeat(scale, 3), (part.stop - part.start, 1))
            for scale, part in zip(scales, place.parts, strict=True)
        ]
    )
    hold = held_directions(information, given_sigmas, config.min_information)
    rows = jacobians(normals, arms)
    pairs = mark_pairs(seen.starts, seen.sweep, count)
    at_row, at_column = np.nonzero(pairs >= 0)
    numbers = pairs[at_row, at_column]
    blocks, gradient = assemble(
        *(seen.starts, seen.sweep, rows, weights, off - offsets[seen.surface]),
        *(pairs, len(numbers)),
    )
    prior = joined_priors(place.priors(scales, config))
    ties = None if hold.is_full else hold.ties
    return solve(prior, correction, at_row, at_column, blocks[numbers], gradient, ties), hold


def _refine_sweeps(
    drive: Drive,
    refs: list[SweepRef],
    keys: list[SweepRef],
    correction: Correction,
    scale: Scale,
    surfaces: SurfaceMap,
    config: RefineConfig,
    *,
    read: Callable[[Drive, SweepRef], tuple[NDArrayFloat, NDArrayFloat]],
    is_reference: bool,
) -> RefinedPoses:
    """Register every sweep of a drive to the finished map, and smooth along the drive."""
    start = time.perf_counter()
    if len(surfaces) < _MIN_SURFACES or not refs:
        reason = (
            "no sweep has a pose"
            if not refs
            else f"only {len(surfaces)} pieces of plane surface were seen by several sweeps, "
            f"expected at least {_MIN_SURFACES}"
        )
        report = RefineReport(num_sweeps=len(refs), num_keyframes=len(keys), reason=reason)
        return _left_alone(drive, report)
    given = _given(drive, refs)
    prior = drive_prior(given, config, is_reference=is_reference, scale=scale)
    given_sigmas = sigmas(config) * np.repeat(scale, 3)
    current = correction.at(_times(keys), _times(refs))
    information = np.zeros((len(refs), 6, 6))
    gradient = np.zeros((len(refs), 6))
    keep = np.zeros((len(refs), 6, 6))
    is_registered: NDArrayBool = np.zeros(len(refs), dtype=bool)
    rotations, translations = current.applied(given.rotations, given.translations)
    for index, ref in enumerate(refs):
        points, weights = read(drive, ref)
        found = _register(
            *(points, weights, rotations[index], translations[index]),
            *(surfaces, given_sigmas, config),
        )
        if found is not None:
            information[index], gradient[index], keep[index] = found
            is_registered[index] = True
    numbers = np.arange(len(refs))
    refined = current.plus(solve(prior, current, numbers, numbers, information, gradient))
    seconds = time.perf_counter() - start
    held = _held_share(keep, given.rotations)
    report = RefineReport(
        num_sweeps=len(refs),
        num_registered=int(is_registered.sum()),
        num_keyframes=len(keys),
        held=held,
        seconds=seconds,
    )
    if max(held.values()) == 0.0:
        return _left_alone(drive, report.model_copy(update={"reason": _why_nothing(scale)}))
    trajectory, bridging = refined_between(
        *(drive.trajectory, given, refined),
        may_smooth_position=all(held[name] > _MOSTLY for name in DIRECTIONS[:3]),
        may_smooth_attitude=all(held[name] > _MOSTLY for name in DIRECTIONS[3:]),
    )
    loose = [name for name in DIRECTIONS if held[name] < 1 - _MOSTLY]
    report = report.model_copy(
        update={
            "correction_m": float(np.sqrt((refined.shifts**2).sum(axis=1).mean())),
            "correction_deg": float(np.rad2deg(np.sqrt((refined.turns**2).sum(axis=1).mean()))),
            "reason": f"the scene does not hold {', '.join(loose)}: as given" if loose else None,
            "found_noise_m": config.noise_m * scale[0],
            "found_noise_deg": config.noise_deg * scale[1],
            "is_smooth_position": bridging.is_smooth_position,
            "is_smooth_attitude": bridging.is_smooth_attitude,
        }
    )
    return RefinedPoses(drive.id, trajectory, True, report)


def _why_nothing(scale: Scale) -> str:
    if scale[0] < 0.5:
        return "the given poses agree with the scene as well as registration can tell"
    return "the scene holds no direction of any sweep"


def _register(
    points: NDArrayFloat,
    weights: NDArrayFloat,
    rotation: NDArrayFloat,
    translation: NDArrayFloat,
    surfaces: SurfaceMap,
    given_sigmas: NDArrayFloat,
    config: RefineConfig,
) -> tuple[NDArrayFloat, NDArrayFloat, NDArrayFloat] | None:
    """Information (6, 6), gradient (6,) at the pose, and what is held (6, 6); None without surfaces."""
    from hdmap_tools.point_map.surfel_kernels import informations

    turned = points @ rotation.T
    step = np.zeros(6)
    for _ in range(2):
        points_city = turned + np.cross(step[3:], turned) + translation + step[:3]
        seen = observe_known(surfaces, points_city, weights, 0)
        if len(seen.surface) < _MIN_SURFACES:
            return None
        normals = surfaces.normals[seen.surface]
        arms = seen.means - translation - step[:3]
        off = np.einsum("ij,ij->i", normals, seen.means - surfaces.means[seen.surface])
        weighing = 1 / variances(seen.counts, config) / (1 + (off / _robust_m(9)) ** 2) ** 2
        known = informations(
            *(np.zeros(1, np.int64), seen.sweep, seen.surface, arms, weighing),
            *(surfaces.normals, surfaces.tilts, 1, True),
        )
        keep = held_directions(known, given_sigmas[None], config.min_information).keep[0]
        rows = jacobians(normals, arms) @ keep
        information = (rows * weighing[:, None]).T @ rows
        gradient = rows.T @ (weighing * off)
        change = -np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ gradient
        if not np.isfinite(change).all():
            return None
        step = step + change
    # As seen from the pose that the step began at.
    return information, -information @ step, keep


def _held_share(keep: NDArrayFloat, rotations: NDArrayFloat) -> dict[str, float]:
    """Share of the sweeps whose change in each of the vehicle's directions is held."""
    turn = np.zeros((len(keep), 6, 6))
    turn[:, :3, :3] = rotations
    turn[:, 3:, 3:] = rotations
    in_ego = turn.transpose(0, 2, 1) @ keep @ turn
    shares = (np.einsum("skk->sk", in_ego) > 0.5).mean(axis=0)
    return {name: float(share) for name, share in zip(DIRECTIONS, shares, strict=True)}
