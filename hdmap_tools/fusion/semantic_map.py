"""The semantic map: counts in an Icechunk repository on disk or in S3, a version for every commit.

The Zarr v3 group holds the arrays of `map_store`, and in its attributes the map's meta and the
drives that it holds.
On a local disk exactly one process may commit at a time; in S3 the second one is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from hdmap_tools.errors import HDMapError, MapMismatchError, StoreError
from hdmap_tools.fusion.cell_counts import (
    LAYERS,
    CellCounts,
    Tile,
    TileIndex,
    combine_tiles,
    grid_of_tiles,
    shift_heights,
    window_of_tiles,
)
from hdmap_tools.fusion.map_location import MAIN, MapLocation, branch_of
from hdmap_tools.fusion.map_meta import MAP_SCHEMA_VERSION, MapMeta
from hdmap_tools.fusion.map_repository import make_repository, open_repository, tip_of
from hdmap_tools.fusion.map_store import (
    listed_tiles,
    make_arrays,
    read_layer,
    read_tile,
    store_errors,
    write_tile,
)
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.types import NDArrayAny

if TYPE_CHECKING:
    import icechunk
    import zarr

ROLLED_BACK_TO: Final = "rolled_back_to"
"""In a version's metadata: the id of the earlier one that it equals."""

Drives = dict[str, dict[str, Any]]
"""What a map holds, by drive id: ``{"num_frames": n}``."""


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
    """A probabilistic map on disk or in S3; `create` or `open` one.

    Attributes:
        location: Of the repository.
        meta: What its counts mean.
    """

    def __init__(
        self,
        location: MapLocation,
        repository: icechunk.Repository,
        meta: MapMeta,
        version: str | None,
    ) -> None:
        self.location = location
        self.meta = meta
        self._repository = repository
        self._version = version
        self._branch = branch_of(location)
        # A map that is not finished has one writer; what another one commits is not gone on from.
        self._expected = None if self._branch == MAIN else tip_of(repository, self._branch)

    @classmethod
    def create(
        cls, location: MapLocation, meta: MapMeta, note: dict[str, Any] | None = None
    ) -> SemanticMap:
        """Make an empty map.

        Args:
            location: Where; nothing is there yet.
            meta: What its counts will mean.
            note: Metadata of the first version.

        Raises:
            OutputExistsError: If something is there already.
            StoreError: If it cannot be written.
        """
        import zarr

        with store_errors(f"Cannot make a map at {location}"):
            repository = make_repository(location)
            session = repository.writable_session(branch_of(location))
            group = zarr.create_group(store=session.store)
            group.attrs["meta"] = meta.model_dump(mode="json")
            group.attrs["drives"] = {}
            group.attrs["num_tiles"] = 0
            make_arrays(group, meta)
            session.commit("Empty map", metadata=note or {})
            return cls(location, repository, meta, None)

    @classmethod
    def open(cls, location: MapLocation, version: str | None = None) -> SemanticMap:
        """Open a map, at its newest version or at an older one (read-only).

        Raises:
            StoreError: If there is no map, its schema is newer than ours, it is damaged, or S3
                cannot be asked.
        """
        import zarr

        with store_errors(f"Cannot open the map at {location}"):
            repository = open_repository(location)
            session = (
                repository.readonly_session(branch_of(location))
                if version is None
                else repository.readonly_session(snapshot_id=version)
            )
            document = zarr.open_group(session.store, mode="r").attrs["meta"]
        found_version = document.get("schema_version") if isinstance(document, dict) else None
        if found_version != MAP_SCHEMA_VERSION:
            raise StoreError(
                f"The map at {location} has schema version {found_version}, this release reads "
                f"{MAP_SCHEMA_VERSION}; open it with the release that wrote it."
            )
        try:
            meta = MapMeta.model_validate(document)
        except ValidationError as error:
            fields = ", ".join(".".join(map(str, e["loc"])) for e in error.errors())
            raise StoreError(
                f"The map at {location} has a damaged description ({fields}); build it anew."
            ) from error
        return cls(location, repository, meta, version)

    @property
    def drives(self) -> Drives:
        """What was added, by drive id: number of frames."""
        with self._reading():
            return _drives_of(self._group())

    def history(self) -> list[Version]:
        """All versions, newest first."""
        start = (
            {"branch": self._branch} if self._version is None else {"snapshot_id": self._version}
        )
        with self._reading():
            return [
                Version(info.id, info.written_at, info.message, dict(info.metadata))
                for info in self._repository.ancestry(**start)
                if info.parent_id is not None  # before the first there is not even an empty map
            ]

    def tile_indices(self) -> tuple[TileIndex, ...]:
        """Indices of the tiles that hold evidence, sorted."""
        with self._reading():
            found = listed_tiles(self._session())
            expected = self._group().attrs["num_tiles"]
        # The store's own index of chunks carries no checksum.
        if len(found) != expected:
            raise StoreError(
                f"The map at {self.location} is damaged: it lists {len(found)} tiles and should hold {expected}; "
                "build it anew or take a copy."
            )
        return found

    @property
    def grid(self) -> BevGrid | None:
        """The smallest grid that covers all tiles, or None for an empty map."""
        return grid_of_tiles(self.tile_indices(), self.meta)

    def window(self, grid: BevGrid) -> Tile:
        """The layers over any grid of this map's lattice.

        Raises:
            MapMismatchError: If the grid has another resolution.
        """
        read = self._tile_reader()
        return window_of_tiles(read, grid, self.meta)

    def read(self) -> CellCounts:
        """All counts, in memory."""
        counts = CellCounts(self.meta)
        with self._reading():
            group = self._group()
        for index in self.tile_indices():
            with self._reading(index):
                counts.tiles[index] = read_tile(group, index)
        counts.num_frames = sum(drive["num_frames"] for drive in self.drives.values())
        return counts

    def segments_of(self, drive_id: str) -> frozenset[int]:
        """Numbers of the parts of a drive that were added with one."""
        return frozenset(
            segment
            for version in self.history()
            if drive_id in version.metadata.get("drives", {})
            for segment in version.metadata.get("segments", ())
        )

    def add(
        self, counts: CellCounts, drive_id: str, message: str = "", *, segment: int | None = None
    ) -> str:
        """Add the counts of (part of) a drive and commit; returns the version's id.

        Args:
            counts: What was seen.
            drive_id: Where.
            message: What to call it in the history.
            segment: Number of the part, so that `segments_of` knows what is in the map.

        Raises:
            MapMismatchError: If the counts are of another kind of map, or overflow.
            StoreError: If the commit fails; the map then stays as it was.
        """
        part = {} if segment is None else {"segments": [segment]}
        return self._apply_counts(counts, drive_id, 1, message or f"Add {drive_id}", part)

    def add_by_workers(
        self,
        write: Callable[[Any], Iterable[Any]],
        drive_id: str,
        *,
        num_frames: int,
        segments: list[int],
    ) -> str:
        """Let others write tiles of (part of) a drive, and commit; returns the version's id.

        Args:
            write: Given a fork of the session, has `add_to_tile` called on it or on copies in
                other processes, each tile in one of them, and gives all that were written to.
            drive_id: Where it was seen.
            num_frames: Images that the parts hold.
            segments: Numbers of the parts.

        Raises:
            StoreError: If the commit fails; the map then stays as it was.
        """
        import zarr

        drives = {drive_id: {"num_frames": num_frames}}
        with self._writing() as session:
            session.merge(*write(session.fork()))
            group = zarr.open_group(session.store)
            _note_drives(session, group, drives, 1)
            listed = ", ".join(map(str, segments))
            version: str = session.commit(
                f"Add {drive_id}, segments {listed}",
                metadata={"drives": drives, "sign": 1, "segments": segments},
            )
        return version

    def subtract_counts(self, counts: CellCounts, drive_id: str) -> str:
        """Take counts of a drive out and commit; returns the version's id.

        Raises:
            MapMismatchError: If the map does not hold them.
            StoreError: If the commit fails; the map then stays as it was.
        """
        return self._apply_counts(counts, drive_id, -1, f"Take out {drive_id}", {})

    def replace(
        self,
        tiles: Iterator[tuple[TileIndex, Tile]],
        drives: Drives,
        message: str,
        metadata: dict[str, Any],
    ) -> str:
        """Write tiles as they are, in place of what is there, and commit; returns the version's id.

        Raises:
            StoreError: If the commit fails; the map then stays as it was.
        """
        import zarr

        with self._writing() as session:
            group = zarr.open_group(session.store)
            for index, tile in tiles:
                write_tile(group, index, tile)
            group.attrs["drives"] = drives
            group.attrs["num_tiles"] = len(listed_tiles(session))
            version: str = session.commit(message, metadata={"drives": {}} | metadata)
        return version

    def tiles(self, indices: Iterable[TileIndex]) -> Iterator[Tile]:
        """Some tiles, one after the other; without any evidence where the map holds none."""
        with self._reading():
            group = self._group()
        for index in indices:
            with self._reading(index):
                tile = read_tile(group, index)
            yield tile

    def damaged_tiles(self) -> dict[TileIndex, tuple[str, ...]]:
        """Tiles of which a chunk cannot be read, and which layers these are."""
        with self._reading():
            group = self._group()
        found = {}
        for index in self.tile_indices():
            layers = tuple(name for name in LAYERS if read_layer(group, name, index) is None)
            if layers:
                found[index] = layers
        return found

    def sound_layers(self, index: TileIndex) -> dict[str, NDArrayAny]:
        """The layers of a tile that can be read."""
        with self._reading():
            group = self._group()
        layers = {name: read_layer(group, name, index) for name in LAYERS}
        return {name: layer for name, layer in layers.items() if layer is not None}

    def merge(self, other: SemanticMap, name: str = "", *, allow_repeats: bool = False) -> str:
        """Add all that another map holds, tile by tile.

        Args:
            other: The map to add.
            name: What to call it in history and messages; its folder's name if empty.
            allow_repeats: Add a drive that is in the map already once more.

        Raises:
            MapMismatchError: If the maps are not compatible, or hold a drive in common.
        """
        self.meta.require_compatible(other.meta)
        theirs = other.drives

        def checked(held: Drives) -> Drives:
            common = sorted(held.keys() & theirs.keys())
            if common and not allow_repeats:
                raise MapMismatchError(
                    f"Both maps hold {', '.join(common)}; adding it twice would count it twice. "
                    "Subtract it from one of them first."
                )
            return theirs

        message = f"Merge {name or other.location.name}"
        return self._apply(other._all_tiles(), self._shift_mm(other.meta), 1, message, checked)

    def subtract(self, other: SemanticMap, name: str = "") -> str:
        """Take all that another map holds out of this one.

        Raises:
            MapMismatchError: If this map does not hold the other's drives and counts.
        """
        self.meta.require_compatible(other.meta)
        theirs, called = other.drives, name or other.location.name

        def checked(held: Drives) -> Drives:
            missing = sorted(theirs.keys() - held.keys())
            if missing:
                raise MapMismatchError(
                    f"{called} cannot be subtracted: it holds {', '.join(missing)}, which the map does "
                    f"not hold; the map holds {', '.join(sorted(held)) or 'no drive'}."
                )
            return theirs

        shift = self._shift_mm(other.meta)
        return self._apply(other._all_tiles(), shift, -1, f"Subtract {called}", checked)

    def _shift_mm(self, other: MapMeta) -> int:
        return round((other.reference_height_m - self.meta.reference_height_m) * 1000)

    def _all_tiles(self) -> Iterator[tuple[TileIndex, Tile]]:
        read = self._tile_reader()
        for index in self.tile_indices():
            tile = read(index)
            assert tile is not None
            yield index, tile

    def _tile_reader(self) -> Callable[[TileIndex], Tile | None]:
        present = set(self.tile_indices())
        with self._reading():
            group = self._group()

        def read(index: TileIndex) -> Tile | None:
            if index not in present:
                return None
            with self._reading(index):
                return read_tile(group, index)

        return read

    def _apply_counts(
        self, counts: CellCounts, drive_id: str, sign: int, message: str, more: dict[str, Any]
    ) -> str:
        self.meta.require_compatible(counts.meta)
        drives = {drive_id: {"num_frames": counts.num_frames}}
        tiles = ((i, counts.tiles[i]) for i in sorted(counts.tiles))
        shift = self._shift_mm(counts.meta)
        return self._apply(tiles, shift, sign, message, lambda _: drives, more)

    def _apply(
        self,
        tiles: Iterator[tuple[TileIndex, Tile]],
        shift_mm: int,
        sign: int,
        message: str,
        checked_drives: Callable[[Drives], Drives],
        more: dict[str, Any] | None = None,
    ) -> str:
        """Add (sign 1) or subtract tiles and commit; the drives are checked in the same session."""
        import zarr

        with self._writing() as session:
            group = zarr.open_group(session.store)
            drives = checked_drives(_drives_of(group))
            for index, tile in tiles:
                if not tile.is_empty:
                    held = read_tile(group, index)
                    shifted = shift_heights(tile, shift_mm)
                    write_tile(group, index, combine_tiles(held, shifted, sign, index))
            if drives:
                _note_drives(session, group, drives, sign)
            if not session.has_uncommitted_changes:
                return session.snapshot_id
            metadata = {"drives": drives, "sign": sign} | (more or {})
            version: str = session.commit(message, metadata=metadata)
            return version

    @contextmanager
    def _writing(self) -> Iterator[icechunk.Session]:
        """A session to write in and commit; discarded if that is refused."""
        if self._version is not None:
            raise StoreError(f"{self.location} is open at an old version, which cannot be changed.")
        failed = (
            f"Could not commit to {self.location}, the map is as it was before (check free space, and that no "
            "other process writes it)"
        )
        with store_errors(failed):
            session = self._repository.writable_session(self._branch)
            if self._expected not in (None, session.snapshot_id):
                raise StoreError(
                    f"Another process is making {self.location}; wait for it, or choose another name."
                )
            try:
                yield session
                if self._expected is not None:
                    self._expected = session.snapshot_id
            except HDMapError:
                session.discard_changes()
                raise

    @contextmanager
    def _reading(self, tile: TileIndex | None = None) -> Iterator[None]:
        failed = (
            f"The map at {self.location} is damaged or cannot be read; build it anew or take a copy"
        )
        if tile is not None:
            state = "is damaged" if isinstance(self.location, Path) else "cannot be read"
            failed = f"Tile {tile} of the map at {self.location} {state}; `hdmap build --repair` counts damaged ones again"
        with store_errors(failed):
            yield

    def _session(self) -> icechunk.Session:
        if self._version is None:
            return self._repository.readonly_session(self._branch)
        return self._repository.readonly_session(snapshot_id=self._version)

    def _group(self) -> zarr.Group:
        import zarr

        return zarr.open_group(self._session().store, mode="r")


def _drives_of(group: zarr.Group) -> Drives:
    return dict(group.attrs["drives"])  # type: ignore[arg-type]


def _note_drives(session: icechunk.Session, group: zarr.Group, changed: Drives, sign: int) -> None:
    """Bring what the group says of its drives and tiles up to what was written in the session."""
    group.attrs["drives"] = _changed_drives(_drives_of(group), changed, sign)
    group.attrs["num_tiles"] = len(listed_tiles(session))


def _changed_drives(held: Drives, changed: Drives, sign: int) -> Drives:
    result = dict(held)
    for drive_id, entry in changed.items():
        frames = result.get(drive_id, {}).get("num_frames", 0) + sign * entry["num_frames"]
        if frames > 0:
            result[drive_id] = {"num_frames": frames}
        else:
            result.pop(drive_id, None)
    return result
