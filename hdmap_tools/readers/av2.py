"""Drives in the Argoverse 2 sensor-log layout.

**Sweeps are published ego-motion compensated to the time in their file name**, so
they are not compensated again. The data set's documentation says so (docstring of
`av2.structures.sweep.Sweep`), and measurement on the two recorded sweeps of log
7fab2350 (ego turning 3.5 deg/s, 0.7 m/s) agrees. A laser of a spinning lidar draws
a cone at constant elevation around *its* lidar at the speed of the turn:

    points taken as            spread of elevation within a laser    rate of turn
    seen at offset_ns (raw)    0.042 to 0.056 deg                    3579 to 3608 deg/s
    compensated (undone first) 0.003 to 0.005 deg                    3599 to 3607 deg/s

(lasers 0..31 in up_lidar, 32..63 in down_lidar; medians over lasers, both sweeps.)
Static vertical planes of the two sweeps lie 7.8 mm apart (median, 28,771 points) as
stored, 9.1 mm (21,273) when compensated once more, 8.7 mm (15,928) when undone.
`is_compensated=False` is for logs written raw by others.

**Images are published undistorted** although intrinsics.feather has k1, k2, k3:
these describe the lens before undistortion. The data set's maintainers say so
(argoverse/av2-api issues 219 and 226) and its own camera model projects with the
matrix alone. `is_rectified=False` is for logs with raw images; where the table has a
column ``is_rectified``, as `hdmap calibrate` writes it, 0 says the same of one camera.

Source:
    https://argoverse.github.io/user-guide/datasets/sensor.html; `av2` package.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.errors import (
    CalibrationError,
    DriveError,
    HDMapError,
    PoseError,
    SweepError,
)
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.cameras import mount_from_quaternion, select_cameras
from hdmap_tools.readers.checks import MAX_TIME_NS, name_problem, shown
from hdmap_tools.readers.drive import Drive, ImageRef, Sweep, SweepRef, is_usable, to_bytes
from hdmap_tools.readers.feather import read_columns
from hdmap_tools.readers.folders import os_errors_are_drive_errors
from hdmap_tools.readers.motion import compensate_ego_motion
from hdmap_tools.readers.poses import trajectory_from_table
from hdmap_tools.types import NDArrayAny, NDArrayBool

logger = logging.getLogger(__name__)

LAYOUT: Final = "av2"
POSES_FILE: Final = "city_SE3_egovehicle.feather"
LIDAR: Final = "lidar"
MAP_FRAME_FILE: Final = "map_frame.json"
"""Not part of the layout: where a simulated log's city frame lies on earth."""
TRUE_MAP_FILE: Final = "truth/vector_map.gpkg"
"""Not part of the layout: the vector map that a simulated log drives through."""
TRUE_CELLS_FOLDER: Final = "truth/raster"
"""Not part of the layout: what each cell of the ground is."""

CITY_UTM_ZONE_LAT_LON: Final[Mapping[str, tuple[int, float, float]]] = {
    "ATX": (14, 30.27464237939507, -97.7404457407424),
    "DTW": (17, 42.29993066912924, -83.17555750783717),
    "MIA": (17, 25.77452579915163, -80.19656914449405),
    "PAO": (10, 37.416065, -122.13571963362166),
    "PIT": (17, 40.44177902989321, -80.01294377242584),
    "WDC": (18, 38.889377, -77.0355047439081),
}
"""UTM zone (north) and latitude, longitude of each city frame's origin, degrees
(`av2.geometry.utm`); the axes are those of the zone's grid."""

_QUATERNION: Final = ("qw", "qx", "qy", "qz")
_TRANSLATION: Final = ("tx_m", "ty_m", "tz_m")
_INTRINSICS: Final = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
_LENS: Final = ("k1", "k2", "k3")
_TANGENTIAL: Final = ("p1", "p2")
"""Not part of the layout: what `hdmap calibrate` finds of the lens besides."""
_IS_RECTIFIED: Final = "is_rectified"
"""Not part of the layout: 0 for a camera whose images are as the lens made them."""
_CITY_IN_MAP_NAME: Final = re.compile(r"____([A-Z]+)_city_")
_MAX_OFFSET_NS: Final = 1e10
_IMAGE_SUFFIXES: Final = frozenset({".jpg", ".jpeg", ".png"})


@os_errors_are_drive_errors()
def read_av2(
    log_dir: Path,
    cameras: Sequence[str] = (),
    *,
    is_compensated: bool = True,
    is_rectified: bool = True,
) -> Drive:
    """List one log; images and sweeps are read later. Only the poses must exist.

    Args:
        log_dir: Folder of the log, with ``city_SE3_egovehicle.feather``.
        cameras: Camera names; empty means all that can be used.
        is_compensated: Whether the sweeps already refer to the time in their name;
            if False, each is compensated by its offset_ns.
        is_rectified: Whether the images are undistorted; if False, k1, k2 and k3 of
            the intrinsics are applied.

    Returns:
        The drive, in the city frame of the log's map file.

    Raises:
        DriveError: If the log or a table of it is missing or broken.
        CalibrationError: If no camera with images can be used, or one asked for cannot.
        PoseError: If the poses are unusable.
    """
    log_dir = Path(log_dir)
    if not log_dir.is_dir():
        raise DriveError(f"{log_dir} is not a folder; expected that of an Argoverse 2 sensor log.")
    warnings: list[str] = []
    trajectory = _read_trajectory(log_dir / POSES_FILE, warnings)
    image_files = _list_images(log_dir / "sensors" / "cameras", warnings)
    calibrated, unusable = _read_cameras(log_dir / "calibration", is_rectified)
    intrinsics_path = log_dir / "calibration" / "intrinsics.feather"
    lack = "has no row for it" if intrinsics_path.exists() else "is missing"
    for name in sorted(set(image_files) - set(calibrated) - set(unusable)):
        unusable[name] = CalibrationError(
            f"camera {name} has {len(image_files[name])} images but no calibration: "
            f"{intrinsics_path} {lack}; add it or remove the images."
        )
    chosen, left_out = select_cameras(
        calibrated, unusable, image_files, cameras, f"Log {log_dir.name}"
    )
    warnings += left_out
    sweeps = [
        SweepRef(time_ns, path, LIDAR)
        for time_ns, path in _timed_files(
            log_dir / "sensors" / LIDAR, frozenset({".feather"}), warnings
        )
    ]
    maps = tuple(sorted((log_dir / "map").glob("log_map_archive_*.json")))
    frame = _map_frame(log_dir, maps, warnings)
    true_maps = tuple(
        p for p in (log_dir / n for n in (TRUE_MAP_FILE, TRUE_CELLS_FOLDER)) if p.exists()
    )
    for warning in warnings:
        logger.warning("%s: %s", log_dir.name, warning)
    return Drive(
        name=log_dir.resolve().name,
        layout=LAYOUT,
        root=log_dir,
        frame=frame,
        trajectory=trajectory,
        cameras=chosen,
        images=tuple(
            ImageRef(name, time_ns, path)
            for name in chosen
            for time_ns, path in image_files.get(name, [])
        ),
        sweeps=tuple(sweeps),
        # partial, not a closure: a drive can then be sent to another process.
        read_sweep=partial(read_av2_sweep, trajectory=None if is_compensated else trajectory),
        reference_maps=(*maps, *true_maps),
        warnings=tuple(warnings),
    )


def read_av2_sweep(ref: SweepRef, trajectory: Trajectory | None = None) -> Sweep:
    """Read one sweep.

    Args:
        ref: The sweep.
        trajectory: Poses for compensation by offset_ns; None if the points already
            refer to the sweep's time.

    Raises:
        SweepError: If the file is missing, truncated, lacks columns or has no finite point.
        PoseError: If the trajectory does not cover the sweep.
    """
    required = ("x", "y", "z", "intensity") + (("offset_ns",) if trajectory is not None else ())
    columns = read_columns(ref.path, required, ("laser_number",), SweepError)
    points = np.empty((len(columns["x"]), 3))
    for axis, name in enumerate(("x", "y", "z")):
        points[:, axis] = columns[name]
    usable = is_usable(points)
    for column in columns.values():
        if column.dtype.kind == "f":
            usable &= np.isfinite(column)
    num_dropped = len(points) - int(usable.sum())
    if num_dropped == len(points):
        found = (
            f"all {num_dropped} points are NaN or infinite, or beyond 10 km"
            if num_dropped
            else "it is empty"
        )
        raise SweepError(f"Sweep {ref.path} has no points: {found}; copy it again or remove it.")
    if num_dropped:
        logger.warning(
            "%s: dropped %d points that are NaN, infinite or beyond 10 km", ref.path, num_dropped
        )
    kept = columns
    if num_dropped:
        points, kept = points[usable], {name: column[usable] for name, column in columns.items()}
    if trajectory is not None:
        offsets_ns = kept["offset_ns"].astype(np.float64)
        if np.abs(offsets_ns).max() > _MAX_OFFSET_NS:
            raise SweepError(
                f"Sweep {ref.path}: offset_ns runs from {offsets_ns.min():g} to "
                f"{offsets_ns.max():g}; expected those of one turn, within {_MAX_OFFSET_NS:g} ns."
            )
        points = compensate_ego_motion(
            points, offsets_ns.astype(np.int64), ref.timestamp_ns, trajectory
        )
    ring = kept.get("laser_number", np.zeros(len(points), dtype=np.uint8))
    return Sweep(
        timestamp_ns=ref.timestamp_ns,
        points_ego=points,
        intensity=to_bytes(kept["intensity"], "intensity", ref.path),
        ring=to_bytes(ring, "laser_number", ref.path),
    )


def _read_trajectory(path: Path, warnings: list[str]) -> Trajectory:
    columns = read_columns(path, ("timestamp_ns", *_QUATERNION, *_TRANSLATION), (), PoseError)
    times = columns["timestamp_ns"]
    if not np.issubdtype(times.dtype, np.integer):
        raise PoseError(f"{path}: timestamp_ns is {times.dtype}; expected integer nanoseconds.")
    if (times >= MAX_TIME_NS).any():  # before the cast: uint64 would wrap
        row = int(np.flatnonzero(times >= MAX_TIME_NS)[0])
        raise PoseError(
            f"Poses in {path} are unusable: row {row} has a time outside 1970 to 2116, ns: "
            f"{times[row]}; correct or remove it."
        )
    times = times.astype(np.int64)
    trajectory = trajectory_from_table(
        times,
        np.column_stack([columns[name] for name in _QUATERNION]).astype(np.float64),
        np.column_stack([columns[name] for name in _TRANSLATION]).astype(np.float64),
        path,
        warnings,
    )
    if num_backward := int((np.diff(times) < 0).sum()):
        warnings.append(
            f"poses in {path.name} go back in time {num_backward} times; they were sorted"
        )
    return trajectory


def _read_cameras(
    calibration: Path, is_rectified: bool
) -> tuple[dict[str, PinholeCamera], dict[str, DriveError]]:
    """Usable cameras, and why others are not. No intrinsics file means no cameras."""
    intrinsics_path = calibration / "intrinsics.feather"
    mounts_path = calibration / "egovehicle_SE3_sensor.feather"
    if not intrinsics_path.exists():
        return {}, {}
    intrinsics, is_raw = _intrinsics_table(intrinsics_path, is_rectified)
    mounts = (
        read_columns(
            mounts_path, ("sensor_name", *_QUATERNION, *_TRANSLATION), (), CalibrationError
        )
        if mounts_path.exists()
        else {"sensor_name": np.empty(0, dtype=object)}
    )
    row_of_mount = _rows_by_sensor(mounts, mounts_path)
    calibrated: dict[str, PinholeCamera] = {}
    unusable: dict[str, DriveError] = {}
    for name, row in _rows_by_sensor(intrinsics, intrinsics_path).items():
        try:
            if name not in row_of_mount:
                raise CalibrationError(
                    f"camera {name} has intrinsics but no mount: {mounts_path} "
                    f"{'has no row for it' if mounts_path.exists() else 'is missing'}; "
                    "expected its pose in the ego frame."
                )
            mount = _mount(mounts, row_of_mount[name], name, mounts_path)
            calibrated[name] = _camera(
                name, _row(intrinsics, row, is_raw[row]), mount, intrinsics_path
            )
        except CalibrationError as error:
            unusable[name] = error
    return calibrated, unusable


def read_intrinsics(path: Path) -> dict[str, PinholeCamera]:
    """Cameras of an intrinsics.feather, with the identity for a mount, which is in another table.

    Raises:
        CalibrationError: If the table or a row of it is unusable.
    """
    table, is_raw = _intrinsics_table(path, True)
    return {
        name: _camera(name, _row(table, row, is_raw[row]), SE3.identity(), path)
        for name, row in _rows_by_sensor(table, path).items()
    }


def read_mounts(path: Path) -> dict[str, SE3]:
    """``ego_SE3_sensor`` of all sensors in an egovehicle_SE3_sensor.feather.

    Raises:
        CalibrationError: If the table or a row of it is unusable.
    """
    table = read_columns(path, ("sensor_name", *_QUATERNION, *_TRANSLATION), (), CalibrationError)
    return {
        name: _mount(table, row, name, path) for name, row in _rows_by_sensor(table, path).items()
    }


def _intrinsics_table(path: Path, is_rectified: bool) -> tuple[dict[str, NDArrayAny], NDArrayBool]:
    """Columns, and of which rows (N,) the images show the lens's distortion."""
    required = ("sensor_name", *_INTRINSICS)
    table = read_columns(path, required, (_IS_RECTIFIED,), CalibrationError)
    said = table.pop(_IS_RECTIFIED, np.ones(len(table["sensor_name"])))
    if not np.isin(said, (0, 1)).all():
        raise CalibrationError(f"{path}: column {_IS_RECTIFIED} must hold 0 and 1 only.")
    is_raw = (said == 0) | (not is_rectified)
    if is_raw.any():
        table = read_columns(path, (*required, *_LENS), _TANGENTIAL, CalibrationError)
    return table, is_raw


def _row(table: Mapping[str, NDArrayAny], row: int, is_raw: bool) -> dict[str, float]:
    lens = [key for key in (*_LENS, *_TANGENTIAL) if is_raw and key in table]
    return {key: float(table[key][row]) for key in (*_INTRINSICS, *lens)}


def _rows_by_sensor(columns: Mapping[str, NDArrayAny], path: Path) -> dict[str, int]:
    """Row of each sensor; one that stands there twice must say the same twice."""
    rows: dict[str, int] = {}
    for row, name in enumerate(columns["sensor_name"]):
        if expected := name_problem(name):
            raise CalibrationError(
                f"{path}: row {row} has sensor_name {shown(name)}; expected {expected}."
            )
        first = rows.setdefault(name, row)
        for key, values in columns.items():
            if values[first] != values[row] and first != row:
                raise CalibrationError(
                    f"{path}: rows {first} and {row} are both {name} and contradict each other: "
                    f"{key} is {values[first]} and {values[row]}. Remove the wrong one."
                )
    return rows


def _mount(mounts: Mapping[str, Any], row: int, name: str, path: Path) -> SE3:
    return mount_from_quaternion(
        [float(mounts[key][row]) for key in _QUATERNION],
        [float(mounts[key][row]) for key in _TRANSLATION],
        name,
        f"{path}, row {row},",
    )


def _camera(name: str, values: Mapping[str, float], mount: SE3, path: Path) -> PinholeCamera:
    width, height = values["width_px"], values["height_px"]
    if not (np.isfinite([width, height]).all() and width == int(width) and height == int(height)):
        raise CalibrationError(
            f"camera {name} in {path} has image size ({width}, {height}); expected whole pixels."
        )
    k1, k2, k3, p1, p2 = (values.get(key, 0.0) for key in (*_LENS, *_TANGENTIAL))
    return PinholeCamera(
        name=name,
        width_px=int(width),
        height_px=int(height),
        fx=values["fx_px"],
        fy=values["fy_px"],
        cx=values["cx_px"],
        cy=values["cy_px"],
        ego_SE3_cam=mount,
        distortion=(k1, k2, p1, p2, k3),
    )


def _list_images(folder: Path, warnings: list[str]) -> dict[str, list[tuple[int, Path]]]:
    """Time and path of every image, by camera; cameras without images are left out."""
    if not folder.is_dir():
        return {}
    listed = {}
    for camera in sorted(folder.iterdir()):
        if not camera.is_dir():
            continue
        if expected := name_problem(camera.name):
            warnings.append(
                f"left out the camera folder {shown(camera.name)} in {folder}: expected {expected}"
            )
            continue
        listed[camera.name] = _timed_files(camera, _IMAGE_SUFFIXES, warnings)
    return {name: files for name, files in listed.items() if files}


def _timed_files(
    folder: Path, suffixes: frozenset[str], warnings: list[str]
) -> list[tuple[int, Path]]:
    """Files named by their time in nanoseconds; others are counted in a warning."""
    if not folder.is_dir():
        return []
    timed: dict[int, Path] = {}
    others, repeated = 0, []
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        # isdecimal alone would let through digits of other scripts.
        if not (path.stem.isascii() and path.stem.isdecimal() and int(path.stem) < MAX_TIME_NS):
            others += 1
        elif timed.setdefault(int(path.stem), path) is not path:
            repeated.append(path)  # would count twice in the map
    if others:
        warnings.append(
            f"{others} files in {folder} are not named by a time in nanoseconds; they were left out"
        )
    if repeated:
        warnings.append(
            f"{len(repeated)} files in {folder} have the time of another one and are left out, the "
            f"first is {repeated[0].name}"
        )
    return sorted(timed.items())


def _map_frame(log_dir: Path, maps: Sequence[Path], warnings: list[str]) -> MapFrame:
    given = log_dir / MAP_FRAME_FILE
    if given.is_file():
        return _read_map_frame(given)
    found = {match[1] for path in maps if (match := _CITY_IN_MAP_NAME.search(path.name))}
    if len(found) == 1 and (city := next(iter(found))) in CITY_UTM_ZONE_LAT_LON:
        zone, lat, lon = CITY_UTM_ZONE_LAT_LON[city]
        return MapFrame.from_crs(f"EPSG:326{zone}", (lat, lon))
    what = f"names the cities {', '.join(sorted(found))}" if found else "names no city"
    warnings.append(
        f"map/log_map_archive_*.json {what} (expected one of {', '.join(CITY_UTM_ZONE_LAT_LON)}), "
        "so the place on earth is unknown; geographic exports need --origin LAT,LON[,ALT]"
    )
    return MapFrame()


def _read_map_frame(path: Path) -> MapFrame:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return MapFrame.from_json(document)
    except (HDMapError, ValueError, TypeError, RecursionError) as error:
        raise DriveError(
            f"{path} does not say where the city frame lies ({' '.join(str(error).split())}); write "
            "the drive anew, or remove the file and give the place with --origin."
        ) from error
