"""The point map that a drive is mapped with: opened, made on the way, or taken from a point cloud."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from hdmap_tools.config import Config
from hdmap_tools.point_map.build import Progress, build_point_map
from hdmap_tools.point_map.from_cloud import build_from_file
from hdmap_tools.point_map.point_files import is_point_file
from hdmap_tools.point_map.point_map import PointMap
from hdmap_tools.point_map.posed_drive import PosedDrive
from hdmap_tools.point_map.refine_config import RefineReport
from hdmap_tools.readers.drive import Drive

_LOG = logging.getLogger(__name__)


def with_points(
    config: Config, drive: Drive, scratch: Path, progress: Progress | None = None
) -> tuple[Config, Drive]:
    """The configuration with a point map to read, and the drive at the poses it stands on.

    Args:
        config: As asked for; unchanged where no method needs points and none were given.
        drive: The drive to be mapped.
        scratch: Folder for a point map that must be made first; need not exist. One that
            was made there before is taken.
        progress: Told of sweeps, if one is made.

    Raises:
        PointMapError: If the point map cannot be read or made, or lies elsewhere.
        CRSMismatchError: If its frame is another one than the drive's.
    """
    association = config.association
    if association.points is None and not association.needs_points:
        return config, drive
    path = association.points
    if path is None:
        _LOG.warning(
            "No point map given: making one for this run; keep one with `hdmap points %s -o POINTS` and "
            "give it with --points.",
            drive.root,
        )
        path = _whole(
            scratch / "points",
            lambda folder: build_point_map(
                [posed for posed, _ in posed_drives([drive], config, progress)],
                folder,
                config.points,
                max_pose_gap_s=config.drive.max_pose_gap_s,
                progress=progress,
            ),
        )
        point_map = PointMap.open(path)
    elif is_point_file(path):
        cloud = path
        path = _whole(
            scratch / "points",
            lambda folder: build_from_file(cloud, folder, config.points, drive.frame),
        )
        point_map = PointMap.open(path)
    else:
        point_map = PointMap.open(path)
    frame = point_map.meta.frame
    if frame.is_georeferenced and drive.frame.is_georeferenced:
        drive.frame.require_same(frame)
    elif frame.is_georeferenced or drive.frame.is_georeferenced:
        _LOG.info("Only one of drive and point map knows its place; both are taken in one frame.")
    point_map.require_overlap(
        drive.trajectory, drive.name, max(association.clip_ahead_m, association.clip_across_m)
    )
    trajectory = point_map.trajectory_of(drive.id)
    if trajectory is not None:
        drive = replace(drive, trajectory=trajectory)
    else:
        _LOG.info(
            "The point map has no poses of drive %s; the drive's own are taken in its frame.",
            drive.id,
        )
    association = association.model_copy(update={"points": path})
    return config.model_copy(update={"association": association}), drive


def _whole(path: Path, make: Callable[[Path], object]) -> Path:
    """A folder that is made under another name and renamed: whole where it is there."""
    if not path.is_dir():
        partial = path.with_name(f"{path.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        make(partial)
        partial.rename(path)
    return path


def posed_drives(
    drives: Sequence[Drive], config: Config, progress: Progress | None = None
) -> list[tuple[PosedDrive, RefineReport | None]]:
    """Drives at refined poses, where `points.refine_poses` says so and registration found hold.

    Returns:
        For each drive its poses, and what refinement did; None where it was not asked for.
    """
    if not config.points.refine_poses:
        return [(PosedDrive.as_given(drive), None) for drive in drives]
    from hdmap_tools.point_map.refine_poses import refine_poses

    return [
        (PosedDrive(drive, refined.trajectory, refined.is_changed), refined.report)
        for drive, refined in zip(drives, refine_poses(drives, progress=progress), strict=True)
    ]
