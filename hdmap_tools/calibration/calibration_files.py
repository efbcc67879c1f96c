"""Calibration in the layout of a drive: the two tables of an Argoverse 2 log.

``calibration/intrinsics.feather`` and ``calibration/egovehicle_SE3_sensor.feather`` can be
put into a log as they are. Two things the layout has no place for are columns more, which
the data set's own package leaves alone: ``p1`` and ``p2``, and ``is_rectified``. Recorded
logs of that data set hold undistorted pictures beside the distortion that they were
undistorted with; 0 in ``is_rectified`` says that here the pictures are as the lens made them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import CalibrationError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.av2 import read_intrinsics, read_mounts
from hdmap_tools.readers.checks import name_problem, shown
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.types import NDArrayAny

INTRINSICS_FILE: Final = "intrinsics.feather"
MOUNTS_FILE: Final = "egovehicle_SE3_sensor.feather"
FOLDER: Final = "calibration"
_MAX_SIZE_PX: Final = 65_535
"""The layout stores sizes in 16 bits."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is known of a vehicle's sensors.

    Attributes:
        cameras: By name; the mount of one that is not in `mounts` is the identity.
        mounts: ``ego_SE3_sensor`` by name, of cameras and others.
    """

    cameras: Mapping[str, PinholeCamera]
    mounts: Mapping[str, SE3] = field(default_factory=dict)

    def camera(self, name: str | None, source: Path) -> PinholeCamera:
        """One camera; without a name the only one.

        Raises:
            CalibrationError: If there is none of that name, or several and no name.
        """
        known = ", ".join(sorted(self.cameras)) or "none"
        if name is None and len(self.cameras) != 1:
            raise CalibrationError(
                f"{source} has {len(self.cameras)} cameras; name one with --name: {known}."
            )
        chosen = next(iter(self.cameras)) if name is None else name
        if chosen not in self.cameras:
            raise CalibrationError(f"{source} has no camera {shown(chosen)}; it has: {known}.")
        return self.cameras[chosen]

    def with_camera(self, camera: PinholeCamera, *, is_mounted: bool) -> Calibration:
        """The same with one camera put in, in place of one of its name."""
        mounts = dict(self.mounts)
        if is_mounted:
            mounts[camera.name] = camera.ego_SE3_cam
        return Calibration({**self.cameras, camera.name: camera}, mounts)


def read_calibration(path: Path, scene: str | None = None) -> Calibration:
    """What a result of `hdmap calibrate`, a ``calibration`` folder, or a drive says of its sensors.

    Args:
        path: Folder.
        scene: Which drive of a data root.

    Raises:
        CalibrationError: If the tables are unusable.
        DriveError: If the path holds neither tables nor a drive.
    """
    for folder in (path / FOLDER, path):
        if (folder / INTRINSICS_FILE).is_file():
            return _read_tables(folder)
    if path.is_file() and path.name == INTRINSICS_FILE:
        return _read_tables(path.parent)
    drive = open_drive(path, scene=scene)
    return Calibration(drive.cameras, {n: c.ego_SE3_cam for n, c in drive.cameras.items()})


def _read_tables(folder: Path) -> Calibration:
    cameras = read_intrinsics(folder / INTRINSICS_FILE)
    mounts_path = folder / MOUNTS_FILE
    mounts = read_mounts(mounts_path) if mounts_path.is_file() else {}
    mounted = {
        name: replace(camera, ego_SE3_cam=mounts.get(name, camera.ego_SE3_cam))
        for name, camera in cameras.items()
    }
    return Calibration(mounted, mounts)


def write_calibration(folder: Path, calibration: Calibration) -> None:
    """Write both tables into ``calibration/`` of a folder; that of mounts only if any is known.

    Raises:
        CalibrationError: If a name or an image size has no place in the tables.
    """
    for name in sorted({*calibration.cameras, *calibration.mounts}):
        if expected := name_problem(name):
            raise CalibrationError(f"Sensor name {shown(name)}: expected {expected}.")
    cameras = [calibration.cameras[name] for name in sorted(calibration.cameras)]
    for camera in cameras:
        if max(camera.width_px, camera.height_px) > _MAX_SIZE_PX:
            raise CalibrationError(
                f"Camera {camera.name} has {camera.width_px}x{camera.height_px} px; the table holds "
                f"at most {_MAX_SIZE_PX}."
            )
    target = folder / FOLDER
    target.mkdir(parents=True, exist_ok=True)
    _write_feather(target / INTRINSICS_FILE, _intrinsics_columns(cameras))
    if calibration.mounts:
        _write_feather(target / MOUNTS_FILE, _mount_columns(calibration.mounts))


def _intrinsics_columns(cameras: list[PinholeCamera]) -> dict[str, NDArrayAny]:
    lens = np.array([camera.distortion for camera in cameras]).reshape(-1, 5)
    return {
        "sensor_name": np.array([camera.name for camera in cameras], dtype=object),
        "fx_px": np.array([camera.fx for camera in cameras]),
        "fy_px": np.array([camera.fy for camera in cameras]),
        "cx_px": np.array([camera.cx for camera in cameras]),
        "cy_px": np.array([camera.cy for camera in cameras]),
        "k1": lens[:, 0],
        "k2": lens[:, 1],
        "k3": lens[:, 4],
        "height_px": np.array([camera.height_px for camera in cameras], dtype=np.uint16),
        "width_px": np.array([camera.width_px for camera in cameras], dtype=np.uint16),
        "p1": lens[:, 2],
        "p2": lens[:, 3],
        "is_rectified": np.array([not camera.is_distorted for camera in cameras], dtype=np.uint8),
    }


def _mount_columns(mounts: Mapping[str, SE3]) -> dict[str, NDArrayAny]:
    names = sorted(mounts)
    poses = np.array([[*mounts[name].quaternion_wxyz, *mounts[name].translation] for name in names])
    columns = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return {
        "sensor_name": np.array(names, dtype=object),
        **dict(zip(columns, poses.T, strict=True)),
    }


def _write_feather(path: Path, columns: Mapping[str, NDArrayAny]) -> None:
    import pyarrow as pa
    import pyarrow.feather

    pyarrow.feather.write_feather(
        pa.table({name: pa.array(values) for name, values in columns.items()}), path
    )
