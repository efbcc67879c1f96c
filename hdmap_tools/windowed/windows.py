"""Which windows a map is vectorized in: cores that tile it, each read with a margin around it.

Cores lie on the map's own lattice of tiles, so that adding to the map at one end moves none of
them; those without a tile are left out. The margin is what plugins must see beyond what they
answer for.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from hdmap_tools.fusion.cell_counts import TILE_CELLS, TileIndex, grid_of_tiles
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import Vectorizer

OVERLAP_M: Final = 10.0
"""So far beyond its core a window hands over lines, for its neighbours to tell which are the same."""

WHOLE_M: Final = 30.0
"""An area no longer than this is handed over whole by one window: no crosswalk is cut."""

WHOLE_UP_TO: Final = 2.0
"""A map of two windows and their margins in one piece takes little more memory, and half the time."""

_RIM_CELLS: Final = 16
"""Unknown cells kept around what is known, so that its edge is not the window's."""

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Window:
    """A part of the map.

    Attributes:
        core: What it answers for; None: all of the map.
        grid: What is read, core and margin, as far as there is anything.
        open_sides: West, south, east, north: no window answers for what lies beyond the core.
    """

    core: BevGrid | None
    grid: BevGrid
    open_sides: tuple[bool, bool, bool, bool] = (True, True, True, True)

    @property
    def line_bounds_m(self) -> Bounds | None:
        """(x0, y0, x1, y1) in which it hands over lines; None: everywhere."""
        if self.core is None:
            return None
        x0, y0, x1, y1 = self.core.bounds_m
        return x0 - OVERLAP_M, y0 - OVERLAP_M, x1 + OVERLAP_M, y1 + OVERLAP_M

    @property
    def area_bounds_m(self) -> Bounds | None:
        """(x0, y0, x1, y1) to which it cuts large areas: next to its neighbours, and on where there are none."""
        if self.core is None:
            return None
        west, south, east, north = (OVERLAP_M if side else 0.0 for side in self.open_sides)
        x0, y0, x1, y1 = self.core.bounds_m
        return x0 - west, y0 - south, x1 + east, y1 + north


def windows_of(
    tiles: Sequence[TileIndex],
    meta: MapMeta,
    *,
    window_m: float,
    margin_m: float,
    fill_cells: int,
    whole_up_to: float = WHOLE_UP_TO,
) -> tuple[Window, ...]:
    """The windows of a map, in a fixed order.

    Args:
        tiles: That hold evidence.
        meta: Of the map.
        window_m: Side of a core; made a whole number of tiles.
        margin_m: Read around each core.
        fill_cells: How far beyond evidence cells are filled.
        whole_up_to: A map with no more cells than so many windows with their margins is one.
    """
    whole = grid_of_tiles(tiles, meta)
    if whole is None:
        return (Window(None, BevGrid(meta.resolution_m, 0, 0, 1, 1, meta.frame)),)
    side = max(1, round(window_m / meta.resolution_m / TILE_CELLS))
    margin = math.ceil(margin_m / meta.resolution_m)
    rows, cols = whole.shape
    occupied = {(x // side, y // side) for x, y in tiles}
    if len(occupied) == 1 or rows * cols <= whole_up_to * (side * TILE_CELLS + 2 * margin) ** 2:
        return (Window(None, whole),)
    result = []
    for x, y in sorted(occupied):
        cells = side * TILE_CELLS
        core = BevGrid(
            meta.resolution_m, x * cells, y * cells, (x + 1) * cells, (y + 1) * cells, meta.frame
        )
        around = _common(core.expand(margin), whole)
        known = [c for c in (_common(around, _tile(t, meta)) for t in tiles) if 0 not in c.shape]
        seen = known[0]
        for other in known[1:]:
            seen = seen.union(other)
        beside = ((x - 1, y), (x, y - 1), (x + 1, y), (x, y + 1))
        west, south, east, north = (index not in occupied for index in beside)
        grid = _common(seen.expand(_RIM_CELLS + fill_cells), around)
        result.append(Window(core, grid, (west, south, east, north)))
    return tuple(result)


def margin_of(vectorizers: Iterable[type[Vectorizer]]) -> float:
    """What must be read around a core for these plugins, metres.

    Each must see right what it hands over beyond the core, and its own context around that;
    one that reads what others made needs theirs on top.

    Args:
        vectorizers: Required ones before those that require them.
    """
    context: dict[str, float] = {}
    margin = 0.0
    for one in vectorizers:
        below = max((context.get(name, 0.0) for name in one.requires), default=0.0)
        context[one.name] = one.halo_m + below
        has_areas = any(kind.geometry_type == "Polygon" for kind in one.element_types)
        margin = max(margin, context[one.name] + (WHOLE_M if has_areas else OVERLAP_M))
    return margin


def _tile(index: TileIndex, meta: MapMeta) -> BevGrid:
    x, y = index[0] * TILE_CELLS, index[1] * TILE_CELLS
    return BevGrid(meta.resolution_m, x, y, x + TILE_CELLS, y + TILE_CELLS, meta.frame)


def _common(a: BevGrid, b: BevGrid) -> BevGrid:
    """The cells that both hold; none if they lie apart."""
    x0, y0 = max(a.x_min, b.x_min), max(a.y_min, b.y_min)
    x1, y1 = max(min(a.x_max, b.x_max), x0), max(min(a.y_max, b.y_max), y0)
    return BevGrid(a.resolution_m, x0, y0, x1, y1, a.frame)
