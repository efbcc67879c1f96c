"""Drives in the nuScenes table layout.

Poses: every ego pose that a measurement of the scene refers to, so an image's own
pose is met exactly and others are interpolated. Ego z is 0 by the data set's
convention: the city frame is flat, with the ground near z = 0.

Sweeps carry no time for each point and are taken as they are: in the lidar frame,
at the sweep's time. They contain returns from the vehicle's own roof (23 % of the
points of a recorded sweep lie within 1 m of the sensor); none are removed here.

Source:
    The data set's schema, https://www.nuscenes.org/nuscenes#data-format, and the
    map origins in its development kit (`nuscenes/scripts/export_poses.py`).
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.errors import CalibrationError, DriveError, PoseError, SweepError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.cameras import mount_from_quaternion, select_cameras
from hdmap_tools.readers.checks import numbers, shown
from hdmap_tools.readers.drive import Drive, ImageRef, Sweep, SweepRef, keep_usable, to_bytes
from hdmap_tools.readers.folders import os_errors_are_drive_errors
from hdmap_tools.readers.nuscenes_tables import (
    Row,
    by_token,
    choose_scene,
    choose_version_folder,
    read_table,
    row_name,
)
from hdmap_tools.readers.poses import trajectory_from_table
from hdmap_tools.types import NDArrayFloat

logger = logging.getLogger(__name__)

LAYOUT: Final = "nuscenes"

MAP_ORIGIN_LAT_LON: Final[Mapping[str, tuple[float, float]]] = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}
"""South-west corner of each map, degrees; it is (0, 0) of the poses."""

_POINT_BYTES: Final = 5 * 4  # float32 x, y, z, intensity, ring
_REFERENCE_KEYS: Final = ("map", "resolution_m", "origin_xy_m", "size_px")


@os_errors_are_drive_errors()
def read_nuscenes(
    root: Path,
    scene: str | None = None,
    cameras: Sequence[str] = (),
    version: str | None = None,
) -> Drive:
    """List one scene, key frames and sweeps alike; images and sweeps are read later.

    Args:
        root: The data root (with ``samples/`` and a folder of tables), or the folder
            of tables itself.
        scene: Scene name or token; may be None if there is only one.
        cameras: Camera channels; empty means all that can be used.
        version: Name of the folder of tables, needed if root has several.

    Returns:
        The drive; its city frame is the map of the log's location.

    Raises:
        DriveError: If the tables are missing, broken or disagree, the scene does not
            exist, or none of its files do.
        CalibrationError: If no camera with images can be used, or one asked for cannot.
        PoseError: If the scene has no usable poses.
    """
    folder = choose_version_folder(Path(root), version)
    data_root = folder.parent
    row = choose_scene(read_table(folder, "scene"), scene, folder)
    warnings: list[str] = []

    def rows_of(table: str, keep: Callable[[Row], bool] = lambda r: True) -> dict[str, Row]:
        return by_token(read_table(folder, table, keep), table, folder, warnings)

    log = _row_of(rows_of("log"), row["log_token"], "log", folder)
    samples = rows_of("sample", lambda r: r["scene_token"] == row["token"])
    data = list(rows_of("sample_data", lambda r: r["sample_token"] in samples).values())
    if not data:
        raise DriveError(
            f"Scene {row['name']} has no measurements: {folder / 'sample_data.json'} has no row for "
            f"its {len(samples)} samples. Unpack the metadata again."
        )
    pose_tokens = {r["ego_pose_token"] for r in data}
    poses = rows_of("ego_pose", lambda r: r["token"] in pose_tokens)
    calibrations = rows_of("calibrated_sensor")
    sensors = rows_of("sensor")

    trajectory = _trajectory(poses, folder, warnings)
    channels = {
        channel: (modality, _measured_once(channel, rows, warnings))
        for channel, (modality, rows) in _by_channel(data, calibrations, sensors, folder).items()
    }
    posed, unposed = _with_pose(channels, poses, folder)
    calibrated: dict[str, PinholeCamera] = {}
    unusable: dict[str, DriveError] = {}
    camera_channels = {c for c, (modality, _) in channels.items() if modality == "camera"}
    for channel in sorted(camera_channels):
        if not posed.get(channel):
            unusable[channel] = unposed[channel]
            continue
        try:
            calibrated[channel] = _camera(channel, posed[channel], calibrations, folder)
        except CalibrationError as error:
            unusable[channel] = error
    chosen, left_out = select_cameras(
        calibrated, unusable, camera_channels, cameras, f"Scene {row['name']} in {folder}"
    )
    warnings += left_out
    warnings += [str(e) for c, e in sorted(unposed.items()) if c not in unusable]

    mounts: dict[Path, SE3] = {}
    images: list[ImageRef] = []
    sweeps: list[SweepRef] = []
    absent: Counter[str] = Counter()
    example: dict[str, Path] = {}
    for channel, (modality, _) in channels.items():
        if modality == "camera" and channel not in chosen:
            continue
        for r in posed.get(channel, []):
            path, time_ns = data_root / r["filename"], int(r["timestamp"]) * 1000
            if modality not in ("camera", "lidar"):
                continue
            if not path.is_file():
                absent[channel] += 1
                example.setdefault(channel, path)
            elif modality == "camera":
                images.append(ImageRef(channel, time_ns, path))
            else:
                token = r["calibrated_sensor_token"]
                mounts[path] = _mount(channel, calibrations[token], folder)
                sweeps.append(SweepRef(time_ns, path, channel))
    if absent and not images and not sweeps:
        raise DriveError(
            f"Scene {row['name']}: none of its {absent.total()} files exist, for example "
            f"{next(iter(example.values()))}; unpack the sensor archives into {data_root}."
        )
    warnings += [
        f"{count} files of {channel} do not exist and are left out, the first is {example[channel]}"
        for channel, count in sorted(absent.items())
    ]
    frame = _map_frame(log["location"], warnings)
    references = _reference_maps(data_root, log["location"], warnings)
    for warning in warnings:
        logger.warning("%s: %s", row["name"], warning)
    return Drive(
        name=str(row["name"]),
        layout=LAYOUT,
        root=data_root,
        frame=frame,
        trajectory=trajectory,
        cameras=chosen,
        images=tuple(images),
        sweeps=tuple(sweeps),
        # partial, not a closure: a drive can then be sent to another process.
        read_sweep=partial(_read_mounted_sweep, mounts=mounts),
        reference_maps=references,
        warnings=tuple(warnings),
    )


def read_nuscenes_sweep(ref: SweepRef, ego_SE3_lidar: SE3) -> Sweep:
    """Read one ``.pcd.bin`` (float32 x, y, z, intensity, ring; lidar frame) into the ego frame.

    Raises:
        SweepError: If the file is missing, truncated, empty or holds no finite point.
    """
    try:
        raw = ref.path.read_bytes()
    except OSError as error:
        raise SweepError(f"Sweep {ref.path} cannot be read: {error.strerror or error}.") from error
    if not raw or len(raw) % _POINT_BYTES:
        raise SweepError(
            f"Sweep {ref.path} has {len(raw)} bytes; expected a positive multiple of {_POINT_BYTES} "
            "(float32 x, y, z, intensity, ring). It is truncated or of another format: copy it again."
        )
    values = np.frombuffer(raw, dtype="<f4").reshape(-1, 5).astype(np.float64)
    values, num_dropped = keep_usable(values)
    if not len(values):
        raise SweepError(
            f"Sweep {ref.path}: all {num_dropped} points are NaN or infinite, or beyond 10 km; copy it again."
        )
    if num_dropped:
        logger.warning(
            "%s: dropped %d points that are NaN, infinite or beyond 10 km", ref.path, num_dropped
        )
    return Sweep(
        timestamp_ns=ref.timestamp_ns,
        points_ego=ego_SE3_lidar.transform_from(values[:, :3]),
        intensity=to_bytes(values[:, 3], "intensity", ref.path),
        ring=to_bytes(values[:, 4], "ring", ref.path),
    )


def _read_mounted_sweep(ref: SweepRef, mounts: Mapping[Path, SE3]) -> Sweep:
    return read_nuscenes_sweep(ref, mounts[ref.path])


def _row_of(rows: Mapping[str, Row], token: str, table: str, folder: Path) -> Row:
    if token not in rows:
        error_type = CalibrationError if table in ("calibrated_sensor", "sensor") else DriveError
        raise error_type(
            f"Table {folder / table}.json has no row with token {token!r}, which another table "
            "refers to; the tables do not belong together. Unpack the metadata again."
        )
    return rows[token]


def _trajectory(poses: Mapping[str, Row], folder: Path, warnings: list[str]) -> Trajectory:
    path = folder / "ego_pose.json"
    if not poses:
        raise PoseError(f"Table {path} has none of the poses that the scene refers to.")
    rows = sorted(poses.values(), key=lambda r: (int(r["timestamp"]), str(r["token"])))

    def column(name: str, what: str, count: int) -> NDArrayFloat:
        values = []
        for row in rows:
            vector = numbers(row[name], (count,))
            if vector is None:
                raise PoseError(
                    f"Poses in {path} are unusable: {name} is {shown(row[name])} in "
                    f"{row_name(row)}; expected {what}."
                )
            values.append(vector)
        return np.array(values)

    wxyz = column("rotation", "4 numbers (w, x, y, z)", 4)
    xyz_m = column("translation", "3 numbers in metres", 3)
    times = np.array([r["timestamp"] for r in rows], dtype=np.int64) * 1000
    return trajectory_from_table(
        times, wxyz, xyz_m, path, warnings, [row_name(row) for row in rows]
    )


def _by_channel(
    data: Sequence[Row],
    calibrations: Mapping[str, Row],
    sensors: Mapping[str, Row],
    folder: Path,
) -> dict[str, tuple[str, list[Row]]]:
    """Modality and rows, by time, of each channel."""
    channels: dict[str, tuple[str, list[Row]]] = {}
    for row in sorted(data, key=lambda r: (int(r["timestamp"]), str(r["token"]))):
        calibration = _row_of(
            calibrations, row["calibrated_sensor_token"], "calibrated_sensor", folder
        )
        sensor = _row_of(sensors, calibration["sensor_token"], "sensor", folder)
        channels.setdefault(sensor["channel"], (sensor["modality"], []))[1].append(row)
    return channels


def _measured_once(channel: str, rows: Sequence[Row], warnings: list[str]) -> list[Row]:
    """Rows without those whose time or file an earlier row has: each would count twice in the map."""
    times: set[int] = set()
    files: set[str] = set()
    once: list[Row] = []
    repeated: list[Row] = []
    for row in rows:
        if row["timestamp"] in times or row["filename"] in files:
            repeated.append(row)
            continue
        times.add(row["timestamp"])
        files.add(row["filename"])
        once.append(row)
    if repeated:
        warnings.append(
            f"{len(repeated)} of {len(rows)} measurements of {channel} have the time or the file of "
            f"an earlier one and are left out, the first is {row_name(repeated[0])} in "
            f"sample_data.json ({repeated[0]['filename']})"
        )
    return once


def _with_pose(
    channels: Mapping[str, tuple[str, list[Row]]], poses: Mapping[str, Row], folder: Path
) -> tuple[dict[str, list[Row]], dict[str, DriveError]]:
    """Rows that have a pose, and for each channel that lost rows, why."""
    posed: dict[str, list[Row]] = {}
    unposed: dict[str, DriveError] = {}
    for channel, (_, rows) in channels.items():
        posed[channel] = [r for r in rows if r["ego_pose_token"] in poses]
        if lost := len(rows) - len(posed[channel]):
            unposed[channel] = PoseError(
                f"{lost} of {len(rows)} measurements of {channel} have no ego pose in "
                f"{folder / 'ego_pose.json'} and are left out; unpack the metadata again."
            )
    return posed, unposed


def _mount(channel: str, calibration: Row, folder: Path) -> SE3:
    return mount_from_quaternion(
        calibration["rotation"],
        calibration["translation"],
        channel,
        f"{folder / 'calibrated_sensor.json'}, {row_name(calibration)},",
    )


def _camera(
    channel: str, rows: Sequence[Row], calibrations: Mapping[str, Row], folder: Path
) -> PinholeCamera:
    """The camera of a channel; images are published undistorted, so there is no lens model."""
    tokens = {r["calibrated_sensor_token"] for r in rows}
    sizes = {(r["width"], r["height"]) for r in rows}
    if len(tokens) != 1 or len(sizes) != 1:
        raise CalibrationError(
            f"Camera {channel} has {len(tokens)} calibrations and {len(sizes)} image sizes in one "
            "scene; expected one of each."
        )
    calibration = calibrations[tokens.pop()]
    width, height = sizes.pop()
    matrix = numbers(calibration["camera_intrinsic"], (3, 3))
    if matrix is None or not np.array_equal(matrix[2], (0.0, 0.0, 1.0)):
        raise CalibrationError(
            f"Camera {channel} has no usable camera_intrinsic in "
            f"{folder / 'calibrated_sensor.json'}, {row_name(calibration)}: found "
            f"{shown(calibration['camera_intrinsic'])}, expected a 3x3 matrix in pixels that ends "
            "with the row (0, 0, 1)."
        )
    return PinholeCamera(
        name=channel,
        width_px=int(width),
        height_px=int(height),
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
        ego_SE3_cam=_mount(channel, calibration, folder),
    )


def _map_frame(location: str, warnings: list[str]) -> MapFrame:
    if location in MAP_ORIGIN_LAT_LON:
        return MapFrame.from_origin(*MAP_ORIGIN_LAT_LON[location])
    warnings.append(
        f"location {location!r} is not a nuScenes map ({', '.join(MAP_ORIGIN_LAT_LON)}), so its "
        "place on earth is unknown; geographic exports need --origin LAT,LON[,ALT]"
    )
    return MapFrame()


def _reference_maps(root: Path, location: str, warnings: list[str]) -> tuple[Path, ...]:
    """Masks of this location: a PNG beside a JSON that says where it lies."""
    found = []
    for description in sorted(root.glob("*.json")):
        mask = description.with_suffix(".png")
        if not mask.is_file():
            continue
        try:
            document: Any = json.loads(description.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            warnings.append(f"{description} is not readable JSON ({error}); its mask is left out")
            continue
        if (
            isinstance(document, dict)
            and all(key in document for key in _REFERENCE_KEYS)
            and document["map"] == location
        ):
            found.append(mask)
    return tuple(found)
