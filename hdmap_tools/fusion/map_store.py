"""A map's arrays in an Icechunk repository: where they lie, their layout, reading and writing of tiles.

One array a layer of `cell_counts.LAYERS`, spanning `LATTICE_CELLS` a side with a chunk a
tile, so that only tiles with evidence take space. Chunks carry checksums: a damaged one is an
error, never a wrong count.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hdmap_tools.errors import HDMapError, StoreError
from hdmap_tools.fusion.cell_counts import (
    LATTICE_CELLS,
    LAYERS,
    TILE_CELLS,
    Tile,
    TileIndex,
    combine_tiles,
)
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.s3_errors import is_outage
from hdmap_tools.types import NDArrayAny

if TYPE_CHECKING:
    import icechunk
    import zarr

_CODE: Final = re.compile(r'code: "([^"]+)"(?:, message: "([^"]+)")?')
"""In an answer of S3."""
_HALF: Final = LATTICE_CELLS // 2
_REQUIRED_FOLDERS: Final = {"refs", "snapshots"}
_KNOWN_FOLDERS: Final = _REQUIRED_FOLDERS | {"chunks", "manifests", "transactions", "config.yaml"}


def is_semantic_map(path: Path) -> bool:
    """Whether a folder is a map's repository and holds nothing else."""
    if not path.is_dir():
        return False
    try:
        found = {entry.name for entry in path.iterdir()}
    except OSError:
        return False
    return found >= _REQUIRED_FOLDERS and found <= _KNOWN_FOLDERS


def quiet_icechunk() -> ModuleType:
    """The library, told to keep its log to itself.

    It warns at every local store, and on errors prints what it also raises.
    """
    import icechunk

    icechunk.set_logs_filter("off")
    return icechunk


@contextmanager
def store_errors(what: str) -> Iterator[None]:
    """Turn whatever the store's libraries raise into one line that starts with `what`."""
    import icechunk
    from zarr.errors import BaseZarrError

    try:
        yield
    except HDMapError:
        raise
    except (
        OSError,
        KeyError,
        ValueError,
        TypeError,
        RuntimeError,
        BaseZarrError,
        icechunk.IcechunkError,
        icechunk.ConflictError,
    ) as error:
        raise StoreError(f"{what}: {root_cause(error)}.") from error


def make_arrays(group: zarr.Group, meta: MapMeta) -> None:
    """Make a map's arrays, empty, in its group."""
    from zarr.codecs import ZstdCodec

    for name, dtype in LAYERS.items():
        lead = (len(meta.label_set), meta.num_bins) if name == "counts" else ()
        group.create_array(
            name,
            shape=(*lead, LATTICE_CELLS, LATTICE_CELLS),
            chunks=(*lead, TILE_CELLS, TILE_CELLS),
            dtype=dtype,
            fill_value=0,
            compressors=ZstdCodec(level=1, checksum=True),
        )


def listed_tiles(session: icechunk.Session) -> tuple[TileIndex, ...]:
    """Tiles in a session's index; a height comes with every observation, so its chunks are the tiles."""
    from zarr.core.sync import sync

    async def listed() -> set[TileIndex]:
        return {
            (c[-1] - _HALF // TILE_CELLS, c[-2] - _HALF // TILE_CELLS)
            async for c in session.chunk_coordinates("/height_n")
        }

    return tuple(sorted(sync(listed())))


def _region(index: TileIndex) -> tuple[slice, slice]:
    x, y = index[0] * TILE_CELLS + _HALF, index[1] * TILE_CELLS + _HALF
    return slice(y, y + TILE_CELLS), slice(x, x + TILE_CELLS)


def _arrays(group: zarr.Group) -> Iterator[tuple[str, Any]]:
    for name in LAYERS:
        yield name, group[name]


def read_tile(group: zarr.Group, index: TileIndex) -> Tile:
    """One tile of a map's group; zeros where nothing was written."""
    rows, cols = _region(index)
    return Tile({name: array[..., rows, cols] for name, array in _arrays(group)})


def read_layer(group: zarr.Group, name: str, index: TileIndex) -> NDArrayAny | None:
    """One layer of a tile; None if its chunk is damaged or gone.

    Raises:
        StoreError: If it cannot be told, as its storage cannot be reached.
    """
    rows, cols = _region(index)
    try:
        with store_errors(f"Layer {name} of tile {index} cannot be read"):
            array: Any = group[name]
            return np.asarray(array[..., rows, cols])
    except StoreError as error:
        if is_outage(str(error.__cause__)):
            raise
        return None


def write_tile(group: zarr.Group, index: TileIndex, tile: Tile) -> None:
    """Write one tile as it is, in place of what is there."""
    rows, cols = _region(index)
    for name, array in _arrays(group):
        array[..., rows, cols] = tile.layers[name]


def add_to_tile(fork: Any, index: TileIndex, parts: Iterable[Tile]) -> None:
    """Add counts to a tile in a fork of a map's session (`SemanticMap.add_by_workers`).

    Raises:
        MapMismatchError: If a count overflows.
    """
    import zarr

    group = zarr.open_group(fork.store)
    total = read_tile(group, index)
    for part in parts:
        total = combine_tiles(total, part, 1, index)
    write_tile(group, index, total)


def root_cause(error: BaseException) -> str:
    """The words of a library's message that say most, in one line, without its decoration."""
    lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    # Icechunk draws the chain of causes below its message; the last one is the deepest.
    _, is_chain, deepest = lines[-1].partition("`-> ")
    if is_chain and (told := _CODE.search(deepest)):
        return ": ".join(part for part in told.groups() if part).rstrip(".")
    first = lines[0].strip().removeprefix("x ").strip().rstrip(".")[:200]
    deepest = deepest.strip().rstrip(".")[:200]
    return first if not deepest or deepest in first else f"{first}: {deepest}"
