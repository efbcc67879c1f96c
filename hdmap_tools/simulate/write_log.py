"""Files of an Argoverse 2 sensor log: poses, calibration, images, sweeps.

Sweeps hold x, y and z as float32. Recorded logs hold float16, whose steps are 3 cm at
50 m and 6 cm beyond 64 m: more than the range noise that is simulated, and than the
errors that are to be measured. The data set's own package takes either.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.errors import FormatError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.av2 import MAP_FRAME_FILE, POSES_FILE
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat32, NDArrayInt

JPEG_QUALITY: Final = 95
LIDAR_MOUNTS: Final = ("up_lidar", "down_lidar")
"""The data set's package asks for both; a simulated vehicle has one lidar, which is both."""


def write_poses(log: Path, city_SE3_ego: Trajectory) -> None:
    """``city_SE3_egovehicle.feather``."""
    wxyz = np.array([city_SE3_ego.pose(k).quaternion_wxyz for k in range(len(city_SE3_ego))])
    _write_feather(
        log / POSES_FILE,
        {
            "timestamp_ns": city_SE3_ego.timestamps_ns,
            **_pose_columns(wxyz, city_SE3_ego.translations),
        },
    )


def write_calibration(
    log: Path, cameras: Sequence[PinholeCamera], ego_SE3_lidar: SE3 | None
) -> None:
    """``calibration/``: mounts of all sensors, intrinsics of the cameras (rectified: no lens)."""
    names = [camera.name for camera in cameras]
    mounts = [camera.ego_SE3_cam for camera in cameras]
    lidars = LIDAR_MOUNTS if ego_SE3_lidar is not None else ()
    if ego_SE3_lidar is not None:
        mounts += [ego_SE3_lidar] * len(lidars)
    _write_feather(
        log / "calibration" / "egovehicle_SE3_sensor.feather",
        {
            "sensor_name": np.array([*names, *lidars], dtype=object),
            **_pose_columns(
                np.array([mount.quaternion_wxyz for mount in mounts]),
                np.array([mount.translation for mount in mounts]),
            ),
        },
    )
    intrinsics: dict[str, NDArrayAny] = {"sensor_name": np.array(names, dtype=object)}
    for column, attribute in (("fx_px", "fx"), ("fy_px", "fy"), ("cx_px", "cx"), ("cy_px", "cy")):
        intrinsics[column] = np.array([getattr(camera, attribute) for camera in cameras])
    for column, index in (("k1", 0), ("k2", 1), ("k3", 4)):
        intrinsics[column] = np.array([camera.distortion[index] for camera in cameras])
    intrinsics["height_px"] = np.array([camera.height_px for camera in cameras], dtype=np.uint16)
    intrinsics["width_px"] = np.array([camera.width_px for camera in cameras], dtype=np.uint16)
    _write_feather(log / "calibration" / "intrinsics.feather", intrinsics)


def image_path(log: Path, camera: str, timestamp_ns: int) -> Path:
    """Where an image lies."""
    return log / "sensors" / "cameras" / camera / f"{timestamp_ns}.jpg"


def write_jpeg(path: Path, rgb: NDArrayByte) -> None:
    """A colour image (H, W, 3) uint8, RGB.

    Raises:
        FormatError: If it cannot be encoded.
    """
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    done, encoded = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), settings)
    if not done:
        raise FormatError(f"The image {path} of shape {rgb.shape} could not be encoded as JPEG.")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded.tobytes())


def write_sweep(
    log: Path,
    timestamp_ns: int,
    points_ego: NDArrayFloat32,
    intensity: NDArrayByte,
    laser_number: NDArrayByte,
    offset_ns: NDArrayInt,
) -> None:
    """One sweep, ego-motion compensated to its timestamp.

    Args:
        log: Folder of the log.
        timestamp_ns: Time that the points refer to.
        points_ego: (N, 3) float32 metres, ego frame at that time.
        intensity: (N,) uint8.
        laser_number: (N,) uint8.
        offset_ns: (N,) when each point was measured, after the timestamp.
    """
    x, y, z = np.asarray(points_ego, dtype=np.float32).T
    _write_feather(
        log / "sensors" / "lidar" / f"{timestamp_ns}.feather",
        {
            "x": x,
            "y": y,
            "z": z,
            "intensity": np.asarray(intensity, dtype=np.uint8),
            "laser_number": np.asarray(laser_number, dtype=np.uint8),
            "offset_ns": np.asarray(offset_ns, dtype=np.int32),
        },
    )


def write_map_frame(log: Path, frame: MapFrame) -> None:
    """``map_frame.json``: where the city frame lies, which the layout has no place for."""
    write_json(log / MAP_FRAME_FILE, frame.to_json())


def write_json(path: Path, document: Any) -> None:
    """A document as JSON, the same bytes for the same document."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(document, indent=2, sort_keys=True, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def _pose_columns(wxyz: NDArrayAny, xyz_m: NDArrayAny) -> dict[str, NDArrayAny]:
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict(zip(names, np.column_stack([wxyz, xyz_m]).T, strict=True))


def _write_feather(path: Path, columns: Mapping[str, NDArrayAny]) -> None:
    import pyarrow as pa
    import pyarrow.feather

    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table({name: pa.array(values) for name, values in columns.items()})
    pyarrow.feather.write_feather(table, path)
