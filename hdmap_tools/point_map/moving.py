"""What moved leaves no trail in the point map: a voxel that a sweep saw through is not a surface.

Each sweep is a picture of ranges around its lidar. A voxel in whose direction it
measured further, and nothing as near, was empty at that time; one at whose range it
measured was there. Ground is never asked: a grazing ray passes through a voxel of
ground and meets the ground behind it.

Source:
    The comparison of map and range image follows Kim and Kim, Remove, then Revert:
    Static Point Cloud Map Construction using Multiresolution Range Images, 2020.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.point_map.point_map import TILE_MM, TileIndex
from hdmap_tools.point_map.range_image import (
    BIN_DEG,
    MARGIN,
    ROWS,
    RangeImage,
    Windows,
    bin_of,
    nearest_within,
)
from hdmap_tools.point_map.thinning import VoxelGrid, Voxels, is_ground_of
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayFloat, NDArrayFloat32, NDArrayInt

BLOCK_MM: Final = 200
"""Voxels are judged in blocks of this edge: rays of a lidar pass 5 cm voxels by."""

_MARGIN_M: Final = 0.3
"""A return so near to a block's own range met it: half a block's diagonal and pose errors."""
_THROUGH_M: Final = 0.05
"""A ray that passes a block's middle so near went through it. The middle lies on the
surface: rays further off pass above the roof of a parked car and beside a wall's end."""
_REACH_M: Final = 40.0
_NEAREST_M: Final = 2.5
_FEWEST_THROUGH: Final = 2
_THROUGH_PER_HIT: Final = 0.5
"""Sweeps that saw through a block for each one that met it, from which it was not there to stay."""
_TILES_IN_MEMORY: Final = 40
_MOST: Final = np.iinfo(np.uint16).max
"""As high as is counted."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Standing blocks of a tile.

    Attributes:
        of_voxel: (N,) block of each standing voxel of the tile.
        column, layer: (M,) of each block: its x-y position as one number, its height.
        centres_m: (M, 3) float32 metres from the tile's corner.
    """

    of_voxel: NDArrayInt
    column: NDArrayInt
    layer: NDArrayInt
    centres_m: NDArrayFloat32

    @classmethod
    def of(cls, voxels: Voxels, grid: VoxelGrid) -> Blocks:
        """Blocks of a tile's standing voxels."""
        standing = voxels.keep(~is_ground_of(voxels))
        means_mm = grid.means_mm(standing)
        x, y, z = np.floor(means_mm / BLOCK_MM).astype(np.int64).T
        column = y * (TILE_MM // BLOCK_MM + 1) + x
        key, of_voxel = np.unique(column * (1 << 24) + z + (1 << 23), return_inverse=True)
        number = np.maximum(np.bincount(of_voxel, minlength=len(key)), 1)
        centres = np.column_stack(
            [np.bincount(of_voxel, means_mm[:, k], len(key)) / number / 1000.0 for k in range(3)]
        )
        layer = key % (1 << 24) - (1 << 23)
        return cls(of_voxel, key >> 24, layer, centres.astype(np.float32))

    def write(self, path: Path) -> None:
        """Keep them in a file."""
        np.savez(
            path,
            of_voxel=self.of_voxel.astype(np.int32),
            column=self.column,
            layer=self.layer,
            centres_m=self.centres_m,
        )

    @classmethod
    def read(cls, path: Path) -> Blocks:
        """What `write` wrote."""
        with np.load(path) as stored:
            return cls(
                stored["of_voxel"].astype(np.int64),
                stored["column"],
                stored["layer"],
                stored["centres_m"],
            )

    @staticmethod
    def read_centres(path: Path) -> NDArrayFloat32:
        """Of what `write` wrote the centres alone, which are a small part."""
        with np.load(path) as stored:
            centres: NDArrayFloat32 = stored["centres_m"]
            return centres


@dataclass(frozen=True, eq=False)
class _Watched:
    """Centres (M, 3) of a tile's blocks, and how many sweeps met and saw through each: (2, M) uint16."""

    centres_m: NDArrayFloat32
    counts: NDArrayAny


class SeenThrough:
    """Counts by block how many sweeps met it, and how many saw through it.

    Tiles that were left keep their counts on disk.

    Args:
        centres_of: Centres (M, 3) of a tile's blocks, `Blocks.centres_m`; None where there is no tile.
        folder: For the counts; must exist, and is for this one alone.
    """

    def __init__(
        self, centres_of: Callable[[TileIndex], NDArrayFloat32 | None], folder: Path
    ) -> None:
        self._centres_of = centres_of
        self._folder = folder
        self._windows = Windows()
        self._nothing: set[TileIndex] = set()
        self._recent: OrderedDict[TileIndex, _Watched] = OrderedDict()
        self._written: dict[TileIndex, Path] = {}

    def look(self, image: RangeImage, gap_deg: float = 2.1) -> None:
        """Hold a whole sweep against the blocks around it.

        Args:
            image: Of all its returns, near and far.
            gap_deg: Angle between neighbouring rings.
        """
        city_SE3_lidar = image.city_SE3_lidar
        rotation = city_SE3_lidar.rotation
        gap_rows = int(np.ceil(gap_deg / BIN_DEG))
        windows = self._windows.of(image)
        tile_m = TILE_MM / 1000.0
        low, high = (
            np.floor((city_SE3_lidar.translation[:2] + step) / tile_m).astype(int).tolist()
            for step in (-_REACH_M, _REACH_M)
        )
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                tile = self._watched((x, y))
                if tile is None:
                    continue
                corner = np.array([x * tile_m, y * tile_m, 0.0])
                origin = city_SE3_lidar.translation - corner
                _compare(
                    tile.centres_m,
                    origin,
                    rotation,
                    windows,
                    image.first_row,
                    gap_rows,
                    tile.counts,
                )

    def finish(self) -> dict[TileIndex, Path]:
        """Put all counts aside; gives the file of each tile looked at, for `is_moving`."""
        while self._recent:
            self._leave_oldest()
        return dict(sorted(self._written.items()))

    def _watched(self, index: TileIndex) -> _Watched | None:
        if index in self._nothing:
            return None
        found = self._recent.pop(index, None)
        if found is None:
            centres_m = self._centres_of(index)
            if centres_m is None:
                self._nothing.add(index)
                return None
            path = self._written.get(index)
            counts = np.zeros((2, len(centres_m)), dtype=np.uint16)
            found = _Watched(centres_m, counts if path is None else np.load(path))
        self._recent[index] = found
        while len(self._recent) > _TILES_IN_MEMORY:
            self._leave_oldest()
        return found

    def _leave_oldest(self) -> None:
        index, tile = self._recent.popitem(last=False)
        path = self._written[index] = self._folder / f"{index[0]}_{index[1]}.npy"
        np.save(path, tile.counts)


def is_moving(voxels: Voxels, blocks: Blocks, counted: Iterable[Path]) -> NDArrayBool:
    """(N,) which voxels of a tile are the trail of something that moved.

    Args:
        voxels: Of the tile.
        blocks: Of those voxels.
        counted: The tile's files from all that looked, `SeenThrough.finish`; their order and
            how many they are does not matter.
    """
    moving = np.zeros(len(voxels), dtype=bool)
    counts = np.zeros((2, len(blocks.layer)), dtype=np.int64)
    for path in counted:
        counts += np.load(path)
    # One that looked at all of it would have counted no further.
    hits, through = np.minimum(counts, _MOST)
    gone = (through >= _FEWEST_THROUGH) & (through >= _THROUGH_PER_HIT * hits)
    gone = _with_tops(blocks, gone, hits, through)
    moving[np.flatnonzero(~is_ground_of(voxels))] = gone[blocks.of_voxel]
    return moving


def _with_tops(
    blocks: Blocks, gone: NDArrayBool, hits: NDArrayInt, through: NDArrayInt
) -> NDArrayBool:
    """Blocks (M,) that are gone, and those upon and under them that no ray could tell.

    A lidar gets nothing back from the sky, so the upper part of a lorry is never seen
    through; and a ray through its wheels meets the road at once. What touches something
    gone from above or below and was seen for hardly longer goes too.
    """
    gone = gone.copy()
    order = np.lexsort((blocks.layer, blocks.column))
    below, above = order[:-1], order[1:]
    touching = (blocks.column[below] == blocks.column[above]) & (
        blocks.layer[above] - blocks.layer[below] <= 2
    )
    below, above = below[touching], above[touching]
    known, asked = np.concatenate([below, above]), np.concatenate([above, below])
    alike = (through[asked] < _FEWEST_THROUGH) & (hits[asked] <= 2 * hits[known] + 2)
    known, asked = known[alike], asked[alike]
    for _ in range(20):  # 4 m
        more = gone[known] & ~gone[asked]
        if not more.any():
            break
        gone[asked[more]] = True
    return gone


def estimate_lidar_position(sweeps: list[Sweep]) -> NDArrayFloat:
    """Where a lidar sits, (3,) in the ego frame, metres: each of its lasers draws a cone around it.

    Of several lidars, and while the vehicle moves, it is a middle. Without ring numbers, or
    where the fit is no place on a vehicle: 1.8 m above the ego origin.
    """
    from scipy.optimize import least_squares

    points, rings = [], []
    for number, sweep in enumerate(sweeps):
        distance = np.linalg.norm(sweep.points_ego, axis=1)
        use = np.flatnonzero((distance > 4.0) & (distance < 60.0))
        use = use[:: max(len(use) // 4000, 1)]
        points.append(sweep.points_ego[use])
        rings.append(sweep.ring[use].astype(np.int64) + 256 * number)
    usual = np.array([0.0, 0.0, 1.8])
    at, ring = np.concatenate(points), np.concatenate(rings)
    _, ring = np.unique(ring, return_inverse=True)
    of_ring = np.bincount(ring)
    if len(of_ring) < 4 * len(sweeps):
        return usual

    def spread(position: NDArrayFloat) -> NDArrayFloat:
        from_lidar = at - position
        flat = np.hypot(from_lidar[:, 0], from_lidar[:, 1])
        elevation = np.arctan2(from_lidar[:, 2], np.maximum(flat, 1e-6))
        return np.asarray(elevation - (np.bincount(ring, elevation) / of_ring)[ring])

    fit = least_squares(spread, usual, loss="soft_l1", f_scale=0.002, max_nfev=60)
    low, high = np.array([-3.0, -1.5, 0.5]), np.array([5.0, 1.5, 4.5])
    return np.asarray(fit.x) if ((fit.x > low) & (fit.x < high)).all() else usual


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _compare(
    centres: NDArrayFloat32,
    origin: NDArrayFloat,
    rotation: NDArrayFloat,
    windows: NDArrayFloat32,
    first_row: int,
    gap_rows: int,
    counts: NDArrayAny,
) -> None:
    """Add a sweep to the counts (2, N): met, seen through.

    The ray that went through must not be the one that just clears a roof: the ring on the
    roof's side of it, below for what is lower than the lidar, must have gone further too.
    """
    half_m = BLOCK_MM / 2000.0
    for i in range(len(centres)):
        a, b, c = centres[i, 0] - origin[0], centres[i, 1] - origin[1], centres[i, 2] - origin[2]
        distance = np.sqrt(a * a + b * b + c * c)
        if distance > _REACH_M or distance < _NEAREST_M:
            continue
        x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c
        y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c
        z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c
        row, column = bin_of(x, y, z)
        tall = max(int(np.rad2deg(half_m / distance) / BIN_DEG + 0.5), 1)
        if row < tall or row + tall >= ROWS:
            continue
        flat = max(np.sqrt(x * x + y * y), 0.1)
        wide = max(int(np.rad2deg(half_m / flat) / BIN_DEG + 0.5), 1)
        row -= first_row
        column += MARGIN
        nearest = nearest_within(windows, row - tall, row + tall, column, wide)
        if nearest < distance - _MARGIN_M:
            continue
        if nearest <= distance + _MARGIN_M:
            counts[0, i] = min(counts[0, i] + 1, 65535)
            continue
        tall_through = int(np.rad2deg(_THROUGH_M / distance) / BIN_DEG + 0.5)
        wide_through = int(np.rad2deg(_THROUGH_M / flat) / BIN_DEG + 0.5)
        through = nearest_within(
            windows, row - tall_through, row + tall_through, column, wide_through
        )
        if through == np.inf:
            continue
        first = row - tall - gap_rows if z < 0.0 else row + tall + 1
        beside = nearest_within(windows, first, first + gap_rows - 1, column, wide)
        if beside > distance + _MARGIN_M:
            counts[1, i] = min(counts[1, i] + 1, 65535)
