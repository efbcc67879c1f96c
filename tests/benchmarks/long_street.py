"""A street as long as asked for: a straight one, so each sweep and each label image is the same file.

What a drive through it costs to map is what any drive of this length costs; what it costs to
make is next to nothing.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.label_png import write_label_png
from hdmap_tools.segmentation.precomputed import LABEL_SET_NAME
from hdmap_tools.simulate.write_log import (
    image_path,
    write_calibration,
    write_jpeg,
    write_map_frame,
    write_poses,
    write_sweep,
)
from hdmap_tools.testing.street import camera

SPEED_MPS, CAMERA_HZ, LIDAR_HZ = 8.0, 13.0, 10.0
ROAD_M, WALL_M, WALL_HEIGHT_M = 6.0, 11.0, 5.0
LIDAR_M = 1.8


def write_long_street(
    folder: Path,
    length_m: float,
    *,
    rings: int = 32,
    camera_hz: float = CAMERA_HZ,
    lidar_hz: float = LIDAR_HZ,
) -> None:
    """Write a drive in the layout of Argoverse 2 and its label images, in ``drive`` and ``labels``.

    Args:
        folder: Where; made.
        length_m: Of the drive, eastwards.
        rings: Of the lidar.
        camera_hz: Images and
        lidar_hz: sweeps a second.
    """
    drive, labels = folder / "drive", folder / "labels"
    lasts_s = length_m / SPEED_MPS
    cam = camera()
    start_ns = 10**18
    times = np.linspace(0.0, lasts_s, int(lasts_s * 20) + 2)
    xyz = np.column_stack([times * SPEED_MPS, np.zeros_like(times), np.zeros_like(times)])
    poses = Trajectory(
        start_ns + np.rint(times * 1e9).astype(np.int64), np.tile(np.eye(3), (len(xyz), 1, 1)), xyz
    )
    drive.mkdir(parents=True)
    write_poses(drive, poses)
    write_map_frame(drive, MapFrame())
    write_calibration(drive, [cam], SE3(np.eye(3), np.array([0.0, 0.0, LIDAR_M])))

    points, ring, intensity = sweep_of_street(rings)
    first = None
    for number in range(int(lasts_s * lidar_hz)):
        time_ns = start_ns + int(number / lidar_hz * 1e9)
        path = drive / "sensors" / "lidar" / f"{time_ns}.feather"
        if first is None:
            write_sweep(drive, time_ns, points, intensity, ring, np.zeros(len(ring), np.int32))
            first = path
        else:
            os.link(first, path)

    label_set = load_label_set("street")
    ids = labels_of_street(cam, label_set.names)
    one_image = one_label = None
    for number in range(int(lasts_s * camera_hz)):
        time_ns = start_ns + int((number + 0.5) / camera_hz * 1e9)
        image = image_path(drive, cam.name, time_ns)
        label = labels / cam.name / f"{time_ns}.png"
        if one_image is None or one_label is None:
            write_jpeg(image, np.full((*ids.shape, 3), 90, dtype=np.uint8))
            write_label_png(label, ids)
            one_image, one_label = image, label
        else:
            os.link(one_image, image)
            os.link(one_label, label)
    (labels / LABEL_SET_NAME).write_text(label_set.model_dump_json(), encoding="utf-8")


def sweep_of_street(rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (N, 3) of one turn, ego metres, with ring and intensity."""
    elevation = np.deg2rad(np.linspace(-25.0, 10.0, rings))[:, None]
    azimuth = np.linspace(-np.pi, np.pi, 1800, endpoint=False)[None, :]
    with np.errstate(divide="ignore"):
        to_ground = np.where(elevation < 0, LIDAR_M / np.tan(-elevation), np.inf)
        to_wall = WALL_M / np.abs(np.sin(azimuth))
    flat = np.minimum(to_ground, to_wall)
    flat = np.minimum(flat, 1e6)
    x, y = flat * np.cos(azimuth), flat * np.sin(azimuth)
    z = LIDAR_M + flat * np.tan(elevation)
    ring = np.broadcast_to(np.arange(rings)[:, None], flat.shape)
    seen = (flat < 80.0) & (z < WALL_HEIGHT_M)
    # Nothing in the world is as flat as a formula: a centimetre of roughness.
    rough = np.random.default_rng(0).normal(0.0, 0.01, flat.shape)
    points = np.stack([x, y, z + rough], axis=-1)[seen].astype(np.float32)
    paint = np.abs(np.abs(points[:, 1]) - 1.75) < 0.08
    return points, ring[seen].astype(np.uint8), np.where(paint, 90, 25).astype(np.uint8)


def labels_of_street(cam, names: tuple[str, ...]) -> np.ndarray:
    """Label image (height, width): road with two marks, pavement, walls, sky."""
    v, u = np.mgrid[: cam.height_px, : cam.width_px]
    rays = np.stack([(u - cam.cx) / cam.fx, (v - cam.cy) / cam.fy, np.ones(u.shape)], axis=-1)
    rays = rays @ cam.ego_SE3_cam.rotation.T
    eye = cam.ego_SE3_cam.translation
    ids = np.full(u.shape, names.index("sky"), dtype=np.uint8)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_wall = (np.sign(rays[..., 1]) * WALL_M - eye[1]) / rays[..., 1]
        ids[eye[2] + to_wall * rays[..., 2] < WALL_HEIGHT_M] = names.index("building")
        down = -eye[2] / rays[..., 2]
        y = eye[1] + down * rays[..., 1]
    ground = (rays[..., 2] < 0) & (np.abs(y) < WALL_M)
    ids[ground] = names.index("sidewalk")
    ids[ground & (np.abs(y) < ROAD_M)] = names.index("road")
    ids[ground & (np.abs(np.abs(y) - 1.75) < 0.08)] = names.index("lane marking")
    return ids
