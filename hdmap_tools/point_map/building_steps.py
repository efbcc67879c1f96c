"""The steps of building a point map: each takes a run of sweeps or a tile, and leaves files.

Sums of a run of sweeps by voxel; all sums of a tile together; what a run saw through; the
finished tile. What a step does follows from its arguments and the files that it names alone,
so any process may do it, in any order, and once more if it died on the way: it writes into
a folder of its own, which nobody reads before it is done.

All that is added up are whole numbers: into how many runs the sweeps are cut, and in which
order, changes nothing.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

import numpy as np

from hdmap_tools.ahead import made_ahead
from hdmap_tools.association.visibility import ring_gap_deg
from hdmap_tools.config import PointsConfig
from hdmap_tools.point_map.ground_cells import smooth_ground
from hdmap_tools.point_map.normalize import IntensityResponse, IntensityStatistics
from hdmap_tools.point_map.point_map import (
    TILE_MM,
    PointTile,
    TileIndex,
    TileOfPoints,
    write_tile,
)
from hdmap_tools.point_map.posed_drive import PosedDrive, sweep_in_city
from hdmap_tools.readers.drive import SweepRef
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt

if TYPE_CHECKING:
    from hdmap_tools.point_map.range_image import RangeImage
    from hdmap_tools.point_map.thinning import VoxelGrid, VoxelReturns, Voxels

_ASPHALT_FROM_PATH_M: Final = 2.5
"""Ground this near to the driven path is taken for road."""
_SWEEPS_FOR_LIDAR: Final = 5

_Item = TypeVar("_Item")
_Made = TypeVar("_Made")


Files = dict[TileIndex, tuple[Path, ...]]
"""What was put aside of each tile."""


@dataclass(frozen=True)
class Run:
    """Some sweeps of a drive.

    Attributes:
        drive: Number of the drive.
        numbers: Of its usable sweeps.
    """

    drive: int
    numbers: range


@dataclass(frozen=True, eq=False)
class Site:
    """Where steps find what they work on; each process has its own, which says the same.

    Attributes:
        drives: At the poses that count.
        usable: For each drive the numbers of its sweeps that have a pose.
        config: How the map is made.
        aside: Folder for what is put aside, the same for all processes.
        threads: That read ahead in one step; 0: none.
        told: Called after each sweep of a pass.
    """

    drives: tuple[PosedDrive, ...]
    usable: tuple[NDArrayInt, ...]
    config: PointsConfig
    aside: Path
    threads: int = 0
    told: Callable[[], object] = field(default=lambda: None, repr=False)

    @property
    def grid(self) -> VoxelGrid:
        """Voxels of the map."""
        from hdmap_tools.point_map.thinning import VoxelGrid

        return VoxelGrid(self.config.voxel_mm, self.config.cell_mm)

    def refs(self, run: Run) -> list[SweepRef]:
        """The sweeps of a run."""
        numbers = self.usable[run.drive][run.numbers.start : run.numbers.stop : run.numbers.step]
        return [self.drives[run.drive].drive.sweeps[number] for number in numbers]

    def ahead(self, make: Callable[[_Item], _Made], items: Iterable[_Item]) -> Iterator[_Made]:
        """What `make` gives for each item, in order, in threads if there are any to spare."""
        return made_ahead(items, make, threads=self.threads) if self.threads else map(make, items)

    def new_folder(self) -> Path:
        """A folder for what one step writes."""
        return Path(tempfile.mkdtemp(prefix="step.", dir=self.aside))

    def voxels_of(self, index: TileIndex) -> Path:
        """File with all sums of a tile, once `sum_tile` has made it."""
        return self.aside / f"voxels_{index[0]}_{index[1]}.npy"

    def blocks_of(self, index: TileIndex) -> Path:
        """File with the tile's blocks."""
        return self.aside / f"blocks_{index[0]}_{index[1]}.npz"


class Crew(Protocol):
    """Who does the steps of one build."""

    def runs(self, drive: int, number: int) -> list[Run]:
        """The sweeps of a drive, `number` of them, cut into runs."""

    def over_runs(
        self, step: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
    ) -> Iterator[_Made]:
        """What ``step(site, *item)`` gives for each item, as they get done."""

    def over_tiles(
        self, step: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
    ) -> Iterator[_Made]:
        """The same, where an item is a tile."""


@dataclass(frozen=True)
class Alone:
    """All steps in this process, a drive in one run.

    Attributes:
        site: Where.
    """

    site: Site

    def runs(self, drive: int, number: int) -> list[Run]:
        """One."""
        return [Run(drive, range(number))]

    def over_runs(
        self, step: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
    ) -> Iterator[_Made]:
        """One after the other: each reads ahead."""
        return (step(self.site, *item) for item in items)

    def over_tiles(
        self, step: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
    ) -> Iterator[_Made]:
        """In threads."""
        return self.site.ahead(lambda item: step(self.site, *item), items)


@dataclass(frozen=True, eq=False)
class Lidar:
    """Where a drive's lidar sits, (3,) in the ego frame, metres, and the angle between its rings."""

    position_ego: NDArrayFloat
    gap_deg: float


@dataclass(frozen=True)
class SummedRun:
    """What `sum_returns` left.

    Attributes:
        num_ground: Returns from the ground.
        files: Of each tile, for `sum_tile`.
    """

    num_ground: int
    files: Files


def lidar_of(site: Site, drive: int) -> tuple[int, Lidar]:
    """A drive's number and its lidar, from some of its sweeps."""
    from hdmap_tools.point_map.moving import estimate_lidar_position

    number = len(site.usable[drive])
    run = Run(drive, range(0, number, -(-number // _SWEEPS_FOR_LIDAR)))
    some = [site.drives[drive].drive.read_sweep(ref) for ref in site.refs(run)]
    gaps = [ring_gap_deg(sweep.points_ego, sweep.ring) for sweep in some]
    return drive, Lidar(estimate_lidar_position(some), float(np.median(gaps)))


def asphalt_of(site: Site, run: Run) -> tuple[int, tuple[NDArrayInt, NDArrayInt]]:
    """The drive of a run, and how what is likely asphalt returned there, `IntensityStatistics.found`."""
    posed = site.drives[run.drive]

    def seen_on_asphalt(
        ref: SweepRef,
    ) -> tuple[NDArrayByte, NDArrayByte, NDArrayFloat, NDArrayBool]:
        seen = sweep_in_city(posed, ref, site.config)
        ground = np.flatnonzero(seen.is_ground)
        away, _ = posed.path.query(
            seen.points_city[ground, :2], distance_upper_bound=_ASPHALT_FROM_PATH_M
        )
        sweep = seen.sweep
        return (
            sweep.intensity[ground],
            sweep.ring[ground],
            seen.distance_m[ground],
            np.isfinite(away),
        )

    statistics = IntensityStatistics()
    for asphalt in site.ahead(seen_on_asphalt, site.refs(run)):
        statistics.add(*asphalt)
    return run.drive, statistics.found()


def sum_returns(site: Site, run: Run, response: IntensityResponse | None) -> SummedRun:
    """Sum the returns of a run by voxel."""
    from hdmap_tools.point_map.thinning import VoxelReturns, VoxelTiles

    posed, grid = site.drives[run.drive], site.grid

    def returns_of(ref: SweepRef) -> tuple[VoxelReturns, NDArrayFloat, int]:
        """A sweep's returns by voxel, where it was seen from, and how many of them are ground."""
        seen = sweep_in_city(posed, ref, site.config)
        intensity = seen.sweep.intensity
        if response is not None:
            intensity = response.normalized(intensity, seen.sweep.ring, seen.distance_m)
        returns = VoxelReturns.of(seen.points_city, intensity, seen.is_ground, seen.range_m, grid)
        return returns, seen.city_SE3_ego.translation, int(seen.is_ground.sum())

    tiles, num_ground = VoxelTiles(grid, site.new_folder()), 0
    try:
        for returns, xyz, num_on_ground in site.ahead(returns_of, site.refs(run)):
            tiles.add_returns(returns)
            tiles.put_aside(xyz, site.config.max_range_m)
            num_ground += num_on_ground
            site.told()
        return SummedRun(num_ground, tiles.finish())
    finally:
        tiles.close()


def sum_tile(site: Site, index: TileIndex, files: tuple[Path, ...]) -> None:
    """Bring the sums of a tile together, and find its blocks if they are to be seen through."""
    from hdmap_tools.point_map.moving import Blocks
    from hdmap_tools.point_map.thinning import read_voxels, write_voxels

    # A renamed file is whole. One that is there was made by an attempt that died later.
    whole, blocks = site.voxels_of(index), site.blocks_of(index)
    if not whole.exists():
        made = files[0]
        if len(files) > 1:
            made = site.new_folder() / whole.name
            write_voxels(made, read_voxels(files))
        os.replace(made, whole)
    for path in files:
        path.unlink(missing_ok=True)
    if site.config.remove_moving:
        made = site.new_folder() / blocks.name
        Blocks.of(read_voxels([whole]), site.grid).write(made)
        os.replace(made, blocks)


def look_through(site: Site, run: Run, lidar: Lidar) -> Files:
    """Count what the sweeps of a run saw through, by tile."""
    from hdmap_tools.point_map.moving import Blocks, SeenThrough
    from hdmap_tools.point_map.range_image import RangeImage

    posed = site.drives[run.drive]

    def image_of(ref: SweepRef) -> RangeImage:
        sweep = posed.drive.read_sweep(ref)
        pose = posed.trajectory.interpolate(sweep.timestamp_ns, np.inf)
        return RangeImage.of(sweep, pose, lidar.position_ego)

    def centres_of(index: TileIndex) -> Any:
        path = site.blocks_of(index)
        return Blocks.read_centres(path) if path.exists() else None

    seen_through = SeenThrough(centres_of, site.new_folder())
    for image in site.ahead(image_of, site.refs(run)):
        seen_through.look(image, lidar.gap_deg)
        site.told()
    return {index: (path,) for index, path in seen_through.finish().items()}


def finish_tile(
    site: Site, index: TileIndex, seen: tuple[Path, ...], folder: Path
) -> TileOfPoints | None:
    """Write a tile of the point map at a folder, from what was put aside of it.

    Args:
        site: Where.
        index: Of the tile, which `sum_tile` has brought together.
        seen: Its files of `look_through`.
        folder: Of the map.
    """
    from hdmap_tools.point_map.moving import Blocks, is_moving
    from hdmap_tools.point_map.thinning import read_voxels

    voxels = read_voxels([site.voxels_of(index)])
    moving = is_moving(voxels, Blocks.read(site.blocks_of(index)), seen) if seen else None
    made = site.new_folder()
    written = write_tile(made, index, made_tile(voxels, site.grid, moving))
    for path in made.glob("*/*"):
        os.replace(path, folder / path.relative_to(made))
    return written


def made_tile(voxels: Voxels, grid: VoxelGrid, left_out: NDArrayBool | None = None) -> PointTile:
    """The points of a tile and its ground, from the sums of its voxels, but for those left out (N,)."""
    from hdmap_tools.point_map.tile_kernels import thinned_points

    if left_out is None:
        left_out = np.zeros(len(voxels), dtype=bool)
    points = thinned_points(voxels.key, voxels.sums, left_out, grid.voxel_mm)
    ground = smooth_ground(
        points.ground_mm, points.ground_weight, points.ground_cell, (TILE_MM // grid.cell_mm) ** 2
    )
    points.columns_mm[2, points.is_ground] = np.rint(ground.height_mm)
    return PointTile(
        points.columns_mm.T,
        points.intensity,
        points.hits,
        points.is_ground,
        points.cell,
        ground.cells.astype(np.uint16),
        np.rint(ground.cell_height_mm).astype(np.int32),
        np.rint(ground.roughness_mm).astype(np.int32),
        ground.cell_points.astype(np.int32),
    )
