"""A point map built on the workers of a Dask cluster: of this machine or of many.

Runs of sweeps are the tasks of both passes, tiles those between and after. What tasks
leave for one another lies in files beside the map to be, and they hand back the names
alone: neither the workers' memory nor that of this process grows with the drive, and a task
whose worker died is done again from files that are still there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from hdmap_tools.config import Config
from hdmap_tools.distributed.cluster import (
    as_they_get_done,
    deaths_explained,
    listening,
    num_threads,
    teller,
)
from hdmap_tools.errors import ClusterError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.opening import open_configured
from hdmap_tools.point_map.building_steps import Crew, Run, Site
from hdmap_tools.point_map.posed_drive import PosedDrive

if TYPE_CHECKING:
    from distributed import Client

_Made = TypeVar("_Made")

_RUNS_A_THREAD: Final = 4
"""Of a drive, so that none waits long for the last one."""
_MOST_SWEEPS: Final = 100
"""Of a run: what is lost at most with a worker."""
_POSES: Final = "poses.npz"


@dataclass(frozen=True)
class PointsTask:
    """What a worker needs to do steps of a build: small, and the same on each machine.

    Attributes:
        drive_paths: Folders of the drives, where every worker finds them.
        config: Which part of the drives is used and how (a JSON document).
        aside: Folder that all processes share.
        teller: Under which name progress is told.
    """

    drive_paths: tuple[Path, ...]
    config: str
    aside: Path
    teller: str


@contextmanager
def spread_over(
    client: Client, drive_paths: Iterable[Path], config: Config
) -> Iterator[Callable[[Site], Crew]]:
    """Give what makes the crew of a build, while it lasts.

    Args:
        client: Of the cluster.
        drive_paths: The drives, in the order in which the build has them.
        config: Of which `drive` and `points` are used.

    Raises:
        ClusterError: If workers died again and again, or find other files than this process.
        HDMapError: Whatever a worker raised.
    """
    settled = Config(drive=config.drive, points=config.points).model_dump_json()
    paths = tuple(path.absolute() for path in drive_paths)
    sites: list[Site] = []

    def crew_at(site: Site, name: str) -> Crew:
        sites.append(site)
        _write_poses(site)
        return _Spread(client, PointsTask(paths, settled, site.aside, name))

    def hear() -> None:
        for site in sites:
            site.told()

    with deaths_explained("Nothing was written."), listening(client, hear) as name:
        yield partial(crew_at, name=name)


@dataclass(frozen=True)
class _Spread:
    """All steps on workers.

    Attributes:
        client: Of the cluster.
        task: What they work on.
    """

    client: Client
    task: PointsTask

    def runs(self, drive: int, number: int) -> list[Run]:
        size = min(-(-number // (_RUNS_A_THREAD * num_threads(self.client))), _MOST_SWEEPS)
        return [
            Run(drive, range(start, min(start + size, number))) for start in range(0, number, size)
        ]

    def over_runs(
        self, step: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
    ) -> Iterator[_Made]:
        return self._each(step, items)

    def over_tiles(
        self, step: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
    ) -> Iterator[_Made]:
        return self._each(step, items)

    def _each(
        self, step: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
    ) -> Iterator[_Made]:
        given = ((self.task, step, item) for item in items)
        return as_they_get_done(self.client, _do, given)


def _do(task: PointsTask, step: Callable[..., _Made], item: tuple[Any, ...]) -> _Made:
    return step(_site_of(task), *item)


@lru_cache(maxsize=1)
def _site_of(task: PointsTask) -> Site:
    """What a worker finds; kept, for it does many steps of one build.

    Raises:
        ClusterError: If it is not what the process that began the build has found.
    """
    for path in (*task.drive_paths, task.aside / _POSES):
        if not path.exists():
            raise ClusterError(f"A worker does not find {path}. {_SHARED}")
    config = Config.model_validate_json(task.config)
    drives, usable = [], []
    with np.load(task.aside / _POSES) as stored:
        for k, path in enumerate(task.drive_paths):
            drive = open_configured(config, path)
            if len(drive.sweeps) != stored[f"sweeps_{k}"]:
                raise ClusterError(
                    f"A worker finds {len(drive.sweeps)} sweeps in {path}, expected "
                    f"{stored[f'sweeps_{k}']}. {_SHARED}"
                )
            poses = (stored[f"{name}_{k}"] for name in ("times", "rotations", "translations"))
            drives.append(PosedDrive(drive, Trajectory(*poses)))
            usable.append(stored[f"usable_{k}"])
    # A worker is given one core: nothing is read ahead.
    return Site(tuple(drives), tuple(usable), config.points, task.aside, told=teller(task.teller))


_SHARED: Final = (
    "All workers must see the drives and the folder of the point map, under the same paths as "
    "here: a file system that they share."
)


def _write_poses(site: Site) -> None:
    """Put the poses aside, as they are: refined ones stand in no drive."""
    document: dict[str, Any] = {}
    for k, (posed, usable) in enumerate(zip(site.drives, site.usable, strict=True)):
        document |= {
            f"times_{k}": posed.trajectory.timestamps_ns,
            f"rotations_{k}": posed.trajectory.rotations,
            f"translations_{k}": posed.trajectory.translations,
            f"usable_{k}": usable,
            f"sweeps_{k}": np.int64(len(posed.drive.sweeps)),
        }
    np.savez(site.aside / _POSES, **document)
