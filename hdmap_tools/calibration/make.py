"""The three commands of `hdmap calibrate`, from files to files."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from hdmap_tools.calibration.board_images import find_boards, list_images
from hdmap_tools.calibration.calibration_files import (
    Calibration,
    read_calibration,
    write_calibration,
)
from hdmap_tools.calibration.chessboard import Board
from hdmap_tools.calibration.coverage_picture import coverage_picture
from hdmap_tools.calibration.extrinsics import MAX_ERROR_PX, estimate_extrinsics
from hdmap_tools.calibration.intrinsics import estimate_intrinsics
from hdmap_tools.calibration.overlay import Overlay, overlay_points
from hdmap_tools.calibration.pairs import Pairs, read_pairs
from hdmap_tools.calibration.reports import extrinsics_report, intrinsics_report
from hdmap_tools.errors import CalibrationError, DriveError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.output_folder import is_result_of, require_free, result_folder
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.types import NDArrayFloat
from hdmap_tools.view.canvas import write_png

logger = logging.getLogger(__name__)

COMMAND: Final = "calibrate"
REPORT_FILE: Final = "report.json"
COVERAGE_FILE: Final = "coverage.png"
_MAX_SWEEP_GAP_S: Final = 0.2
"""Two turns of a lidar at 10 Hz; the motion in between is undone by the poses."""


def make_intrinsics(
    images: Sequence[Path],
    board: Board,
    out: Path,
    *,
    name: str = "camera",
    add_to: Path | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Find a camera's intrinsics and write ``calibration/``, the report and the coverage picture.

    Args:
        images: Pictures of the board, or folders of them.
        board: The board.
        out: Folder to make.
        name: The camera's name.
        add_to: A calibration or drive whose other sensors are kept beside this camera.
        overwrite: Whether an older result may be replaced.
        progress: Told how many of how many pictures are done.

    Returns:
        The report.

    Raises:
        HDMapError: As `find_boards`, `estimate_intrinsics` and `result_folder`.
    """
    require_free(out, overwrite, is_result_of(COMMAND))
    known = Calibration({}) if add_to is None else read_calibration(add_to)
    boards = find_boards(list_images(images), board, progress)
    found = estimate_intrinsics(boards.views, board, boards.size_px, name)
    report = intrinsics_report(found, boards, board)
    _tell(report)
    camera = found.camera
    if name in known.mounts:
        camera = replace(camera, ego_SE3_cam=known.mounts[name])
    with result_folder(out, COMMAND, overwrite) as folder:
        write_calibration(folder, known.with_camera(camera, is_mounted=False))
        write_png(coverage_picture(found, boards.views), folder / COVERAGE_FILE)
        _write_report(folder, report)
    return report


def make_extrinsics(
    pairs_path: Path,
    camera_path: Path,
    out: Path,
    *,
    name: str | None = None,
    lidar: str | None = None,
    max_error_px: float = MAX_ERROR_PX,
    seed: int = 0,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Find a camera's mount and write ``calibration/`` and the report.

    Args:
        pairs_path: CSV of pairs.
        camera_path: Where the intrinsics are: an earlier result, a ``calibration`` folder, or
            a drive. Its other sensors are kept.
        out: Folder to make.
        name: Which camera, where there are several.
        lidar: The points are in the frame of this sensor, whose mount is known there; None
            for points in the ego frame.
        max_error_px: Pairs nearer than this agree, while the pose is looked for.
        seed: Of the random samples.
        overwrite: Whether an older result may be replaced.

    Returns:
        The report.

    Raises:
        HDMapError: As `read_pairs`, `read_calibration`, `estimate_extrinsics` and `result_folder`.
    """
    require_free(out, overwrite, is_result_of(COMMAND))
    known = read_calibration(camera_path)
    camera = known.camera(name, camera_path)
    pairs = read_pairs(pairs_path)
    if lidar is not None:
        if lidar not in known.mounts:
            raise CalibrationError(
                f"{camera_path} has no mount of {lidar!r}; it has those of "
                f"{', '.join(sorted(known.mounts)) or 'none'}. Give points in the ego frame, or add it."
            )
        pairs = Pairs(known.mounts[lidar].transform_from(pairs.points), pairs.uv, pairs.lines)
    found = estimate_extrinsics(pairs, camera, max_error_px=max_error_px, seed=seed)
    report = extrinsics_report(found, pairs)
    report["points_frame"] = "ego" if lidar is None else lidar
    _tell(report)
    with result_folder(out, COMMAND, overwrite) as folder:
        write_calibration(folder, known.with_camera(found.camera, is_mounted=True))
        _write_report(folder, report)
    return report


def make_check(
    drive_path: Path,
    out: Path,
    *,
    name: str | None = None,
    calibration: Path | None = None,
    index: int = 0,
    scene: str | None = None,
    layout: str = "auto",
    max_range_m: float = 60.0,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Draw the sweep nearest in time into an image of a drive.

    Args:
        drive_path: The drive.
        out: PNG to write.
        name: Camera; None for the first with images.
        calibration: Where to take the camera from instead of the drive.
        index: Which of that camera's images, from 0; negative counts from the last.
        scene: Which drive of a data root.
        layout: Of the drive, or ``auto``.
        max_range_m: Points further away are not drawn.
        overwrite: Whether an older picture may be replaced.

    Returns:
        What was drawn.

    Raises:
        HDMapError: If the drive has no such image, no sweep near it, or cannot be read.
    """
    drive = open_drive(drive_path, layout, scene, () if name is None else (name,))
    image = _chosen_image(drive, name, index)
    camera = drive.cameras[image.camera]
    if calibration is not None:
        camera = _mounted_camera(calibration, image.camera)
    points = _points_at(drive, image)
    overlay = overlay_points(read_image(image, camera), camera, points, max_range_m=max_range_m)
    write_png(overlay.picture, out, overwrite=overwrite)
    return _drawn(overlay, camera, str(image.path))


def make_check_of_files(
    image_path: Path,
    points_path: Path,
    out: Path,
    calibration: Path,
    *,
    name: str | None = None,
    max_range_m: float = 60.0,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Draw a point cloud in the ego frame into a picture, where there is no drive yet.

    Args:
        image_path: Picture of the camera's size.
        points_path: Point cloud (.pcd, .ply, .las, .laz), ego frame, metres.
        out: PNG to write.
        calibration: With the camera's intrinsics and mount.
        name: Which camera, where there are several.
        max_range_m: Points further away are not drawn.
        overwrite: Whether an older picture may be replaced.

    Returns:
        What was drawn.

    Raises:
        HDMapError: If one of them cannot be read, or the picture is of another size.
    """
    from hdmap_tools.point_map.point_files import read_point_file

    camera = _mounted_camera(calibration, name)
    rgb = read_image(ImageRef(camera.name, 0, image_path), camera)
    points = read_point_file(points_path).points
    overlay = overlay_points(rgb, camera, points, max_range_m=max_range_m)
    write_png(overlay.picture, out, overwrite=overwrite)
    return _drawn(overlay, camera, str(image_path))


def _chosen_image(drive: Drive, name: str | None, index: int) -> ImageRef:
    cameras = sorted({image.camera for image in drive.images})
    if not cameras:
        raise DriveError(f"Drive {drive.name} has no images to draw into.")
    chosen = cameras[0] if name is None else name
    images = [image for image in drive.images if image.camera == chosen]
    if not -len(images) <= index < len(images):
        raise DriveError(
            f"Drive {drive.name} has {len(images)} images of {chosen}; there is no image {index} (they "
            "count from 0)."
        )
    return images[index]


def _mounted_camera(path: Path, name: str | None) -> PinholeCamera:
    known = read_calibration(path)
    camera = known.camera(name, path)
    if camera.name not in known.mounts:
        raise CalibrationError(
            f"{path} says no mount of camera {camera.name}; find it with `hdmap calibrate extrinsics`."
        )
    return camera


def _points_at(drive: Drive, image: ImageRef) -> NDArrayFloat:
    """(N, 3) points of the nearest sweep, in the ego frame when the image was taken."""
    ref = drive.nearest_sweep(image.timestamp_ns, _MAX_SWEEP_GAP_S)
    if ref is None:
        raise DriveError(
            f"Drive {drive.name} has no sweep within {_MAX_SWEEP_GAP_S} s of {image.path}; choose another image."
        )
    sweep = drive.read_sweep(ref)
    city_SE3_then = drive.trajectory.interpolate(sweep.timestamp_ns)
    city_SE3_now = drive.trajectory.interpolate(image.timestamp_ns)
    return (city_SE3_now.inverse() @ city_SE3_then).transform_from(sweep.points_ego)


def _drawn(overlay: Overlay, camera: PinholeCamera, image: str) -> dict[str, Any]:
    if not overlay.num_drawn:
        logger.warning("no point of the sweep lies in the picture; is the mount right?")
    return {
        "camera": camera.name,
        "image": image,
        "num_points": overlay.num_points,
        "num_drawn": overlay.num_drawn,
    }


def _write_report(folder: Path, report: dict[str, Any]) -> None:
    text = json.dumps(report, indent=2, allow_nan=False)
    (folder / REPORT_FILE).write_text(text + "\n", encoding="utf-8")


def _tell(report: dict[str, Any]) -> None:
    for warning in report["warnings"]:
        logger.warning("%s", warning)
