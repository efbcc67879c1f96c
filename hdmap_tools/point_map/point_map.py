"""The dense point map on disk: tiles of thinned points, sorted by cell, and the poses they stand on.

A folder with `meta.json`, `tiles/<ix>_<iy>.feather` (points), `cells/<ix>_<iy>.feather`
(ground height and roughness by cell) and `poses/` (one trajectory a drive). Positions
are whole millimetres from the tile's south-west corner and from city height 0.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from hdmap_tools.errors import (
    FormatError,
    HDMapError,
    PointMapError,
    ShapeError,
    brief_problems,
)
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.point_map.tables import read_poses, read_table, write_poses, write_table
from hdmap_tools.point_map.values import MapPoints
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt

POINT_MAP_VERSION: Final = 1
META_NAME: Final = "meta.json"
TILE_MM: Final = 25_600
"""Edge of a tile; 256 cells of 0.1 m, as the semantic map's tiles at that resolution."""

_TILES_IN_MEMORY: Final = 12
_POINT_COLUMNS: Final = ("x_mm", "y_mm", "z_mm", "intensity", "hits", "is_ground", "cell")
_CELL_COLUMNS: Final = ("cell", "height_mm", "roughness_mm", "points")

TileIndex = tuple[int, int]


class DriveOfPoints(BaseModel):
    """One drive in a point map.

    Attributes:
        id: ``<layout>:<name>``.
        poses: File of its poses below `poses/`.
        is_refined: Whether registration changed the poses that the drive came with.
        num_sweeps: Sweeps that went in.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str
    poses: Annotated[str, Field(pattern=r"^[^/\\]+\.feather$")]
    is_refined: bool
    num_sweeps: Annotated[int, Field(ge=0)]


class TileOfPoints(BaseModel):
    """One tile: its index, how many points it has, and CRC-32 of its files, which tell a wrong one."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    x: Annotated[int, Field(ge=-(10**6), le=10**6)]
    y: Annotated[int, Field(ge=-(10**6), le=10**6)]
    num_points: Annotated[int, Field(ge=1)]
    points_crc32: int | None = None
    cells_crc32: int | None = None


class PointMapMeta(BaseModel):
    """What a point map holds; `meta.json`.

    Attributes:
        cell_mm: Edge of the cells that points are sorted by and that have a ground height.
        voxel_mm: Points were thinned to one a voxel of this edge; 0: not at all.
        frame_document: The city frame (`MapFrame.to_json`).
        source: Made from drives, or from a point cloud of someone else (its file name).
        asphalt_intensity: Level to which asphalt was normalized; None if nothing was.
        drives, tiles: What went in, what is there.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = POINT_MAP_VERSION
    cell_mm: Annotated[int, Field(ge=10, le=TILE_MM)] = 200
    voxel_mm: Annotated[int, Field(ge=0, le=TILE_MM)] = 50
    frame_document: dict[str, Any] = Field(default_factory=lambda: MapFrame().to_json())
    source: str = "drives"
    asphalt_intensity: float | None = None
    drives: tuple[DriveOfPoints, ...] = ()
    tiles: tuple[TileOfPoints, ...] = ()

    @model_validator(mode="after")
    def _cells_fill_tiles(self) -> PointMapMeta:
        if TILE_MM % self.cell_mm or self.cells_a_side > 256:
            raise ValueError(
                f"cell_mm {self.cell_mm} must divide {TILE_MM} into at most 256 cells a side"
            )
        if self.voxel_mm and self.cell_mm % self.voxel_mm:
            raise ValueError(
                f"cell_mm {self.cell_mm} must be a multiple of voxel_mm {self.voxel_mm}"
            )
        return self

    @property
    def cells_a_side(self) -> int:
        """Cells along a tile's edge."""
        return TILE_MM // self.cell_mm

    @property
    def frame(self) -> MapFrame:
        """The city frame."""
        return MapFrame.from_json(self.frame_document)


@dataclass(frozen=True, eq=False)
class PointTile:
    """Points of one tile in order of their cell, and its ground by cell.

    Attributes:
        points_mm: (N, 3) int32, from the tile's south-west corner and city height 0.
        intensity: (N,) uint8.
        hits: (N,) int32 returns behind each point.
        is_ground: (N,) bool.
        cell: (N,) uint16 ``row * cells_a_side + col``, ascending.
        ground_cells: (M,) uint16 cells with ground, ascending.
        ground_height_mm, roughness_mm: (M,) int32; roughness is the one-sigma scatter
            of ground points around the local surface.
        ground_points: (M,) int32 ground points in the cell.
    """

    points_mm: NDArrayAny
    intensity: NDArrayByte
    hits: NDArrayAny
    is_ground: NDArrayBool
    cell: NDArrayAny
    ground_cells: NDArrayAny
    ground_height_mm: NDArrayAny
    roughness_mm: NDArrayAny
    ground_points: NDArrayAny

    def __len__(self) -> int:
        return len(self.cell)

    def __post_init__(self) -> None:
        count, cells = len(self.cell), len(self.ground_cells)
        columns = (self.intensity, self.hits, self.is_ground)
        grounds = (self.ground_height_mm, self.roughness_mm, self.ground_points)
        if (
            self.points_mm.shape != (count, 3)
            or any(c.shape != (count,) for c in columns)
            or any(c.shape != (cells,) for c in grounds)
        ):
            raise ShapeError("The columns of a point tile differ in length.")

    def to_points(self, index: TileIndex) -> MapPoints:
        """City points of all of it."""
        corner = np.array([index[0], index[1], 0], dtype=np.int64) * TILE_MM
        return MapPoints((self.points_mm + corner) / 1000.0, self.intensity, self.is_ground)


class PointMap:
    """A point map that lies on disk; tiles are read when they are asked for."""

    def __init__(self, path: Path, meta: PointMapMeta) -> None:
        self.path = path
        self.meta = meta
        self._tiles = {(t.x, t.y): t for t in meta.tiles}
        self._recent: OrderedDict[TileIndex, _TileInMemory] = OrderedDict()

    @classmethod
    def create(
        cls,
        path: Path,
        meta: PointMapMeta,
        tiles: Iterable[tuple[TileIndex, PointTile]],
        trajectories: Mapping[str, Trajectory] | None = None,
    ) -> PointMap:
        """Write a point map into an empty folder.

        Args:
            path: The folder.
            meta: What it means; its `tiles` are filled in.
            tiles: One after another, each index once; empty ones are left out.
            trajectories: Poses by drive id, of the drives in `meta`.

        Raises:
            PointMapError: If there is no point at all.
        """
        path.mkdir(parents=True, exist_ok=True)
        written = (write_tile(path, index, tile) for index, tile in tiles)
        return cls.created(path, meta, written, trajectories)

    @classmethod
    def created(
        cls,
        path: Path,
        meta: PointMapMeta,
        tiles: Iterable[TileOfPoints | None],
        trajectories: Mapping[str, Trajectory] | None = None,
    ) -> PointMap:
        """As `create`, of tiles that lie in the folder: each as `write_tile` says it."""
        (path / "poses").mkdir(exist_ok=True)
        written = [tile for tile in tiles if tile is not None]
        if not written:
            raise PointMapError(
                f"No points for the point map at {path}: expected lidar returns on a ground."
            )
        for drive in meta.drives:
            write_poses(path / "poses" / drive.poses, (trajectories or {})[drive.id])
        meta = meta.model_copy(
            update={"tiles": tuple(sorted(written, key=lambda tile: (tile.x, tile.y)))}
        )
        (path / META_NAME).write_text(meta.model_dump_json(indent=1) + "\n", encoding="utf-8")
        return cls(path, meta)

    @classmethod
    def open(cls, path: Path) -> PointMap:
        """Open a point map.

        Raises:
            PointMapError: If there is none, or it cannot be read.
        """
        try:
            document = json.loads((path / META_NAME).read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise PointMapError(
                f"{path} is not a point map (no {META_NAME}); make one with `hdmap points DRIVE -o "
                f"{path}`."
            ) from error
        except (OSError, ValueError, RecursionError) as error:
            raise PointMapError(f"{path / META_NAME} cannot be read: {error}") from error
        found = document.get("schema_version") if isinstance(document, dict) else None
        if found != POINT_MAP_VERSION:
            raise PointMapError(
                f"{path} is a point map of schema_version {found!r:.40}; this version reads "
                f"{POINT_MAP_VERSION}. Make it anew with `hdmap points`."
            )
        try:
            meta = PointMapMeta.model_validate(document)
            _ = meta.frame
        except ValidationError as error:
            raise PointMapError(
                f"{path / META_NAME} is wrong: {brief_problems(error)}; make the map anew."
            ) from error
        except FormatError as error:
            raise PointMapError(f"{path / META_NAME} is wrong: {error}") from error
        if not meta.tiles:
            raise PointMapError(f"{path / META_NAME} lists no tiles; make the map anew.")
        return cls(path, meta)

    def tile_indices(self) -> tuple[TileIndex, ...]:
        """Tiles with points, in order."""
        return tuple(sorted(self._tiles))

    @property
    def num_points(self) -> int:
        """Points in all tiles."""
        return sum(tile.num_points for tile in self._tiles.values())

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) of its tiles, city metres."""
        indices = np.array(self.tile_indices())
        low, high = indices.min(axis=0), indices.max(axis=0) + 1
        low_m, high_m = low * TILE_MM / 1000.0, high * TILE_MM / 1000.0
        return float(low_m[0]), float(low_m[1]), float(high_m[0]), float(high_m[1])

    def read_tile(self, index: TileIndex) -> PointTile:
        """One tile, from disk.

        Raises:
            PointMapError: If there is no such tile, or its file is damaged.
        """
        if index not in self._tiles:
            raise PointMapError(f"{self.path} has no tile {index}.")
        listed, name = self._tiles[index], _tile_name(index)
        points = read_table(self.path / "tiles" / name, _POINT_COLUMNS, listed.points_crc32)
        cells = self._read_cells(index)
        if (found := len(points["cell"])) != listed.num_points:
            raise PointMapError(
                f"{self.path / 'tiles' / name} has {found} points, expected {listed.num_points}; it "
                "is damaged or from another map. Make the map anew."
            )
        self._require_sorted(points["cell"], self.path / "tiles" / name)
        return PointTile(
            np.column_stack([points["x_mm"], points["y_mm"], points["z_mm"]]),
            points["intensity"],
            points["hits"],
            points["is_ground"],
            points["cell"],
            cells["cell"],
            cells["height_mm"],
            cells["roughness_mm"],
            cells["points"],
        )

    def read_ground(self, index: TileIndex) -> NDArrayFloat:
        """Ground height (rows, columns) by cell of one tile, metres, NaN without; from disk.

        Raises:
            PointMapError: If its file is damaged.
        """
        side = self.meta.cells_a_side
        heights = np.full(side * side, np.nan)
        if index in self._tiles:
            cells = self._read_cells(index)
            heights[cells["cell"]] = cells["height_mm"] / 1000.0
        return heights.reshape(side, side)

    def _read_cells(self, index: TileIndex) -> dict[str, NDArrayAny]:
        path = self.path / "cells" / _tile_name(index)
        cells = read_table(path, _CELL_COLUMNS, self._tiles[index].cells_crc32)
        self._require_sorted(cells["cell"], path)
        return cells

    def _require_sorted(self, cell: NDArrayAny, path: Path) -> None:
        size = self.meta.cells_a_side**2
        if len(cell) and (cell[-1] >= size or (np.diff(cell.astype(np.int64)) < 0).any()):
            raise PointMapError(f"{path} is not sorted by cell.")

    def points_in(self, bounds_m: tuple[float, float, float, float]) -> MapPoints:
        """Points within (x0, y0, x1, y1), city metres, and those that share a cell with such."""
        cell_m = self.meta.cell_mm / 1000.0
        x0, y0 = (int(np.floor(v / cell_m)) for v in bounds_m[:2])
        x1, y1 = (int(np.floor(v / cell_m)) + 1 for v in bounds_m[2:])
        side = self.meta.cells_a_side
        parts = []
        for tx in range(x0 // side, (x1 - 1) // side + 1):
            for ty in range(y0 // side, (y1 - 1) // side + 1):
                if (tx, ty) not in self._tiles:
                    continue
                tile = self._in_memory((tx, ty))
                columns = max(x0 - tx * side, 0), min(x1 - tx * side, side)
                rows = max(y0 - ty * side, 0), min(y1 - ty * side, side)
                parts.append(tile.window(columns, rows))
        return MapPoints.joined(parts)

    def ground_at(self, xy_city: NDArrayFloat) -> NDArrayFloat:
        """Ground height (N,) at positions (N, 2), city metres, between the cells' own; NaN where unknown."""
        cell_m = self.meta.cell_mm / 1000.0
        position = np.asarray(xy_city, dtype=np.float64)[:, :2] / cell_m - 0.5
        low = np.floor(position).astype(np.int64)
        share = position - low
        total, weight = np.zeros(len(low)), np.zeros(len(low))
        for dx in (0, 1):
            for dy in (0, 1):
                height = self._cell_heights(low + (dx, dy))
                w = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1])
                w = np.where(np.isfinite(height), w, 0.0)
                total += w * np.nan_to_num(height)
                weight += w
        with np.errstate(invalid="ignore", divide="ignore"):
            # A position may lie nearer to a cell without ground than to one with.
            return np.where(weight > 0.2, total / weight, np.nan)

    def trajectory_of(self, drive_id: str) -> Trajectory | None:
        """The poses that a drive's points stand on; None if the map was made without it."""
        for drive in self.meta.drives:
            if drive.id == drive_id:
                return read_poses(self.path / "poses" / drive.poses)
        return None

    def require_overlap(self, trajectory: Trajectory, name: str, margin_m: float = 0.0) -> None:
        """Raise `PointMapError` with both bounds if a drive does not come near any tile."""
        indices = np.floor(trajectory.translations[:, :2] / (TILE_MM / 1000.0)).astype(np.int64)
        reach = int(np.ceil(margin_m * 1000.0 / TILE_MM))
        for ix, iy in np.unique(indices, axis=0).tolist():
            for dx in range(-reach, reach + 1):
                if any((ix + dx, iy + dy) in self._tiles for dy in range(-reach, reach + 1)):
                    return
        low, high = trajectory.translations.min(axis=0), trajectory.translations.max(axis=0)
        x0, y0, x1, y1 = self.bounds_m
        raise PointMapError(
            f"The point map {self.path} does not overlap drive {name}: the map spans x {x0:.0f} to {x1:.0f}, "
            f"y {y0:.0f} to {y1:.0f} m, the drive x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to "
            f"{high[1]:.0f} m in the city frame. Take the map of this place, or make one with `hdmap points`."
        )

    def _cell_heights(self, cells: NDArrayInt) -> NDArrayFloat:
        """Heights (N,), metres, of the map's cells (N, 2) as (ix, iy); NaN without ground."""
        side = self.meta.cells_a_side
        tiles = np.floor_divide(cells, side)
        flat = (cells[:, 1] - tiles[:, 1] * side) * side + cells[:, 0] - tiles[:, 0] * side
        heights = np.full(len(cells), np.nan)
        for tx, ty in np.unique(tiles, axis=0).tolist():
            if (tx, ty) in self._tiles:
                here = (tiles[:, 0] == tx) & (tiles[:, 1] == ty)
                heights[here] = self._in_memory((tx, ty)).heights_m[flat[here]]
        return heights

    def _in_memory(self, index: TileIndex) -> _TileInMemory:
        found = self._recent.pop(index, None)
        if found is None:
            found = _TileInMemory.from_tile(index, self.read_tile(index), self.meta.cells_a_side)
        self._recent[index] = found
        while len(self._recent) > _TILES_IN_MEMORY:
            self._recent.popitem(last=False)
        return found


@dataclass(frozen=True, eq=False)
class _TileInMemory:
    """A tile in city metres with the first point of each cell."""

    points: MapPoints
    starts: NDArrayInt
    heights_m: NDArrayFloat
    side: int

    @classmethod
    def from_tile(cls, index: TileIndex, tile: PointTile, side: int) -> _TileInMemory:
        starts = np.searchsorted(tile.cell, np.arange(side * side + 1))
        heights = np.full(side * side, np.nan)
        heights[tile.ground_cells] = tile.ground_height_mm / 1000.0
        return cls(tile.to_points(index), starts, heights, side)

    def window(self, columns: tuple[int, int], rows: tuple[int, int]) -> MapPoints:
        """Points of cells in half-open ranges; a row of cells is one run of points."""
        if columns == (0, self.side):
            run = slice(self.starts[rows[0] * self.side], self.starts[rows[1] * self.side])
            return _taken(self.points, run)
        row = np.arange(*rows) * self.side
        first, last = self.starts[row + columns[0]], self.starts[row + columns[1]]
        length = last - first
        skipped = np.cumsum(length) - length
        at = np.arange(int(length.sum())) + np.repeat(first - skipped, length)
        return _taken(self.points, at)


def _taken(points: MapPoints, which: Any) -> MapPoints:
    return MapPoints(points.points_city[which], points.intensity[which], points.is_ground[which])


def _tile_name(index: TileIndex) -> str:
    return f"{index[0]}_{index[1]}.feather"


def write_tile(path: Path, index: TileIndex, tile: PointTile) -> TileOfPoints | None:
    """Write one tile into a folder.

    Returns:
        What the map is to say of it; None if it is empty, which is not written.
    """
    if len(tile) == 0:
        return None
    x, y, z = tile.points_mm.T
    columns = (x, y, z, tile.intensity, tile.hits, tile.is_ground, tile.cell)
    points = dict(zip(_POINT_COLUMNS, columns, strict=True))
    cells = (tile.ground_cells, tile.ground_height_mm, tile.roughness_mm, tile.ground_points)
    ground = dict(zip(_CELL_COLUMNS, cells, strict=True))
    for name in ("tiles", "cells"):
        (path / name).mkdir(exist_ok=True)
    return TileOfPoints(
        x=index[0],
        y=index[1],
        num_points=len(tile),
        points_crc32=write_table(path / "tiles" / _tile_name(index), points),
        cells_crc32=write_table(path / "cells" / _tile_name(index), ground),
    )


def is_point_map(path: Path) -> bool:
    """Whether a folder is a point map that can be opened."""
    try:
        PointMap.open(path)
    except HDMapError:
        return False
    return True
