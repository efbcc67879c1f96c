"""A point map in a place of its own: whole or not there."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from hdmap_tools.config import Config
from hdmap_tools.distributed.cluster import Workers, connected
from hdmap_tools.distributed.points import spread_over
from hdmap_tools.errors import ConfigError, PointMapError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.opening import open_configured
from hdmap_tools.output_folder import result_folder
from hdmap_tools.point_map.build import Progress, build_point_map
from hdmap_tools.point_map.building_steps import Alone, Crew, Site
from hdmap_tools.point_map.for_drive import posed_drives
from hdmap_tools.point_map.from_cloud import build_from_file
from hdmap_tools.point_map.point_files import check_writable, is_point_file, write_point_file
from hdmap_tools.readers.drive import Drive

COMMAND: Final = "points"
"""Under this name the output folder is marked."""


def make_points(
    sources: Sequence[Path],
    out: Path,
    config: Config,
    *,
    exports: Sequence[Path] = (),
    overwrite: bool = False,
    workers: Workers | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Make a point map from drives.

    Args:
        sources: Folders of drives, or one point cloud.
        out: Folder to make.
        config: `points`, `drive` and the place on earth.
        exports: Files to write all points to.
        overwrite: Replace an earlier point map.
        workers: Processes to spread it over; None: all is done in this one. Poses are
            refined in this one in any case.
        progress: Told of sweeps done.

    Returns:
        Sources, points, tiles, seconds, and by drive whether its poses were refined, and what
        refinement did (`RefineReport`), if it was asked for.

    Raises:
        HDMapError: Whatever cannot be read, made or written; then nothing is left behind.
    """
    start = time.perf_counter()
    for path in exports:
        check_writable(path, overwrite)
    files = [path for path in sources if is_point_file(path)]
    if files and workers is not None:
        raise PointMapError(
            f"A point cloud ({files[0].name}) is taken by one process; leave --workers and --scheduler out."
        )
    with result_folder(out, COMMAND, overwrite) as folder, ExitStack() as stack:
        if files:
            if len(sources) > 1:
                raise PointMapError(
                    f"A point cloud ({files[0].name}) is taken alone; found {len(sources)} sources."
                )
            frame = MapFrame() if config.export.origin is None else _frame_at(config)
            names, reports = [files[0].name], {}
            made = build_from_file(files[0], folder, config.points, frame)
        else:
            drives = [open_configured(config, path) for path in sources]
            drives = [_placed(drive, config) for drive in drives]
            if len({drive.id for drive in drives}) < len(drives):
                raise PointMapError("Two of the drives have the same id; give each drive once.")
            names = [drive.id for drive in drives]
            posed = posed_drives(drives, config, progress)
            reports = {p.drive.id: report.model_dump() for p, report in posed if report}
            crew_at: Callable[[Site], Crew] = Alone
            if workers is not None:
                client = stack.enter_context(connected(workers))
                crew_at = stack.enter_context(spread_over(client, sources, config))
            made = build_point_map(
                [p for p, _ in posed],
                folder,
                config.points,
                max_pose_gap_s=config.drive.max_pose_gap_s,
                progress=progress,
                crew_at=crew_at,
            )
            stack.close()
        for path in exports:
            parts = (made.read_tile(index).to_points(index) for index in made.tile_indices())
            write_point_file(path, parts, made.meta.frame, overwrite)
        return {
            "sources": names,
            "num_points": made.num_points,
            "num_tiles": len(made.tile_indices()),
            "refined_poses": {drive.id: drive.is_refined for drive in made.meta.drives},
            "refinement": reports,
            "seconds": round(time.perf_counter() - start, 3),
        }


def _frame_at(config: Config) -> MapFrame:
    assert config.export.origin is not None
    return MapFrame.from_origin(*config.export.origin)


def _placed(drive: Drive, config: Config) -> Drive:
    """The drive with the origin given, if it does not know its own.

    Raises:
        ConfigError: If it does.
    """
    if config.export.origin is None:
        return drive
    if drive.frame.is_georeferenced:
        raise ConfigError(
            f"Drive {drive.name} knows its place on earth ({drive.frame.describe()}); leave --origin out."
        )
    return replace(drive, frame=_frame_at(config))
