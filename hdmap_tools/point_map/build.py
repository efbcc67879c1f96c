"""Build a point map from drives: sweeps at their poses, thinned, with the ground found.

Two passes over the sweeps, tile by tile, so that memory does not grow with the drive:
the first sums returns by voxel, the second looks for voxels that later or earlier
sweeps saw through. Here is the order of steps; who does them is the crew's matter.
"""

from __future__ import annotations

import logging
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.config import PointsConfig
from hdmap_tools.errors import PointMapError
from hdmap_tools.point_map.building_steps import (
    Alone,
    Crew,
    Files,
    Run,
    Site,
    asphalt_of,
    finish_tile,
    lidar_of,
    look_through,
    sum_returns,
    sum_tile,
)
from hdmap_tools.point_map.normalize import IntensityResponse, IntensityStatistics
from hdmap_tools.point_map.point_map import DriveOfPoints, PointMap, PointMapMeta
from hdmap_tools.point_map.posed_drive import PosedDrive

_LOG = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
"""Told how many sweeps of how many are done."""

_SWEEPS_FOR_INTENSITY: Final = 60
_READERS: Final = 2
"""Threads that read sweeps and find their ground, while another adds them up."""


def build_point_map(
    drives: Sequence[PosedDrive],
    folder: Path,
    config: PointsConfig,
    *,
    max_pose_gap_s: float = 0.5,
    progress: Progress | None = None,
    crew_at: Callable[[Site], Crew] = Alone,
) -> PointMap:
    """Build a point map into an empty folder.

    Args:
        drives: Drives of one city frame.
        folder: Where the map shall be.
        config: Voxels, range, what is removed and normalized.
        max_pose_gap_s: Sweeps in a longer gap between poses are left out.
        progress: Told of sweeps done.
        crew_at: Gives who does the steps; the map is the same, whoever does.

    Raises:
        PointMapError: If no drive has a sweep with a pose, or no ground is found.
        CRSMismatchError: If the drives have different frames.
    """
    if not drives:
        raise PointMapError("A point map needs at least one drive, found none.")
    for posed in drives[1:]:
        drives[0].drive.frame.require_same(posed.drive.frame)
    usable = tuple(posed.usable_sweeps(max_pose_gap_s) for posed in drives)
    names = [posed.drive.id for posed in drives]
    if len(set(names)) < len(names):
        raise PointMapError("Two of the drives have the same id; give each drive once.")
    told = _Counter(progress, (2 if config.remove_moving else 1) * sum(map(len, usable)))
    folder = folder.absolute()
    with _put_aside(folder.parent) as aside:
        site = Site(tuple(drives), usable, config, aside, _READERS, told.one_more)
        crew = crew_at(site)
        runs = [run for k, numbers in enumerate(usable) for run in crew.runs(k, len(numbers))]
        responses, asphalt = _intensity_responses(crew, site)
        num_ground = 0
        files: Files = {}
        for summed in crew.over_runs(sum_returns, [(run, responses[run.drive]) for run in runs]):
            num_ground += summed.num_ground
            _add_files(files, summed.files)
        if num_ground == 0:
            raise PointMapError(
                f"No ground in any sweep of {', '.join(names)}: expected returns from the road around the "
                "vehicle, within 1 m of the height of the ego origin. Check the mount of the lidar."
            )
        for _ in crew.over_tiles(sum_tile, sorted(files.items())):
            pass
        seen: Files = {}
        if config.remove_moving:
            lidars = dict(crew.over_runs(lidar_of, [(k,) for k in range(len(drives))]))
            looked = crew.over_runs(look_through, [(run, lidars[run.drive]) for run in runs])
            for found in looked:
                _add_files(seen, found)
        for name in ("tiles", "cells"):
            (folder / name).mkdir()
        finished = crew.over_tiles(
            finish_tile, ((index, seen.get(index, ()), folder) for index in sorted(files))
        )
        meta = PointMapMeta(
            cell_mm=config.cell_mm,
            voxel_mm=config.voxel_mm,
            frame_document=drives[0].drive.frame.to_json(),
            asphalt_intensity=None if asphalt is None else round(asphalt, 3),
            drives=tuple(
                DriveOfPoints(
                    id=posed.drive.id,
                    poses=f"{number}_{re.sub('[^A-Za-z0-9.-]+', '_', posed.drive.id)[:80]}.feather",
                    is_refined=posed.is_refined,
                    num_sweeps=len(usable[number]),
                )
                for number, posed in enumerate(drives)
            ),
        )
        trajectories = {posed.drive.id: posed.trajectory for posed in drives}
        return PointMap.created(folder, meta, finished, trajectories)


@contextmanager
def _put_aside(parent: Path) -> Iterator[Path]:
    """A folder for what is put aside, gone with the block.

    It gets another name first: a worker that has not heard that the build failed finds it
    gone, and cannot add to what is being deleted.
    """
    aside = Path(tempfile.mkdtemp(prefix=".aside.", dir=parent))
    try:
        yield aside
    finally:
        gone = aside.rename(aside.with_name(f"{aside.name}.gone"))
        shutil.rmtree(gone, ignore_errors=True)


def _add_files(files: Files, more: Files) -> None:
    for index, paths in more.items():
        files[index] = (*files.get(index, ()), *paths)


def _intensity_responses(
    crew: Crew, site: Site
) -> tuple[list[IntensityResponse | None], float | None]:
    """How each drive's lidar answers, brought to the level of all drives; and that level."""
    if not site.config.normalize_intensity:
        return [None] * len(site.drives), None
    some = []
    for drive, usable in enumerate(site.usable):
        numbers = range(len(usable))[:: -(-len(usable) // _SWEEPS_FOR_INTENSITY)]
        for part in crew.runs(drive, len(numbers)):
            some.append((Run(drive, numbers[part.numbers.start : part.numbers.stop]),))
    statistics = [IntensityStatistics() for _ in site.drives]
    for drive, found in crew.over_runs(asphalt_of, some):
        statistics[drive].add_found(*found)
    responses = [each.response() for each in statistics]
    for posed, response in zip(site.drives, responses, strict=True):
        if response is None:
            _LOG.warning(
                "%s: too little road near the driven path to normalize lidar intensity; it stays as it is.",
                posed.drive.name,
            )
    levels = [response.asphalt for response in responses if response is not None]
    if not levels:
        return responses, None
    asphalt = float(np.mean(levels))
    return [r if r is None else replace(r, asphalt=asphalt) for r in responses], asphalt


class _Counter:
    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def one_more(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total)
