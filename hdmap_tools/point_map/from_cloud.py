"""A point map from a point cloud of someone else, which knows no sweeps: ground found from above."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.config import PointsConfig
from hdmap_tools.errors import PointMapError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.point_map.building_steps import made_tile
from hdmap_tools.point_map.point_files import PointCloud, read_point_file
from hdmap_tools.point_map.point_map import PointMap, PointMapMeta
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_LOG = logging.getLogger(__name__)

_LATTICE_M: Final = 0.5
_WINDOWS_M: Final = (1.5, 3.0, 6.0, 12.0, 24.0)
_SLOPE: Final = 0.15
_FIRST_STEP_M: Final = 0.2
_MAX_LATTICE: Final = 50_000_000
_CHUNK: Final = 1_000_000


def build_from_file(path: Path, folder: Path, config: PointsConfig, frame: MapFrame) -> PointMap:
    """Build a point map into an empty folder from a point cloud.

    Args:
        path: PCD, PLY, LAS or LAZ.
        folder: Where the map shall be.
        config: Voxels, cells, tolerance of the ground.
        frame: The city frame; a georeferenced file is brought into it, any other is
            taken as city metres.

    Raises:
        PointMapError: If the file has no usable points, or no ground.
        CRSMismatchError: If the file is georeferenced and the frame is not.
    """
    from hdmap_tools.point_map.thinning import VoxelGrid, VoxelTiles, read_voxels

    cloud = read_point_file(path)
    if cloud.num_dropped:
        _LOG.warning(
            "%s: %d points that are NaN, infinite or not of this earth are left out.",
            path.name,
            cloud.num_dropped,
        )
    if cloud.crs is None:
        _LOG.warning("%s does not say where it lies; it is taken as city metres.", path.name)
        if _looks_geographic(cloud):
            raise PointMapError(
                f"{path} does not say in which CRS it is, and its numbers look like degrees; expected metres."
            )
    points_city = cloud.in_frame(frame)
    is_ground = cloud.is_ground
    if is_ground is None:
        is_ground = find_ground(points_city, config.ground_tolerance_m)
    if not is_ground.any():
        raise PointMapError(f"No ground in {path}: expected a street, z up, in metres.")
    intensity = cloud.intensity
    if intensity is None:
        _LOG.warning("%s has no intensity; it is taken as 0 everywhere.", path.name)
        intensity = np.zeros(len(cloud), np.uint8)
    meta = PointMapMeta(
        cell_mm=config.cell_mm,
        voxel_mm=config.voxel_mm,
        frame_document=frame.to_json(),
        source=path.name,
    )
    with tempfile.TemporaryDirectory(prefix=".aside.", dir=folder.parent) as aside:
        tiles = VoxelTiles(VoxelGrid(config.voxel_mm, config.cell_mm), Path(aside))
        for start in range(0, len(cloud), _CHUNK):
            part = slice(start, start + _CHUNK)
            near = np.zeros(len(intensity[part]))
            tiles.add(points_city[part], intensity[part], is_ground[part], near)
        files = tiles.finish()
        made = ((i, made_tile(read_voxels(paths), tiles.grid)) for i, paths in files.items())
        return PointMap.create(folder, meta, made)


def find_ground(points: NDArrayFloat, tolerance_m: float) -> NDArrayBool:
    """Which points (N, 3), metres, z up, lie on the ground: low, and reached without a step.

    Source:
        Zhang et al., A progressive morphological filter for removing nonground
        measurements from airborne lidar data, 2003.
    """
    from scipy.ndimage import grey_opening, map_coordinates

    low = points[:, :2].min(axis=0)
    cells = np.floor((points[:, :2] - low) / _LATTICE_M).astype(np.int64)
    columns, rows = (cells.max(axis=0) + 1).tolist()
    if rows * columns > _MAX_LATTICE:
        raise PointMapError(
            f"The point cloud spans {columns * _LATTICE_M:.0f} m x {rows * _LATTICE_M:.0f} m, too much to find "
            "its ground at once; cut it to the place that is mapped, or classify its ground (LAS class 2)."
        )
    flat = cells[:, 1] * columns + cells[:, 0]
    lowest = np.full(rows * columns, np.inf)
    np.minimum.at(lowest, flat, points[:, 2])
    surface = lowest.reshape(rows, columns)
    is_known = np.isfinite(surface)
    surface = _filled(surface, is_known)
    is_ground_cell = is_known.copy()
    for window_m in _WINDOWS_M:
        size = 2 * int(window_m / _LATTICE_M / 2) + 1
        opened = grey_opening(surface, size=(size, size))
        is_ground_cell &= surface - opened <= _FIRST_STEP_M + _SLOPE * window_m / 2
        surface = opened
    surface = np.where(is_ground_cell, lowest.reshape(rows, columns), np.inf)
    surface = _filled(surface, is_ground_cell)
    position = (points[:, :2] - low) / _LATTICE_M - 0.5
    height = map_coordinates(surface, position[:, ::-1].T, order=1, mode="nearest")
    near = is_ground_cell[cells[:, 1], cells[:, 0]]
    # The lowest point of a cell lies below its middle on a slope and under noise.
    return np.asarray(near & (points[:, 2] - height <= tolerance_m + 0.05))


def _filled(surface: NDArrayFloat, is_known: NDArrayBool) -> NDArrayFloat:
    """The surface with unknown cells at the height of the nearest known one."""
    from scipy.ndimage import distance_transform_edt

    if not is_known.any():
        return np.zeros(surface.shape)
    index = distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    return np.asarray(surface[tuple(index)])


def _looks_geographic(cloud: PointCloud) -> bool:
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    is_small = bool((high - low)[:2].max() < 0.5)
    return is_small and abs(low[0]) <= 180.0 and abs(low[1]) <= 90.0
