"""What became of a map: compare its versions, go back to one, take one drive out again.

Counts are sums, so what a drive added is the difference that its commits made, and taking
it out is a subtraction: nothing has to be built anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.errors import MapMismatchError, StoreError
from hdmap_tools.fusion.cell_counts import LAYERS, CellCounts, Tile, TileIndex
from hdmap_tools.fusion.semantic_map import ROLLED_BACK_TO, SemanticMap, Version
from hdmap_tools.types import NDArrayAny

_MIN_PREFIX: Final = 4


@dataclass(frozen=True)
class MapChanges:
    """How one version of a map differs from an earlier or later one.

    Attributes:
        frames: By drive id, frames more (or less, negative) than before; those that changed.
        tiles: By tile index, cells whose counts differ.
        votes: Votes more (or less) than before, over all cells.
    """

    frames: dict[str, int]
    tiles: dict[TileIndex, int]
    votes: int

    @property
    def num_cells(self) -> int:
        """Cells whose counts differ."""
        return sum(self.tiles.values())


def find_version(semantic_map: SemanticMap, name: str) -> Version:
    """A version by its id, the beginning of it, or how many commits ago it was (``0`` is the newest).

    Raises:
        StoreError: If there is none, or more than one that begins so.
    """
    versions = semantic_map.history()
    if name.isdecimal() and int(name) < len(versions):
        return versions[int(name)]
    found = [v for v in versions if len(name) >= _MIN_PREFIX and v.id.startswith(name)]
    if len(found) == 1:
        return found[0]
    why = f"{len(found)} versions begin so" if found else f"it has {len(versions)} versions"
    raise StoreError(
        f"The map at {semantic_map.location} has no version {name!r}: {why}. `hdmap history` lists them; "
        f"give at least {_MIN_PREFIX} characters of an id, or a number of commits back."
    )


def changes_between(semantic_map: SemanticMap, before: Version, after: Version) -> MapChanges:
    """What differs between two versions."""
    old = SemanticMap.open(semantic_map.location, before.id)
    new = SemanticMap.open(semantic_map.location, after.id)
    frames = {
        drive: difference
        for drive in sorted(old.drives.keys() | new.drives.keys())
        if (difference := _frames(new, drive) - _frames(old, drive))
    }
    tiles: dict[TileIndex, int] = {}
    votes = 0
    for index, mine, theirs in _both(old, new):
        differs = np.zeros(mine.layers["height_n"].shape, np.bool_)
        for name in LAYERS:
            unlike = mine.layers[name] != theirs.layers[name]
            differs |= unlike.reshape(-1, *differs.shape).any(axis=0)
        if differs.any():
            tiles[index] = int(differs.sum())
        votes += int(theirs.layers["counts"].sum(dtype=np.int64))
        votes -= int(mine.layers["counts"].sum(dtype=np.int64))
    return MapChanges(frames, tiles, votes)


def roll_back(semantic_map: SemanticMap, version: Version) -> str:
    """Make a new version that equals an earlier one; returns its id. Nothing is lost by it.

    Raises:
        StoreError: If the map cannot be read or written.
    """
    earlier = SemanticMap.open(semantic_map.location, version.id)
    tiles = ((index, theirs) for index, _, theirs in _both(semantic_map, earlier))
    message = f"Roll back to {version.id} ({version.message})"
    return semantic_map.replace(tiles, earlier.drives, message, {ROLLED_BACK_TO: version.id})


def take_out(semantic_map: SemanticMap, drive_id: str) -> str:
    """Subtract what a drive added, in a new version; returns its id.

    Raises:
        MapMismatchError: As `drive_without_others`.
        StoreError: If the map cannot be read or written.
    """
    counts = CellCounts(semantic_map.meta)
    counts.tiles = drive_without_others(semantic_map, drive_id)
    counts.num_frames = _frames(semantic_map, drive_id)
    return semantic_map.subtract_counts(counts, drive_id)


def drive_without_others(semantic_map: SemanticMap, drive_id: str) -> dict[TileIndex, Tile]:
    """What a drive added, tile by tile, from the commits that added it.

    Raises:
        MapMismatchError: If the map does not hold the drive, or some commit added it together
            with others.
    """
    held = semantic_map.drives
    if drive_id not in held:
        raise MapMismatchError(
            f"The map at {semantic_map.location} does not hold {drive_id!r}; it holds "
            f"{', '.join(sorted(held)) or 'no drive'}."
        )
    total: dict[TileIndex, dict[str, NDArrayAny]] = {}
    for before, after in _steps(semantic_map):
        drives = after.metadata.get("drives", {})
        if drive_id not in drives:
            continue
        if len(drives) > 1:
            raise MapMismatchError(
                f"Version {after.id} ({after.message}) changed {drive_id} together with others, so what it "
                "added alone is not known; build its map and subtract that (`hdmap merge --subtract`)."
            )
        old = SemanticMap.open(semantic_map.location, before.id)
        new = SemanticMap.open(semantic_map.location, after.id)
        for index, mine, theirs in _both(old, new):
            # Signed: the drive may have been taken out and added again.
            added = {n: theirs.layers[n].astype(np.int64) - mine.layers[n] for n in LAYERS}
            held_so_far = total.get(index)
            if held_so_far is not None:
                added = {n: layer + held_so_far[n] for n, layer in added.items()}
            total[index] = added
    return {
        index: Tile({n: layers[n].astype(LAYERS[n]) for n in LAYERS})
        for index, layers in total.items()
        if any(layer.any() for layer in layers.values())
    }


def _steps(semantic_map: SemanticMap) -> Iterator[tuple[Version, Version]]:
    """Commits that the newest version consists of, as version before and after; newest first."""
    versions = semantic_map.history()
    place = {version.id: number for number, version in enumerate(versions)}
    number = 0
    while number + 1 < len(versions):
        after = versions[number]
        # What was rolled back is no part of what came of it.
        back_to = after.metadata.get(ROLLED_BACK_TO)
        if back_to is None:
            yield versions[number + 1], after
            number += 1
        else:
            number = place[back_to]


def _both(one: SemanticMap, other: SemanticMap) -> Iterator[tuple[TileIndex, Tile, Tile]]:
    """Tiles of two versions side by side, those that either holds; empty where one has none."""
    indices = sorted({*one.tile_indices(), *other.tile_indices()})
    yield from zip(indices, one.tiles(indices), other.tiles(indices), strict=True)


def _frames(semantic_map: SemanticMap, drive_id: str) -> int:
    entry = semantic_map.drives.get(drive_id, {"num_frames": 0})
    return int(entry["num_frames"])
