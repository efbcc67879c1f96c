"""Tiles of which only those used last are in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any

import numpy as np

from hdmap_tools.fusion.cell_counts import Tile, TileIndex


class TilesOnDisk(MutableMapping[TileIndex, Tile]):
    """A mapping of tiles that puts those aside that were not asked for lately.

    A tile may be changed until the next one is asked for.

    Args:
        folder: For tiles put aside; must exist, and belong to this mapping alone.
        max_bytes: Of tiles in memory; the one asked for last always is.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self._folder, self._max_bytes = folder, max_bytes
        self._recent: OrderedDict[TileIndex, Tile] = OrderedDict()
        self._aside: set[TileIndex] = set()
        self._num_bytes = 0

    def __getitem__(self, index: TileIndex) -> Tile:
        tile = self._recent.get(index)
        if tile is not None:
            self._recent.move_to_end(index)
            return tile
        if index not in self._aside:
            raise KeyError(index)
        with np.load(self._path(index)) as stored:
            tile = Tile(dict(stored))
        self[index] = tile
        return tile

    def __setitem__(self, index: TileIndex, tile: Tile) -> None:
        self._forget(index)
        self._recent[index] = tile
        self._num_bytes += tile.num_bytes
        while self._num_bytes > self._max_bytes and len(self._recent) > 1:
            oldest, left = self._recent.popitem(last=False)
            self._num_bytes -= left.num_bytes
            layers: dict[str, Any] = left.layers
            np.savez(self._path(oldest), **layers)
            self._aside.add(oldest)

    def __delitem__(self, index: TileIndex) -> None:
        if index not in self._recent and index not in self._aside:
            raise KeyError(index)
        self._forget(index)

    def __iter__(self) -> Iterator[TileIndex]:
        return iter({**dict.fromkeys(self._aside), **dict.fromkeys(self._recent)})

    def __len__(self) -> int:
        return len(self._aside | self._recent.keys())

    def _forget(self, index: TileIndex) -> None:
        tile = self._recent.pop(index, None)
        if tile is not None:
            self._num_bytes -= tile.num_bytes
        self._aside.discard(index)

    def _path(self, index: TileIndex) -> Path:
        return self._folder / f"{index[0]}_{index[1]}.npz"
