"""Write small drives with known truth, in the layouts that the readers read.

For tests of readers, pipelines and plugins: what is given as arrays comes back from
`open_drive`, up to what the layout itself can hold (said at each writer).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.types import NDArrayByte, NDArrayInt

Images = Mapping[str, Mapping[int, NDArrayByte]]
"""RGB images (H, W, 3) uint8 by camera name and timestamp_ns."""

_NUSCENES_TABLES: Final = (
    *("scene", "log", "map", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor"),
    *("sample_annotation", "instance", "category", "attribute", "visibility"),
)


def write_nuscenes(
    root: Path,
    *,
    trajectory: Trajectory,
    cameras: Sequence[PinholeCamera] = (),
    images: Images | None = None,
    sweeps: Sequence[Sweep] = (),
    ego_SE3_lidar: SE3 | None = None,
    key_frame_times_ns: Sequence[int] | None = None,
    version: str = "v1.0-mini",
    scene: str = "scene-0001",
    location: str = "singapore-onenorth",
    image_suffix: str = ".png",
) -> Path:
    """Add a scene to a data root in the nuScenes table layout.

    Calling it again adds a scene to the same tables. The layout keeps times in
    microseconds, points as float32 in the lidar frame, and a pose only where there
    is a measurement.

    Args:
        root: The data root; made if missing.
        trajectory: Must cover every image and sweep.
        cameras: Calibrated cameras; their distortion is not written.
        images: Their images.
        sweeps: Points in the ego frame at the sweep's time.
        ego_SE3_lidar: Mount of the lidar; identity if None.
        key_frame_times_ns: Times of key frames; others are sweeps. None: all are key.
        version: Folder of the tables.
        scene: Name of the scene.
        location: Location of its log.
        image_suffix: ``.png`` keeps pixels exactly, ``.jpg`` does not.

    Returns:
        The data root.

    Raises:
        ShapeError: If a time is not a whole number of microseconds.
    """
    mount = ego_SE3_lidar or SE3.identity()
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in _NUSCENES_TABLES}
    scene_token, log_token = _token(scene), _token(scene, "log")
    tables["log"].append({"token": log_token, "logfile": scene, "location": location})

    measured: list[tuple[str, str, int, int, int]] = []  # channel, suffix, time, width, height
    for camera in cameras:
        _add_sensor(
            tables, scene, camera.name, "camera", camera.ego_SE3_cam, camera.matrix.tolist()
        )
        for time_ns in sorted((images or {}).get(camera.name, {})):
            measured.append((camera.name, image_suffix, time_ns, camera.width_px, camera.height_px))
    if sweeps:
        _add_sensor(tables, scene, "LIDAR_TOP", "lidar", mount, [])
        measured += [("LIDAR_TOP", ".pcd.bin", sweep.timestamp_ns, 0, 0) for sweep in sweeps]
    key_times = sorted(
        {time for _, _, time, _, _ in measured}
        if key_frame_times_ns is None
        else key_frame_times_ns
    )
    for time_ns in key_times:
        tables["sample"].append(
            {
                "token": _token(scene, time_ns),
                "timestamp": _microseconds(time_ns),
                "scene_token": scene_token,
            }
        )
    tables["scene"].append(
        {
            "token": scene_token,
            "name": scene,
            "log_token": log_token,
            "nbr_samples": len(key_times),
            "description": "made",
        }
    )
    sweep_at = {sweep.timestamp_ns: sweep for sweep in sweeps}
    for channel, suffix, time_ns, width, height in measured:
        is_key = time_ns in key_times
        folder = Path("samples" if is_key else "sweeps") / channel
        name = folder / f"{scene}__{channel}__{_microseconds(time_ns)}{suffix}"
        token = _token(scene, channel, time_ns)
        nearest = min(key_times, key=lambda key: abs(key - time_ns))
        tables["sample_data"].append(
            {
                "token": token,
                "sample_token": _token(scene, nearest),
                "ego_pose_token": token,
                "calibrated_sensor_token": _token(scene, channel, "calibration"),
                "timestamp": _microseconds(time_ns),
                "fileformat": suffix.strip(".").split(".")[0],
                "is_key_frame": is_key,
                "height": height,
                "width": width,
                "filename": name.as_posix(),
            }
        )
        pose = trajectory.interpolate(time_ns)
        tables["ego_pose"].append(
            {"token": token, "timestamp": _microseconds(time_ns), **_nuscenes_pose(pose)}
        )
        if suffix == ".pcd.bin":
            _write_pcd_bin(root / name, sweep_at[time_ns], mount)
        else:
            _write_image(root / name, (images or {})[channel][time_ns])
    folder = root / version
    folder.mkdir(parents=True, exist_ok=True)
    for name_of_table, rows in tables.items():
        path = folder / f"{name_of_table}.json"
        kept = json.loads(path.read_text()) if path.exists() else []
        known = {row["token"] for row in kept}
        merged = kept + [row for row in rows if row["token"] not in known]
        path.write_text(json.dumps(merged, indent=1))
    return root


def write_av2(
    log_dir: Path,
    *,
    trajectory: Trajectory,
    cameras: Sequence[PinholeCamera] = (),
    images: Images | None = None,
    sweeps: Sequence[Sweep] = (),
    offsets_ns: Mapping[int, NDArrayInt] | None = None,
    city: str | None = "PIT",
    vector_map: Mapping[str, Any] | None = None,
    image_suffix: str = ".png",
) -> Path:
    """Write a log in the Argoverse 2 sensor-log layout.

    The layout keeps points as float16: 1 mm apart at 1 m, 3 cm at 50 m.

    Args:
        log_dir: Folder of the log; made if missing.
        trajectory: All poses are written.
        cameras: Calibrated cameras, with radial distortion only.
        images: Their images.
        sweeps: Points in the ego frame.
        offsets_ns: Time of each point after its sweep, by the sweep's timestamp_ns;
            zeros if None.
        city: City in the map's file name; None writes no map.
        vector_map: Content of the map; empty if None.
        image_suffix: ``.png`` keeps pixels exactly, ``.jpg`` does not.

    Returns:
        The log's folder.
    """
    quaternions = np.array([trajectory.pose(i).quaternion_wxyz for i in range(len(trajectory))])
    _write_feather(
        log_dir / "city_SE3_egovehicle.feather",
        {
            "timestamp_ns": trajectory.timestamps_ns,
            **_av2_pose_columns(quaternions, trajectory.translations),
        },
    )
    if cameras:
        names = np.array([camera.name for camera in cameras], dtype=object)
        mounts = [camera.ego_SE3_cam for camera in cameras]
        lidars = ["up_lidar", "down_lidar"]  # the data set's own package asks for them
        all_mounts = mounts + [SE3.identity()] * len(lidars)
        _write_feather(
            log_dir / "calibration" / "egovehicle_SE3_sensor.feather",
            {
                "sensor_name": np.array([*names, *lidars], dtype=object),
                **_av2_pose_columns(
                    np.array([mount.quaternion_wxyz for mount in all_mounts]),
                    np.array([mount.translation for mount in all_mounts]),
                ),
            },
        )
        _write_feather(
            log_dir / "calibration" / "intrinsics.feather",
            {
                "sensor_name": names,
                "fx_px": np.array([camera.fx for camera in cameras]),
                "fy_px": np.array([camera.fy for camera in cameras]),
                "cx_px": np.array([camera.cx for camera in cameras]),
                "cy_px": np.array([camera.cy for camera in cameras]),
                "k1": np.array([camera.distortion[0] for camera in cameras]),
                "k2": np.array([camera.distortion[1] for camera in cameras]),
                "k3": np.array([camera.distortion[4] for camera in cameras]),
                "height_px": np.array([camera.height_px for camera in cameras], dtype=np.uint16),
                "width_px": np.array([camera.width_px for camera in cameras], dtype=np.uint16),
            },
        )
    for camera_name, frames in (images or {}).items():
        for time_ns, image in frames.items():
            folder = log_dir / "sensors" / "cameras" / camera_name
            _write_image(folder / f"{time_ns}{image_suffix}", image)
    for sweep in sweeps:
        zeros = np.zeros(len(sweep.points_ego), dtype=np.int32)
        offsets = (offsets_ns or {}).get(sweep.timestamp_ns, zeros)
        x, y, z = sweep.points_ego.T.astype(np.float16)
        _write_feather(
            log_dir / "sensors" / "lidar" / f"{sweep.timestamp_ns}.feather",
            {
                **{"x": x, "y": y, "z": z, "intensity": sweep.intensity},
                **{"laser_number": sweep.ring, "offset_ns": np.asarray(offsets, dtype=np.int32)},
            },
        )
    if city is not None:
        empty: dict[str, Any] = {
            "pedestrian_crossings": {},
            "lane_segments": {},
            "drivable_areas": {},
        }
        path = log_dir / "map" / f"log_map_archive_{log_dir.name}____{city}_city_1.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(dict(vector_map or empty), sort_keys=True))
    return log_dir


def _token(*parts: str | int) -> str:
    return hashlib.md5(":".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def _microseconds(time_ns: int) -> int:
    if time_ns % 1000:
        raise ShapeError(f"nuScenes times are whole microseconds, found {time_ns} ns.")
    return int(time_ns) // 1000


def _nuscenes_pose(pose: SE3) -> dict[str, list[float]]:
    return {"rotation": pose.quaternion_wxyz.tolist(), "translation": pose.translation.tolist()}


def _add_sensor(
    tables: dict[str, list[dict[str, Any]]],
    scene: str,
    channel: str,
    modality: str,
    mount: SE3,
    intrinsic: list[list[float]],
) -> None:
    tables["sensor"].append({"token": _token(channel), "channel": channel, "modality": modality})
    tables["calibrated_sensor"].append(
        {
            "token": _token(scene, channel, "calibration"),
            "sensor_token": _token(channel),
            **_nuscenes_pose(mount),
            "camera_intrinsic": intrinsic,
        }
    )


def _av2_pose_columns(wxyz: Any, xyz_m: Any) -> dict[str, Any]:
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict(zip(names, np.column_stack([wxyz, xyz_m]).T, strict=True))


def _write_pcd_bin(path: Path, sweep: Sweep, ego_SE3_lidar: SE3) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    points_lidar = ego_SE3_lidar.inverse().transform_from(sweep.points_ego)
    rows = np.column_stack([points_lidar, sweep.intensity, sweep.ring])
    path.write_bytes(rows.astype("<f4").tobytes())


def _write_image(path: Path, image: NDArrayByte) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    ok, encoded = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not ok:
        raise ShapeError(f"An image of shape {image.shape} cannot be written as {path.suffix}.")
    path.write_bytes(encoded.tobytes())


def _write_feather(path: Path, columns: Mapping[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.feather

    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table({name: pa.array(np.asarray(values)) for name, values in columns.items()})
    pyarrow.feather.write_feather(table, path)
