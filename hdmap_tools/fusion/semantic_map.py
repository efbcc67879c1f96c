"""The semantic map on disk: counts in an Icechunk repository, a version for every commit.

Layout of the Zarr v3 group: one array a layer of `cell_counts.LAYERS`, spanning
`LATTICE_CELLS` a side with a chunk a tile, so that only tiles with evidence
take space; the map's meta and the drives it holds in the group's attributes.
On a local disk exactly one process may commit at a time.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from hdmap_tools.errors import HDMapError, MapMismatchError, OutputExistsError, StoreError
from hdmap_tools.fusion.cell_counts import (
    LATTICE_CELLS,
    LAYERS,
    TILE_CELLS,
    CellCounts,
    Tile,
    TileIndex,
    combine_tiles,
    grid_of_tiles,
    shift_heights,
    window_of_tiles,
)
from hdmap_tools.fusion.map_meta import MAP_SCHEMA_VERSION, MapMeta
from hdmap_tools.geometry.grid import BevGrid

if TYPE_CHECKING:
    import icechunk
    import zarr

_BRANCH: Final = "main"
_HALF: Final = LATTICE_CELLS // 2


@dataclass(frozen=True)
class Version:
    """One commit of a map.

    Attributes:
        id: Snapshot id; opens that version again.
        time: When it was committed.
        message: What was done.
        metadata: For example the drive and segment it added.
    """

    id: str
    time: datetime
    message: str
    metadata: dict[str, Any]


class SemanticMap:
    """A probabilistic map on disk; `create` or `open` one.

    Attributes:
        path: Folder of the repository.
        meta: What its counts mean.
    """

    def __init__(
        self, path: Path, repository: icechunk.Repository, meta: MapMeta, version: str | None
    ) -> None:
        self.path = path
        self.meta = meta
        self._repository = repository
        self._version = version

    @classmethod
    def create(cls, path: Path, meta: MapMeta, *, overwrite: bool = False) -> SemanticMap:
        """Make an empty map.

        Raises:
            OutputExistsError: If something is there and overwrite is false, or if
                what is there is not a semantic map.
            StoreError: If the folder cannot be written.
        """
        icechunk = _icechunk()
        import zarr

        if path.exists():
            if not overwrite:
                raise OutputExistsError(
                    f"{path} exists already; add --overwrite to replace it, or choose another output."
                )
            if not is_semantic_map(path):
                raise OutputExistsError(
                    f"{path} exists and is not a semantic map; it is left alone."
                )
            shutil.rmtree(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            repository = icechunk.Repository.create(icechunk.local_filesystem_storage(str(path)))
            session = repository.writable_session(_BRANCH)
            group = zarr.create_group(store=session.store)
            group.attrs["meta"] = meta.model_dump(mode="json")
            group.attrs["drives"] = {}
            for name, dtype in LAYERS.items():
                lead = (len(meta.label_set), meta.num_bins) if name == "counts" else ()
                group.create_array(
                    name,
                    shape=(*lead, LATTICE_CELLS, LATTICE_CELLS),
                    chunks=(*lead, TILE_CELLS, TILE_CELLS),
                    dtype=dtype,
                    fill_value=0,
                )
            session.commit("Empty map")
        except (OSError, icechunk.IcechunkError) as error:
            raise StoreError(f"Cannot make a map at {path}: {_one_line(error)}") from error
        return cls(path, repository, meta, None)

    @classmethod
    def open(cls, path: Path, version: str | None = None) -> SemanticMap:
        """Open a map, at its newest version or at an older one (read-only).

        Raises:
            StoreError: If there is no map, its schema is newer than ours, or it is damaged.
        """
        icechunk = _icechunk()
        import zarr

        if not is_semantic_map(path):
            found = "nothing" if not path.exists() else "something else"
            raise StoreError(f"No semantic map at {path} (found {found}); `hdmap build` makes one.")
        try:
            repository = icechunk.Repository.open(icechunk.local_filesystem_storage(str(path)))
            session = (
                repository.readonly_session(_BRANCH)
                if version is None
                else repository.readonly_session(snapshot_id=version)
            )
            document = zarr.open_group(session.store, mode="r").attrs["meta"]
        except (OSError, KeyError, ValueError, icechunk.IcechunkError) as error:
            raise StoreError(f"Cannot open the map at {path}: {_one_line(error)}") from error
        found_version = document.get("schema_version") if isinstance(document, dict) else None
        if found_version != MAP_SCHEMA_VERSION:
            raise StoreError(
                f"The map at {path} has schema version {found_version}, this release reads "
                f"{MAP_SCHEMA_VERSION}; open it with the release that wrote it."
            )
        try:
            meta = MapMeta.model_validate(document)
        except ValidationError as error:
            raise StoreError(f"The map at {path} has a damaged description: {error}") from error
        return cls(path, repository, meta, version)

    @property
    def drives(self) -> dict[str, dict[str, Any]]:
        """What was added, by drive id: number of frames."""
        return dict(self._group().attrs["drives"])  # type: ignore[arg-type]

    def history(self) -> list[Version]:
        """All versions, newest first."""
        start = {"branch": _BRANCH} if self._version is None else {"snapshot_id": self._version}
        return [
            Version(info.id, info.written_at, info.message, dict(info.metadata))
            for info in self._repository.ancestry(**start)
        ]

    def tiles(self) -> tuple[TileIndex, ...]:
        """Indices of the tiles that hold evidence, sorted."""
        from zarr.core.sync import sync

        session = self._session()

        async def listed() -> set[TileIndex]:
            # Heights come with every observation, votes too: either lists all tiles.
            return {
                (c[-1] - _HALF // TILE_CELLS, c[-2] - _HALF // TILE_CELLS)
                async for c in session.chunk_coordinates("/height_n")
            }

        return tuple(sorted(sync(listed())))

    @property
    def grid(self) -> BevGrid | None:
        """The smallest grid that covers all tiles, or None for an empty map."""
        return grid_of_tiles(self.tiles(), self.meta)

    def read_tile(self, index: TileIndex) -> Tile:
        """The layers of one tile; zeros where nothing was observed."""
        return _read_tile(self._group(), index)

    def window(self, grid: BevGrid) -> Tile:
        """The layers over any grid of this map's lattice."""
        present, group = set(self.tiles()), self._group()
        return window_of_tiles(
            lambda index: _read_tile(group, index) if index in present else None, grid, self.meta
        )

    def read(self) -> CellCounts:
        """All counts, in memory."""
        counts = CellCounts(self.meta)
        group = self._group()
        counts.tiles = {index: _read_tile(group, index) for index in self.tiles()}
        counts.num_frames = sum(drive["num_frames"] for drive in self.drives.values())
        return counts

    def add(self, counts: CellCounts, drive_id: str, message: str = "") -> str:
        """Add the counts of (part of) a drive and commit; returns the version's id.

        Raises:
            MapMismatchError: If the counts are of another kind of map, or overflow.
            StoreError: If the commit fails; the map then stays as it was.
        """
        drives = {drive_id: {"num_frames": counts.num_frames}}
        return self._apply(counts, 1, message or f"Add {drive_id}", drives)

    def merge(self, other: SemanticMap) -> str:
        """Add all that another map holds.

        Raises:
            MapMismatchError: If the maps are not compatible, or hold a drive in common.
        """
        self.meta.require_compatible(other.meta)
        common = sorted(self.drives.keys() & other.drives.keys())
        if common:
            raise MapMismatchError(
                f"Both maps hold {', '.join(common)}; adding it twice would count it twice. "
                "Subtract it from one of them first."
            )
        return self._apply(other.read(), 1, f"Merge {other.path.name}", other.drives)

    def subtract(self, other: SemanticMap) -> str:
        """Take all that another map holds out of this one.

        Raises:
            MapMismatchError: If this map does not hold the other's drives and counts.
        """
        self.meta.require_compatible(other.meta)
        missing = sorted(other.drives.keys() - self.drives.keys())
        if missing:
            raise MapMismatchError(
                f"{self.path} does not hold {', '.join(missing)}, so it cannot be subtracted; "
                f"it holds {', '.join(sorted(self.drives)) or 'no drive'}."
            )
        return self._apply(other.read(), -1, f"Subtract {other.path.name}", other.drives)

    def _apply(
        self, counts: CellCounts, sign: int, message: str, drives: dict[str, dict[str, Any]]
    ) -> str:
        import icechunk
        import zarr

        if self._version is not None:
            raise StoreError(f"{self.path} is open at an old version, which cannot be changed.")
        self.meta.require_compatible(counts.meta)
        shift_mm = round((counts.meta.reference_height_m - self.meta.reference_height_m) * 1000)
        session = self._repository.writable_session(_BRANCH)
        try:
            group = zarr.open_group(session.store)
            for index in sorted(counts.tiles):
                tile = counts.tiles[index]
                if tile.is_empty:
                    continue
                summed = combine_tiles(
                    _read_tile(group, index), shift_heights(tile, shift_mm), sign, index
                )
                _write_tile(group, index, summed)
            group.attrs["drives"] = _changed_drives(
                dict(group.attrs["drives"]),  # type: ignore[arg-type]
                drives,
                sign,
            )
            return session.commit(message, metadata={"drives": drives, "sign": sign})
        except HDMapError:
            session.discard_changes()
            raise
        except (OSError, icechunk.IcechunkError) as error:
            raise StoreError(
                f"Could not commit to {self.path}: {_one_line(error)}. The map is as it was before; "
                "check free space and that no other process is writing it."
            ) from error

    def _session(self) -> icechunk.Session:
        if self._version is None:
            return self._repository.readonly_session(_BRANCH)
        return self._repository.readonly_session(snapshot_id=self._version)

    def _group(self) -> zarr.Group:
        import zarr

        return zarr.open_group(self._session().store, mode="r")


def _icechunk() -> ModuleType:
    """The library, told to keep to itself what its warnings say of every local store: one writer."""
    import icechunk

    icechunk.set_logs_filter("error")
    return icechunk


def is_semantic_map(path: Path) -> bool:
    """Whether a folder looks like a map's repository."""
    return path.is_dir() and (path / "refs").is_dir() and (path / "snapshots").is_dir()


def _region(index: TileIndex) -> tuple[slice, slice]:
    x, y = index[0] * TILE_CELLS + _HALF, index[1] * TILE_CELLS + _HALF
    return slice(y, y + TILE_CELLS), slice(x, x + TILE_CELLS)


def _arrays(group: zarr.Group) -> Iterator[tuple[str, Any]]:
    for name in LAYERS:
        yield name, group[name]


def _read_tile(group: zarr.Group, index: TileIndex) -> Tile:
    rows, cols = _region(index)
    return Tile({name: array[..., rows, cols] for name, array in _arrays(group)})


def _write_tile(group: zarr.Group, index: TileIndex, tile: Tile) -> None:
    rows, cols = _region(index)
    for name, array in _arrays(group):
        array[..., rows, cols] = tile.layers[name]


def _changed_drives(
    held: dict[str, dict[str, Any]], changed: dict[str, dict[str, Any]], sign: int
) -> dict[str, dict[str, Any]]:
    for drive_id, entry in changed.items():
        frames = held.get(drive_id, {}).get("num_frames", 0) + sign * entry["num_frames"]
        if frames > 0:
            held[drive_id] = {"num_frames": frames}
        else:
            held.pop(drive_id, None)
    return held


def _one_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0] or type(error).__name__
