"""A point map in a place of its own: whole or not there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hdmap_tools.config import Config
from hdmap_tools.errors import PointMapError
from hdmap_tools.opening import open_configured
from hdmap_tools.output_folder import result_folder
from hdmap_tools.point_map.build import Progress, build_point_map
from hdmap_tools.point_map.for_drive import posed_drives

COMMAND: Final = "points"
"""Under this name the output folder is marked."""


def make_points(
    sources: Sequence[Path],
    out: Path,
    config: Config,
    *,
    exports: Sequence[Path] = (),
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Make a point map from drives.

    Args:
        sources: Folders of drives.
        out: Folder to make.
        config: `points`, `drive` and the place on earth.
        exports: Files to write all points to.
        overwrite: Replace an earlier point map.
        progress: Told of sweeps done.

    Returns:
        Sources, points, tiles, seconds, and by drive whether its poses were refined.

    Raises:
        HDMapError: Whatever cannot be read, made or written; then nothing is left behind.
    """
    start = time.perf_counter()
    with result_folder(out, COMMAND, overwrite) as folder:
        drives = [open_configured(config, path) for path in sources]
        if len({drive.id for drive in drives}) < len(drives):
            raise PointMapError("Two of the drives have the same id; give each drive once.")
        made = build_point_map(
            posed_drives(drives, config),
            folder,
            config.points,
            max_pose_gap_s=config.drive.max_pose_gap_s,
            progress=progress,
        )
        return {
            "sources": [drive.id for drive in drives],
            "num_points": made.num_points,
            "num_tiles": len(made.tile_indices()),
            "refined_poses": {drive.id: drive.is_refined for drive in made.meta.drives},
            "seconds": round(time.perf_counter() - start, 3),
        }
