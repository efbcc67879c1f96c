"""Build a point map from drives: sweeps at their poses, thinned, with the ground found.

Two passes over the sweeps, tile by tile, so that memory does not grow with the drive:
the first sums returns by voxel, the second looks for voxels that later or earlier
sweeps saw through.
"""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.spatial import cKDTree

from hdmap_tools.ahead import made_ahead
from hdmap_tools.association.ground import estimate_ground
from hdmap_tools.association.visibility import ring_gap_deg
from hdmap_tools.config import PointsConfig
from hdmap_tools.errors import PointMapError
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.point_map.ground_cells import smooth_ground
from hdmap_tools.point_map.normalize import IntensityResponse, IntensityStatistics
from hdmap_tools.point_map.point_map import (
    DriveOfPoints,
    PointMap,
    PointMapMeta,
    PointTile,
    TileIndex,
)
from hdmap_tools.readers.drive import Drive, Sweep, SweepRef
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat

if TYPE_CHECKING:
    from hdmap_tools.point_map.moving import RangeImage, SeenThrough
    from hdmap_tools.point_map.thinning import VoxelGrid, VoxelReturns, Voxels, VoxelTiles

_LOG = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
"""Told how many sweeps of how many are done."""

_SWEEPS_FOR_INTENSITY: Final = 60
_SWEEPS_FOR_LIDAR: Final = 5
_READERS: Final = 2
"""Threads that read sweeps and find their ground, while another adds them up."""
_ASPHALT_FROM_PATH_M: Final = 2.5
"""Ground this near to the driven path is taken for road."""
_PATH_STEP_M: Final = 0.25


@dataclass(frozen=True, eq=False)
class PosedDrive:
    """A drive with the poses that its sweeps are put at.

    Attributes:
        drive: Where the sweeps come from.
        trajectory: ``city_SE3_ego``: the drive's own, or refined.
        is_refined: Which of the two.
    """

    drive: Drive
    trajectory: Trajectory
    is_refined: bool = False

    @classmethod
    def as_given(cls, drive: Drive) -> PosedDrive:
        """With the drive's own poses."""
        return cls(drive, drive.trajectory)


@dataclass(frozen=True, eq=False)
class SweepInCity:
    """One sweep at its pose: returns within range, and which are ground.

    Attributes:
        sweep: Only returns within range.
        city_SE3_ego: Pose.
        points_city: (N, 3) metres.
        range_m: (N,) from the ego origin in x-y.
        is_ground: (N,).
    """

    sweep: Sweep
    city_SE3_ego: SE3
    points_city: NDArrayFloat
    range_m: NDArrayFloat
    is_ground: NDArrayBool

    @property
    def distance_m(self) -> NDArrayFloat:
        """(N,) from the ego origin in space."""
        return np.hypot(self.range_m, self.sweep.points_ego[:, 2])


def build_point_map(
    drives: Sequence[PosedDrive],
    folder: Path,
    config: PointsConfig,
    *,
    max_pose_gap_s: float = 0.5,
    progress: Progress | None = None,
) -> PointMap:
    """Build a point map into an empty folder.

    Args:
        drives: Drives of one city frame.
        folder: Where the map shall be.
        config: Voxels, range, what is removed and normalized.
        max_pose_gap_s: Sweeps in a longer gap between poses are left out.
        progress: Told of sweeps done.

    Raises:
        PointMapError: If no drive has a sweep with a pose, or no ground is found.
        CRSMismatchError: If the drives have different frames.
    """
    from hdmap_tools.point_map.moving import SeenThrough
    from hdmap_tools.point_map.thinning import VoxelGrid, VoxelTiles

    if not drives:
        raise PointMapError("A point map needs at least one drive, found none.")
    for posed in drives[1:]:
        drives[0].drive.frame.require_same(posed.drive.frame)
    usable = {posed.drive.id: _usable_sweeps(posed, max_pose_gap_s) for posed in drives}
    if len(usable) < len(drives):
        raise PointMapError("Two of the drives have the same id; give each drive once.")
    passes = 2 if config.remove_moving else 1
    told = _Counter(progress, passes * sum(map(len, usable.values())))
    responses = {
        posed.drive.id: _intensity_response(posed, usable[posed.drive.id], config)
        for posed in drives
    }
    levels = [r.asphalt for r in responses.values() if r is not None]
    asphalt = float(np.mean(levels)) if levels else None
    with tempfile.TemporaryDirectory(prefix=".aside.", dir=folder.parent) as aside:
        grid = VoxelGrid(config.voxel_mm, config.cell_mm)
        tiles = VoxelTiles(grid, Path(aside))
        num_ground = 0
        for posed in drives:
            response = responses[posed.drive.id]
            if response is not None and asphalt is not None:
                response = replace(response, asphalt=asphalt)  # the level of all drives
            read = partial(_returns_of, posed, response=response, grid=grid, config=config)
            for returns, xyz, num_on_ground in made_ahead(
                usable[posed.drive.id], read, threads=_READERS
            ):
                tiles.add_returns(returns)
                tiles.put_aside(xyz, config.max_range_m)
                num_ground += num_on_ground
                told.one_more()
        tiles.finish()
        if num_ground == 0:
            raise PointMapError(
                f"No ground in any sweep of {', '.join(usable)}: expected returns from the road around the "
                "vehicle, within 1 m of the height of the ego origin. Check the mount of the lidar."
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
                    num_sweeps=len(usable[posed.drive.id]),
                )
                for number, posed in enumerate(drives)
            ),
        )
        seen_through = None
        if config.remove_moving:
            seen_through = SeenThrough(tiles, Path(aside))
            for posed in drives:
                refs = usable[posed.drive.id]
                lidar_ego, gap_deg = _lidar(posed, refs)
                look = partial(_range_image_of, posed, lidar_ego)
                for image in made_ahead(refs, look, threads=_READERS):
                    seen_through.look(image, gap_deg)
                    told.one_more()
            seen_through.finish()
        trajectories = {posed.drive.id: posed.trajectory for posed in drives}
        return PointMap.create(folder, meta, _made_tiles(tiles, seen_through), trajectories)


def sweep_in_city(posed: PosedDrive, ref: SweepRef, config: PointsConfig) -> SweepInCity:
    """Read one sweep and put it where it was seen."""
    from hdmap_tools.point_map.sweep_kernels import placed_within

    whole = posed.drive.read_sweep(ref)
    city_SE3_ego = posed.trajectory.interpolate(whole.timestamp_ns, np.inf)
    near, points_ego, points_city, range_m = placed_within(
        whole.points_ego,
        city_SE3_ego.rotation,
        city_SE3_ego.translation,
        config.min_range_m,
        config.max_range_m,
    )
    sweep = Sweep(whole.timestamp_ns, points_ego, whole.intensity[near], whole.ring[near])
    surface = estimate_ground(points_ego, config.max_range_m)
    is_ground = surface.is_near(points_ego, config.ground_tolerance_m)
    return SweepInCity(sweep, city_SE3_ego, points_city, range_m, is_ground)


def _returns_of(
    posed: PosedDrive,
    ref: SweepRef,
    *,
    response: IntensityResponse | None,
    grid: VoxelGrid,
    config: PointsConfig,
) -> tuple[VoxelReturns, NDArrayFloat, int]:
    """A sweep's returns by voxel, where it was seen from, and how many of them are ground."""
    from hdmap_tools.point_map.thinning import VoxelReturns

    seen = sweep_in_city(posed, ref, config)
    intensity = seen.sweep.intensity
    if response is not None:
        intensity = response.normalized(intensity, seen.sweep.ring, seen.distance_m)
    returns = VoxelReturns.of(seen.points_city, intensity, seen.is_ground, seen.range_m, grid)
    return returns, seen.city_SE3_ego.translation, int(seen.is_ground.sum())


def _range_image_of(posed: PosedDrive, lidar_ego: NDArrayFloat, ref: SweepRef) -> RangeImage:
    from hdmap_tools.point_map.moving import RangeImage

    sweep = posed.drive.read_sweep(ref)
    pose = posed.trajectory.interpolate(sweep.timestamp_ns, np.inf)
    return RangeImage.of(sweep, pose, lidar_ego)


def _usable_sweeps(posed: PosedDrive, max_pose_gap_s: float) -> tuple[SweepRef, ...]:
    """Sweeps with a pose; how many have none is said.

    Raises:
        PointMapError: If there is none.
    """
    drive = posed.drive
    times = np.array([ref.timestamp_ns for ref in drive.sweeps], dtype=np.int64)
    covered = posed.trajectory.covers(times, max_pose_gap_s)
    usable = tuple(ref for ref, ok in zip(drive.sweeps, covered, strict=True) if ok)
    if not usable:
        first, last = posed.trajectory.timestamps_ns[[0, -1]]
        raise PointMapError(
            f"Drive {drive.name} has no lidar sweep with a pose: {len(drive.sweeps)} sweeps, poses from "
            f"{first} to {last} ns with gaps of at most {max_pose_gap_s} s allowed. A point map needs lidar."
        )
    if len(usable) < len(drive.sweeps):
        _LOG.warning(
            "%s: %d of %d sweeps left out: no ego pose.",
            drive.name,
            len(drive.sweeps) - len(usable),
            len(drive.sweeps),
        )
    return usable


def _intensity_response(
    posed: PosedDrive, refs: Sequence[SweepRef], config: PointsConfig
) -> IntensityResponse | None:
    if not config.normalize_intensity:
        return None
    path = cKDTree(_every_step(posed.trajectory.translations[:, :2]))

    def asphalt_of(ref: SweepRef) -> tuple[NDArrayByte, NDArrayByte, NDArrayFloat, NDArrayBool]:
        seen = sweep_in_city(posed, ref, config)
        ground = np.flatnonzero(seen.is_ground)
        away, _ = path.query(
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
    some = refs[:: -(-len(refs) // _SWEEPS_FOR_INTENSITY)]
    for asphalt in made_ahead(some, asphalt_of, threads=_READERS):
        statistics.add(*asphalt)
    response = statistics.response()
    if response is None:
        _LOG.warning(
            "%s: too little road near the driven path to normalize lidar intensity; it stays as it is.",
            posed.drive.name,
        )
    return response


def _every_step(path: NDArrayFloat) -> NDArrayFloat:
    """Positions (M, 2) of a path (N, 2), metres, that are about a quarter of a metre apart."""
    walked = np.cumsum(np.linalg.norm(np.diff(path, axis=0, prepend=path[:1]), axis=1))
    return path[np.unique(np.floor(walked / _PATH_STEP_M), return_index=True)[1]]


def _lidar(posed: PosedDrive, refs: Sequence[SweepRef]) -> tuple[NDArrayFloat, float]:
    """Where the lidar sits, (3,) in the ego frame, and the angle between its rings, degrees."""
    from hdmap_tools.point_map.moving import estimate_lidar_position

    some = [posed.drive.read_sweep(ref) for ref in refs[:: -(-len(refs) // _SWEEPS_FOR_LIDAR)]]
    gaps = [ring_gap_deg(sweep.points_ego, sweep.ring) for sweep in some]
    return estimate_lidar_position(some), float(np.median(gaps))


def _made_tiles(
    tiles: VoxelTiles, seen_through: SeenThrough | None
) -> Iterator[tuple[TileIndex, PointTile]]:
    def made(index: TileIndex) -> tuple[TileIndex, PointTile]:
        voxels = tiles.voxels(index)
        if seen_through is not None:
            voxels = voxels.keep(~seen_through.is_moving(index, voxels))
        return index, made_tile(voxels, tiles.grid)

    return made_ahead(tiles.tile_indices(), made, threads=_READERS)


def made_tile(voxels: Voxels, grid: VoxelGrid) -> PointTile:
    """The points of a tile and its ground, from the sums of its voxels."""
    from hdmap_tools.point_map.point_map import TILE_MM
    from hdmap_tools.point_map.thinning import intensity_of, is_ground_of

    points_mm = grid.means_mm(voxels)
    is_ground, cell = is_ground_of(voxels), grid.cells(voxels.key)
    ground = smooth_ground(
        points_mm[is_ground],
        voxels.sums[is_ground, 0] / 64.0,
        cell[is_ground],
        (TILE_MM // grid.cell_mm) ** 2,
    )
    points_mm[is_ground, 2] = ground.height_mm
    return PointTile(
        np.rint(points_mm).astype(np.int32),
        intensity_of(voxels),
        voxels.sums[:, 5].astype(np.int32),
        is_ground,
        cell.astype(np.uint16),
        ground.cells.astype(np.uint16),
        np.rint(ground.cell_height_mm).astype(np.int32),
        np.rint(ground.roughness_mm).astype(np.int32),
        ground.cell_points.astype(np.int32),
    )


class _Counter:
    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def one_more(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total)
