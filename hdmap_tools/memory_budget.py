"""What a build may keep in memory: shared out between points and counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from hdmap_tools.errors import ConfigError
from hdmap_tools.fusion.cell_counts import TILE_CELLS, Tile
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.point_blocks import POINTS_BYTES

_ITSELF_BYTES: Final = 600 * 10**6
"""The program with its libraries, sweeps, images and what it reads ahead: measured, 450 MB."""
_TILES_AT_ONCE: Final = 4
"""A tile that is read, added to and written is there three times."""


@dataclass(frozen=True)
class MemoryBudget:
    """A limit for the whole process.

    Attributes:
        total_bytes: Of memory.
    """

    total_bytes: int

    @property
    def points_bytes(self) -> int:
        """Of points of the point map, as the engine keeps them."""
        return min(POINTS_BYTES, self._left // 4)

    def tiles_bytes(self, meta: MapMeta) -> int:
        """Of tiles with counts.

        Raises:
            ConfigError: If too little is left for tiles with that many labels.
        """
        tile = TILE_CELLS**2 * Tile.zeros(len(meta.label_set), meta.num_bins, (1, 1)).num_bytes
        found = self._left - self.points_bytes - _TILES_AT_ONCE * tile
        if found < tile:
            least = (_ITSELF_BYTES + (_TILES_AT_ONCE + 1) * tile * 4 // 3) / 1e6
            raise ConfigError(
                f"{self.total_bytes / 1e6:.0f} MB of memory are too few: a tile with {len(meta.label_set)} "
                f"labels takes {tile / 1e6:.0f} MB; allow at least {least:.0f} MB (--memory)."
            )
        return found

    @property
    def _left(self) -> int:
        return max(0, self.total_bytes - _ITSELF_BYTES)
