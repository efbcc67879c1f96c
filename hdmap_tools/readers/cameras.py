"""Which cameras of a drive are used, and what is said about the others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from hdmap_tools.errors import CalibrationError, DriveError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.checks import MAX_MOUNT_M, numbers, shown


def mount_from_quaternion(wxyz: object, xyz_m: object, sensor: str, source: str) -> SE3:
    """``ego_SE3_sensor`` from what a table holds.

    Args:
        wxyz: Should be 4 numbers, a quaternion, scalar first.
        xyz_m: Should be 3 numbers, metres, at most `MAX_MOUNT_M`.
        sensor: Names the sensor in messages.
        source: Names the file and the row in messages.

    Raises:
        CalibrationError: If they are anything else; names the sensor and the source.
    """

    def unusable(reason: str) -> CalibrationError:
        return CalibrationError(
            f"Mount of {sensor} in {source} is unusable: {reason} Correct the calibration."
        )

    rotation, translation = numbers(wxyz, (4,)), numbers(xyz_m, (3,))
    if rotation is None:
        raise unusable(f"rotation is {shown(wxyz)}, expected 4 numbers (w, x, y, z).")
    if translation is None:
        raise unusable(f"translation is {shown(xyz_m)}, expected 3 numbers in metres.")
    if not (np.abs(translation) <= MAX_MOUNT_M).all():
        raise unusable(
            f"translation is {shown(translation.tolist())}, expected finite metres within "
            f"{MAX_MOUNT_M:g} m of the vehicle's origin."
        )
    try:
        qw, qx, qy, qz = rotation.tolist()
        return SE3.from_quaternion(qw, qx, qy, qz, translation)
    except ShapeError as error:
        raise unusable(str(error)) from error


def select_cameras(
    calibrated: Mapping[str, PinholeCamera],
    unusable: Mapping[str, DriveError],
    with_images: Collection[str],
    asked: Sequence[str],
    drive: str,
) -> tuple[dict[str, PinholeCamera], list[str]]:
    """Choose the cameras to use.

    Args:
        calibrated: Usable cameras by name.
        unusable: Why each of the others cannot be used.
        with_images: Names of all cameras that have images, usable or not.
        asked: Names asked for; empty means every usable one.
        drive: What to call the drive in messages.

    Returns:
        The cameras, and one line for each that was left out.

    Raises:
        DriveError: If a camera asked for does not exist, is unusable (then the
            error is the reason itself), or if there are images and not one of
            them belongs to a usable camera.
    """
    for name in asked:
        if name in unusable:
            raise unusable[name]
        if name not in calibrated:
            known = sorted({*calibrated, *unusable})
            raise DriveError(
                f"{drive} has no camera {name!r}; it has "
                f"{', '.join(known) if known else 'no cameras at all'}."
            )
    lost = sorted(set(with_images) & set(unusable))
    if lost and not set(with_images) & set(calibrated):
        reasons = " ".join(str(unusable[name]) for name in lost)
        raise type(unusable[lost[0]])(
            f"{drive} has images of {', '.join(lost)} and not one of them can be used: {reasons}"
        )
    chosen = {name: calibrated[name] for name in (asked or calibrated)}
    left_out = [] if asked else [f"left out {name}: {unusable[name]}" for name in sorted(unusable)]
    return chosen, left_out
