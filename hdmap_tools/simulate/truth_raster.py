"""The true ground of a drive's surroundings as tiles on disk: what each 2 cm cell is, and how high.

Written and read tile by tile, so neither needs the whole in memory.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hdmap_tools.errors import FormatError, MapMismatchError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import IGNORE_ID, MAP_CLASSES, MapClass, load_label_set
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.scene import label_ids_by_material
from hdmap_tools.simulate.surface import CELL_M, TILE_CELLS, TILE_M, block_of_tile
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32, NDArrayInt

if TYPE_CHECKING:
    from hdmap_tools.simulate.build_scene import SceneBuilder
    from hdmap_tools.simulate.route import Route

INDEX_NAME: Final = "index.json"
LABEL_SET: Final = "paz2020"
REACH_M: Final = 45.0
"""The truth covers so much on each side of the route."""

NODE_M: Final = 0.2
"""Heights are stored at nodes so far apart; between them the ground bends by less than 0.2 mm."""

_NODES: Final = round(TILE_M / NODE_M) + 1

_CODES: Final = frozenset(map(int, Mat))

_ON_ROAD: Final = np.isin(
    np.arange(256),
    [
        Mat.ASPHALT,
        Mat.ASPHALT_PATCH,
        Mat.CONCRETE_ROAD,
        Mat.PAINT_WHITE,
        Mat.PAINT_YELLOW,
        Mat.ZEBRA_PAINT,
        Mat.ZEBRA_GAP,
        Mat.STOP_PAINT,
        Mat.SYMBOL_PAINT,
        Mat.MANHOLE,
    ],
)
"""Materials that lie at road height; all others are raised by their kerb."""


def write_truth_raster(
    folder: Path,
    builder: SceneBuilder,
    route: Route,
    reach_m: float = REACH_M,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write the ground around a route as tiles.

    Args:
        folder: Made if need be; gets ``index.json``, and for each tile a PNG of material
            codes and a NPY of heights, (2, 129, 129) float32: the terrain, and how much
            higher than it lies what is not road.
        builder: Of the scenes of the same drive, so that both are the same ground.
        route: Where the vehicle drives.
        reach_m: Tiles that come so near to it are written.
        progress: Told how many of how many tiles are done.
    """
    import cv2

    from hdmap_tools.simulate.build_scene import tiles_within

    folder.mkdir(parents=True, exist_ok=True)
    tiles = sorted(tiles_within(route.xy, reach_m))
    for k, (ix, iy) in enumerate(tiles):
        done, png = cv2.imencode(
            ".png", builder.tiles.tile(ix, iy).codes[::-1], [cv2.IMWRITE_PNG_COMPRESSION, 4]
        )
        if not done:  # pragma: no cover - an uint8 array always encodes
            raise FormatError(f"Cannot encode the truth tile {ix}, {iy} as PNG.")
        (folder / f"{_name(ix, iy)}.png").write_bytes(png.tobytes())
        np.save(folder / f"{_name(ix, iy)}.npy", _heights(builder, ix, iy))
        if progress is not None:
            progress(k + 1, len(tiles))
    frame = builder.world.frame
    names = load_label_set(LABEL_SET).names
    document = {
        "schema_version": 1,
        "cell_m": CELL_M,
        "tile_cells": TILE_CELLS,
        "node_m": NODE_M,
        "label_set": LABEL_SET,
        "materials": {str(int(mat)): mat.name.lower() for mat in Mat},
        "label_id_by_material": label_ids_by_material(names).tolist(),
        "frame": {
            "crs_wkt": frame.crs_wkt,
            "offset_m": list(frame.offset_m),
            "vertical_datum": frame.vertical_datum,
        },
        "tiles": [list(tile) for tile in tiles],
    }
    # Last, so that a folder with an index is whole.
    (folder / INDEX_NAME).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _heights(builder: SceneBuilder, ix: int, iy: int) -> NDArrayFloat32:
    k = np.arange(_NODES) * NODE_M
    x, y = np.meshgrid(ix * TILE_M + k, iy * TILE_M + k)
    xy = np.column_stack([x.ravel(), y.ravel()])
    area = builder.index.road_area(block_of_tile(ix, iy))
    both = np.stack([builder.terrain.height_at(xy), area.raise_at(xy)])
    return both.reshape(2, _NODES, _NODES).astype(np.float32)


def _name(ix: int, iy: int) -> str:
    return f"tile_{ix}_{iy}"


class TruthRaster:
    """Reads what `write_truth_raster` wrote; only the tiles last asked for are in memory.

    Attributes:
        folder: Where it lies.
        frame: The city frame of all positions.
        tiles: (ix, iy) of the tiles that there are.
    """

    def __init__(self, folder: Path, document: dict[str, Any]) -> None:
        frame = document["frame"]
        self.folder = folder
        self.frame = MapFrame(frame["crs_wkt"], tuple(frame["offset_m"]), frame["vertical_datum"])
        self.tiles = frozenset((int(ix), int(iy)) for ix, iy in document["tiles"])
        self.label_set = load_label_set(document["label_set"])
        self._label_ids = np.array(document["label_id_by_material"], dtype=np.uint8)
        self._codes: OrderedDict[tuple[int, int], NDArrayByte] = OrderedDict()
        self._nodes: OrderedDict[tuple[int, int], NDArrayFloat32] = OrderedDict()

    @classmethod
    def open(cls, folder: str | Path) -> TruthRaster:
        """The truth raster in a folder.

        Raises:
            FormatError: If it holds none, or one of another version or resolution.
        """
        folder = Path(folder)
        path = folder / INDEX_NAME
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            version = document["schema_version"]
            size = (document["cell_m"], document["tile_cells"], document["node_m"])
            if version != 1 or size != (CELL_M, TILE_CELLS, NODE_M):
                raise FormatError(
                    f"{path} is a truth raster of version {version} and size {size}; expected "
                    f"version 1 and {(CELL_M, TILE_CELLS, NODE_M)}. Simulate the drive again."
                )
            return cls(folder, document)
        except OSError as error:
            raise FormatError(
                f"{folder} holds no truth raster ({INDEX_NAME}: {error.strerror or error}); name the "
                "folder truth/raster of a simulated drive."
            ) from error
        except FormatError:
            raise
        except (ValueError, KeyError, TypeError) as error:
            raise FormatError(
                f"{path} is not the index of a truth raster ({type(error).__name__}: {error}); "
                "simulate the drive again."
            ) from error

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) of all tiles, city metres."""
        tiles = np.array(sorted(self.tiles)).reshape(-1, 2)
        if len(tiles) == 0:
            return 0.0, 0.0, 0.0, 0.0
        low, high = tiles.min(axis=0) * TILE_M, (tiles.max(axis=0) + 1) * TILE_M
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def codes(self, ix: int, iy: int) -> NDArrayByte:
        """(1280, 1280) material codes of a tile, row 0 the southernmost.

        Raises:
            FormatError: If the tile cannot be read.
        """
        codes: NDArrayByte = _remember(self._codes, (ix, iy), 16, self._read_codes)
        return codes

    def labels_at(self, xy: NDArrayFloat) -> NDArrayByte:
        """(N,) uint8 label ids of ``paz2020`` at city points (N, 2 or 3); 255 outside."""
        codes = self.codes_at(xy)
        return np.where(codes > 0, self._label_ids[codes], np.uint8(IGNORE_ID)).astype(np.uint8)

    def codes_at(self, xy: NDArrayFloat) -> NDArrayByte:
        """(N,) uint8 material codes at city points (N, 2 or 3); 0 outside."""
        cells = np.floor(np.asarray(xy, dtype=np.float64)[:, :2] / CELL_M).astype(np.int64)
        result = np.zeros(len(cells), dtype=np.uint8)
        for tile, members in self._by_tile(cells // TILE_CELLS):
            inside = cells[members] - np.array(tile) * TILE_CELLS
            result[members] = self.codes(*tile)[inside[:, 1], inside[:, 0]]
        return result

    def height_at(self, xy: NDArrayFloat) -> NDArrayFloat:
        """(N,) metres of the ground at city points (N, 2 or 3): kerbs raised; NaN outside."""
        xy = np.asarray(xy, dtype=np.float64)[:, :2]
        is_road = _ON_ROAD[self.codes_at(xy)]
        result = np.full(len(xy), np.nan)
        cells = np.floor(xy / CELL_M).astype(np.int64)
        for tile, members in self._by_tile(cells // TILE_CELLS):
            nodes = _remember(self._nodes, tile, 32, self._read_nodes)
            at = (xy[members] - np.array(tile) * TILE_M) / NODE_M
            base = np.clip(np.floor(at).astype(np.int64), 0, _NODES - 2)
            u, v = (np.clip(at - base, 0.0, 1.0)).T
            c, r = base.T
            south = nodes[:, r, c] * (1 - u) + nodes[:, r, c + 1] * u
            north = nodes[:, r + 1, c] * (1 - u) + nodes[:, r + 1, c + 1] * u
            ground, lift = south * (1 - v) + north * v
            result[members] = ground + np.where(is_road[members], 0.0, lift)
        return result

    def class_fractions(
        self, grid: BevGrid, classes: Sequence[MapClass] = MAP_CLASSES
    ) -> NDArrayFloat32:
        """(class, y, x) float32 share 0..1 of each cell of a grid that is each class of the map.

        Exact: cells of 2 cm are counted. What lies outside the truth counts as no class;
        `known_fraction` tells it from ground that is none of the classes.

        Args:
            grid: Of any resolution that is a whole number of 2 cm cells.
            classes: Which classes, in the order of the result.

        Raises:
            MapMismatchError: If the resolution is none, or the frame another one.
        """
        return self.shares(grid, classes)[0]

    def shares(
        self, grid: BevGrid, classes: Sequence[MapClass] = MAP_CLASSES
    ) -> tuple[NDArrayFloat32, NDArrayFloat32]:
        """`class_fractions` (class, y, x) and `known_fraction` (y, x), read in one pass.

        Args:
            grid: Of any resolution that is a whole number of 2 cm cells.
            classes: Which classes, in the order of the result.

        Raises:
            MapMismatchError: If the resolution is none, or the frame another one.
        """
        # The last kind is known ground that is none of the classes.
        kinds = np.full(256, len(classes), dtype=np.uint8)
        kinds[0] = 255
        for k, map_class in enumerate(classes):
            ids = self.label_set.ids_of_class(MapClass(map_class))
            kinds[1:][np.isin(self._label_ids[1:], ids)] = k
        counts, block = self._counts(grid, kinds, len(classes) + 1)
        known = counts.sum(axis=0, dtype=np.int32)
        return _share(counts[:-1], block), _share(known, block)

    def known_fraction(self, grid: BevGrid) -> NDArrayFloat32:
        """(y, x) float32 share of each cell of a grid that the truth covers."""
        return self.shares(grid, ())[1]

    def _counts(self, grid: BevGrid, kinds: NDArrayByte, count: int) -> tuple[NDArrayAny, int]:
        """(kind, y, x) int32 cells of each kind in each of a grid's, and how many one holds."""
        from hdmap_tools.simulate.truth_kernels import count_into

        n = round(grid.resolution_m / CELL_M)
        if n < 1 or abs(n * CELL_M - grid.resolution_m) > 1e-9:
            raise MapMismatchError(
                f"The truth has cells of {CELL_M} m, so a grid's resolution must be a multiple of "
                f"that; found {grid.resolution_m} m."
            )
        self.frame.require_same(grid.frame)
        counts = np.zeros((count, *grid.shape), dtype=np.int32)
        for ix, iy in sorted(self.tiles):
            x0, x1 = _cells_in_tile(ix, grid.x_min, grid.x_max, n)
            y0, y1 = _cells_in_tile(iy, grid.y_min, grid.y_max, n)
            if x1 <= x0 or y1 <= y0:
                continue
            codes = self.codes(ix, iy)[
                y0 - iy * TILE_CELLS : y1 - iy * TILE_CELLS,
                x0 - ix * TILE_CELLS : x1 - ix * TILE_CELLS,
            ]
            count_into(counts, codes, kinds, y0 - grid.y_min * n, x0 - grid.x_min * n, n)
        return counts, n * n

    def _by_tile(self, tiles: NDArrayInt) -> list[tuple[tuple[int, int], NDArrayInt]]:
        """Tiles that there are, each with which of the points (N, 2) of tile numbers are its."""
        found: list[tuple[tuple[int, int], NDArrayInt]] = []
        if len(tiles) == 0:
            return found
        unique, inverse = np.unique(tiles, axis=0, return_inverse=True)
        order = np.argsort(inverse.ravel(), kind="stable")
        bounds = np.searchsorted(inverse.ravel()[order], np.arange(len(unique) + 1))
        for k, (ix, iy) in enumerate(unique.tolist()):
            if (ix, iy) in self.tiles:
                found.append(((ix, iy), order[bounds[k] : bounds[k + 1]]))
        return found

    def _read_codes(self, tile: tuple[int, int]) -> NDArrayByte:
        import cv2

        path = self.folder / f"{_name(*tile)}.png"
        codes = None
        if path.is_file():
            data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
            codes = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
        if codes is None or codes.shape != (TILE_CELLS, TILE_CELLS) or codes.dtype != np.uint8:
            raise FormatError(
                f"{path} is missing or no truth tile of {TILE_CELLS} cells; simulate the drive again."
            )
        if found := set(np.flatnonzero(np.bincount(codes.ravel())).tolist()) - _CODES:
            raise FormatError(
                f"{path} holds unknown codes {sorted(found)}; simulate the drive again."
            )
        return np.ascontiguousarray(codes[::-1])

    def _read_nodes(self, tile: tuple[int, int]) -> NDArrayFloat32:
        path = self.folder / f"{_name(*tile)}.npy"
        try:
            nodes: NDArrayFloat32 = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FormatError(
                f"{path} is missing or no tile of heights; simulate the drive again."
            ) from error
        if nodes.shape != (2, _NODES, _NODES):
            raise FormatError(
                f"{path} holds heights of shape {nodes.shape}, expected {(2, _NODES, _NODES)}; "
                "simulate the drive again."
            )
        return nodes


def _share(counts: NDArrayAny, block: int) -> NDArrayFloat32:
    share: NDArrayFloat32 = (counts / np.float32(block)).astype(np.float32)
    return share


def _remember(
    kept: OrderedDict[tuple[int, int], Any],
    tile: tuple[int, int],
    most: int,
    read: Callable[[tuple[int, int]], Any],
) -> Any:
    if tile not in kept:
        kept[tile] = read(tile)
        if len(kept) > most:
            kept.popitem(last=False)
    kept.move_to_end(tile)
    return kept[tile]


def _cells_in_tile(tile: int, low: int, high: int, n: int) -> tuple[int, int]:
    """2 cm cells along one axis that lie both in a tile and in a grid's cells low..high."""
    return max(tile * TILE_CELLS, low * n), min((tile + 1) * TILE_CELLS, high * n)
