"""Make a trajectory from a table of poses, and say what is wrong with the table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import PoseError, ShapeError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.readers.checks import (
    MAX_POSITION_M,
    MAX_SPAN_NS,
    MAX_SPEED_M_S,
    MAX_TIME_NS,
    shown,
)
from hdmap_tools.types import NDArrayFloat, NDArrayInt

_SAME_PLACE_M: Final = 0.001
"""Two poses at one time further apart than this contradict each other."""

_JUMP_M: Final = 1.0
"""Nearer poses are not a jump: those of two sensors may be a microsecond apart."""


def trajectory_from_table(
    timestamps_ns: NDArrayInt,
    wxyz: NDArrayFloat,
    xyz_m: NDArrayFloat,
    path: Path,
    warnings: list[str],
    row_names: Sequence[str] | None = None,
) -> Trajectory:
    """``city_SE3_ego`` from the rows of a table, in any order.

    Args:
        timestamps_ns: (N,) integer nanoseconds.
        wxyz: (N, 4) quaternions, scalar first.
        xyz_m: (N, 3) metres, city frame.
        path: The table, for messages.
        warnings: Receives a line if poses at one time contradict each other, and one
            if the vehicle would have to be faster than `MAX_SPEED_M_S`.
        row_names: (N,) what to call the rows in messages; None: by their number.

    Raises:
        PoseError: If there is no pose, or one is not finite, has no direction, or
            lies beyond `MAX_POSITION_M`, `MAX_TIME_NS` or `MAX_SPAN_NS`.
    """
    times = np.asarray(timestamps_ns, dtype=np.int64)
    if wxyz.shape != (len(times), 4) or xyz_m.shape != (len(times), 3):
        raise PoseError(
            f"Poses in {path} are unusable: expected quaternions (N, 4) and translations (N, 3) for "
            f"{len(times)} times, found {wxyz.shape} and {xyz_m.shape}."
        )
    # Before rows at one time are thinned: a broken row must not hide behind a good one.
    with np.errstate(over="ignore"):  # an overflow makes an infinite norm: no direction
        norms = np.linalg.norm(wxyz, axis=1)
    for is_bad, problem, values in (
        ((times < 0) | (times >= MAX_TIME_NS), "a time outside 1970 to 2116, ns:", times),
        (~np.isfinite(xyz_m).all(axis=1), "a NaN or infinite translation", xyz_m),
        (
            (np.abs(xyz_m) >= MAX_POSITION_M).any(axis=1),
            f"a translation of {MAX_POSITION_M:g} m or more:",
            xyz_m,
        ),
        (~(np.isfinite(norms) & (norms > 1e-9)), "no usable quaternion:", wxyz),
    ):
        if is_bad.any():
            row = int(np.flatnonzero(is_bad)[0])
            name = f"row {row}" if row_names is None else row_names[row]
            raise PoseError(
                f"Poses in {path} are unusable: {name} has {problem} {shown(values[row].tolist())}; "
                "correct or remove it."
            )
    if len(times) and (span_ns := int(times.max() - times.min())) > MAX_SPAN_NS:
        raise PoseError(
            f"Poses in {path} are unusable: they span {span_ns / 86_400e9:.0f} days (from "
            f"{times.min()} to {times.max()} ns), expected those of one drive, at most "
            f"{MAX_SPAN_NS / 86_400e9:.0f} days; correct or remove what is far off."
        )
    try:
        trajectory = Trajectory.from_quaternions(times, wxyz, xyz_m)
    except (PoseError, ShapeError) as error:
        raise PoseError(f"Poses in {path} are unusable: {error}") from error
    kept = trajectory.translations[np.searchsorted(trajectory.timestamps_ns, times)]
    apart_m = np.linalg.norm(xyz_m - kept, axis=1)
    if contradicting := int((apart_m > _SAME_PLACE_M).sum()):
        warnings.append(
            f"{contradicting} poses in {path.name} lie up to {apart_m.max():.3f} m from another one "
            "at the same time; the first of each was kept"
        )
    _warn_of_jumps(trajectory, path, warnings)
    return trajectory


def _warn_of_jumps(trajectory: Trajectory, path: Path, warnings: list[str]) -> None:
    steps_m = np.linalg.norm(np.diff(trajectory.translations, axis=0), axis=1)
    seconds = np.diff(trajectory.timestamps_ns) / 1e9
    jumps = np.flatnonzero((steps_m > MAX_SPEED_M_S * seconds) & (steps_m > _JUMP_M))
    if len(jumps):
        worst = jumps[np.argmax(steps_m[jumps])]
        warnings.append(
            f"poses in {path.name} jump {len(jumps)} times faster than {MAX_SPEED_M_S:g} m/s, the "
            f"furthest by {steps_m[worst]:.0f} m in {seconds[worst]:.3g} s at "
            f"{trajectory.timestamps_ns[worst]} ns; the map is wrong there"
        )
