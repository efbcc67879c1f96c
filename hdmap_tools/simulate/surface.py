"""What the ground is made of, in tiles of 2 cm cells that depend on nothing but the place."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.map_model.elements import MarkColor
from hdmap_tools.simulate.location_noise import Purpose, rng_at, value_noise
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.road_area import BLOCK_M, RoadArea, WorldIndex
from hdmap_tools.simulate.road_paint import (
    ZEBRA_STRIPE_M,
    arrow_polygon,
    line_quads,
    stop_line_quads,
)
from hdmap_tools.simulate.scan_fill import fill_area, fill_quads, only_on
from hdmap_tools.simulate.scene import SurfaceRaster
from hdmap_tools.simulate.settings import Difficulty, SimulationSettings
from hdmap_tools.simulate.world_map import LineKind, WorldLane, WorldLine
from hdmap_tools.types import NDArrayByte, NDArrayFloat

CELL_M: Final = 0.02
TILE_CELLS: Final = 1280
TILE_M: Final = 25.6

KERB_WIDTH_M: Final = 0.15

_ROAD_CODES: Final = (Mat.ASPHALT, Mat.ASPHALT_PATCH, Mat.CONCRETE_ROAD, Mat.MANHOLE)
_PAINTS: Final = (
    Mat.PAINT_WHITE,
    Mat.PAINT_YELLOW,
    Mat.STOP_PAINT,
    Mat.SYMBOL_PAINT,
    Mat.ZEBRA_PAINT,
)

_WEAR: Final = {
    # least share of paint left, how much less in the wheel tracks, share of worn stretches
    Difficulty.EASY: (0.92, 0.05, 0.0),
    Difficulty.DEFAULT: (0.62, 0.15, 0.35),
    Difficulty.HARD: (0.30, 0.30, 0.70),
}
_PATCHES: Final = {Difficulty.EASY: 0.03, Difficulty.DEFAULT: 0.12, Difficulty.HARD: 0.30}
"""Chance that a cell of 12 m holds a patch of new asphalt."""


@dataclass(frozen=True, eq=False)
class SurfaceTile:
    """One tile: (1280, 1280) uint8 codes and wear, as `SurfaceRaster`."""

    codes: NDArrayByte
    wear: NDArrayByte


class SurfaceTiles:
    """Tiles of the ground of a world, made when asked for; the last ones are kept.

    Attributes:
        index: The world.
        settings: Seed and difficulty decide wear and patches.
    """

    def __init__(
        self, index: WorldIndex, settings: SimulationSettings, keep_tiles: int = 80
    ) -> None:
        self.index = index
        self.settings = settings
        self._keep = keep_tiles
        self._tiles: OrderedDict[tuple[int, int], SurfaceTile] = OrderedDict()

    def tile(self, ix: int, iy: int) -> SurfaceTile:
        """The tile whose south-west corner is (ix, iy) · 25.6 m."""
        key = (ix, iy)
        if key not in self._tiles:
            self._tiles[key] = self._make(ix, iy)
            if len(self._tiles) > self._keep:
                self._tiles.popitem(last=False)
        self._tiles.move_to_end(key)
        return self._tiles[key]

    def raster(self, tiles: set[tuple[int, int]]) -> SurfaceRaster:
        """Some tiles on one grid; cells of the others are 0, of which nothing is said."""
        xs, ys = [t[0] for t in tiles], [t[1] for t in tiles]
        x0, y0 = min(xs), min(ys)
        grid = BevGrid(
            CELL_M,
            x0 * TILE_CELLS,
            y0 * TILE_CELLS,
            (max(xs) + 1) * TILE_CELLS,
            (max(ys) + 1) * TILE_CELLS,
            self.index.world.frame,
        )
        codes = np.zeros(grid.shape, dtype=np.uint8)
        wear = np.full(grid.shape, 255, dtype=np.uint8)
        for ix, iy in sorted(tiles):
            tile = self.tile(ix, iy)
            rows = slice((iy - y0) * TILE_CELLS, (iy - y0 + 1) * TILE_CELLS)
            cols = slice((ix - x0) * TILE_CELLS, (ix - x0 + 1) * TILE_CELLS)
            codes[rows, cols] = tile.codes
            wear[rows, cols] = tile.wear
        return SurfaceRaster(grid, codes, wear)

    def _make(self, ix: int, iy: int) -> SurfaceTile:
        corner = (ix * TILE_M, iy * TILE_M)
        box = shapely.box(corner[0], corner[1], corner[0] + TILE_M, corner[1] + TILE_M)
        area = self.index.road_area(block_of_tile(ix, iy))
        codes = self._ground_cover(corner, ix, iy)
        self._beside_the_road(codes, corner, box, area)
        road = shapely.intersection(area.drivable, box.buffer(0.1, join_style="mitre"))
        wear = np.full(codes.shape, 255, dtype=np.uint8)
        if not road.is_empty:
            fill_area(codes, road, corner, CELL_M, Mat.ASPHALT)
            self._patches(codes, corner, ix, iy)
            self._paint(codes, corner, box)
            self._wear(codes, wear, corner, box)
        for array in (codes, wear):
            array.setflags(write=False)
        return SurfaceTile(codes, wear)

    def _ground_cover(self, corner: tuple[float, float], ix: int, iy: int) -> NDArrayByte:
        """Lawn with stretches of gravel and earth."""
        step, repeat = 0.16, 8
        k = np.arange(TILE_CELLS // repeat)
        x, y = np.meshgrid(corner[0] + (k + 0.5) * step, corner[1] + (k + 0.5) * step)
        xy = np.column_stack([x.ravel(), y.ravel()])
        seed = self.settings.place_seed
        noise = 0.75 * value_noise(xy, 22.0, seed, Purpose.GROUND_COVER)
        noise += 0.25 * value_noise(xy, 3.0, seed, Purpose.GROUND_COVER, 1)
        codes = np.full(len(xy), Mat.GRASS, dtype=np.uint8)
        codes[noise > 0.80] = Mat.GRAVEL
        codes[noise < 0.18] = Mat.SOIL
        small = codes.reshape(len(k), len(k))
        return np.repeat(np.repeat(small, repeat, axis=0), repeat, axis=1)

    def _beside_the_road(
        self, codes: NDArrayByte, corner: tuple[float, float], box: BaseGeometry, area: RoadArea
    ) -> None:
        """Pavements and kerbs, and what areas the map itself knows."""
        world = self.index.world
        for name, mat in (
            ("vegetation", Mat.GRASS),
            ("island", Mat.GRASS),
            ("building", Mat.SIDEWALK),
            ("sidewalk", Mat.SIDEWALK),
        ):
            for polygon in world.areas.get(name, ()):
                if polygon.intersects(box):
                    fill_area(codes, polygon, corner, CELL_M, mat)
        near = shapely.intersection(area.drivable, box.buffer(6.0, join_style="mitre"))
        if near.is_empty:
            return
        width_m = sidewalk_width(corner, self.settings.place_seed)
        if width_m > 0:
            fill_area(codes, near.buffer(KERB_WIDTH_M + width_m), corner, CELL_M, Mat.SIDEWALK)
        fill_area(codes, near.buffer(KERB_WIDTH_M), corner, CELL_M, Mat.KERB)

    def _patches(self, codes: NDArrayByte, corner: tuple[float, float], ix: int, iy: int) -> None:
        seed, chance = self.settings.place_seed, _PATCHES[self.settings.difficulty]
        cell = 12.8
        quads, covers = [], []
        for cx in range(2 * ix - 1, 2 * ix + 3):
            for cy in range(2 * iy - 1, 2 * iy + 3):
                rng = rng_at(seed, Purpose.PATCH, cx, cy)
                centre = (np.array([cx, cy]) + rng.uniform(0, 1, 2)) * cell
                size, angle = rng.uniform((0.5, 0.8), (2.2, 5.0)), rng.uniform(0, np.pi)
                u = np.array([np.cos(angle), np.sin(angle)]) * size[1] / 2
                v = np.array([-np.sin(angle), np.cos(angle)]) * size[0] / 2
                if rng.uniform() < chance:
                    quads.append([centre + u + v, centre - u + v, centre - u - v, centre + u - v])
                if rng.uniform() < 0.35:
                    at = (np.array([cx, cy]) + rng.uniform(0, 1, 2)) * cell
                    turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
                    covers.append(at + 0.32 * np.column_stack([np.cos(turn), np.sin(turn)]))
        on_asphalt = only_on(Mat.ASPHALT)
        if quads:
            fill_quads(codes, np.array(quads), corner, CELL_M, Mat.ASPHALT_PATCH, on_asphalt)
        if covers:
            fill_quads(codes, np.array(covers), corner, CELL_M, Mat.MANHOLE, on_asphalt)

    def _paint(self, codes: NDArrayByte, corner: tuple[float, float], box: BaseGeometry) -> None:
        on_road = only_on(*_ROAD_CODES)
        near = box.buffer(0.6, join_style="mitre")
        for k in self.index.lines_near(near):
            line = self.index.lines[k]
            if line.kind == LineKind.PAINT and line.paint is not None:
                yellow = line.paint.color == MarkColor.YELLOW
                mat = Mat.PAINT_YELLOW if yellow else Mat.PAINT_WHITE
                quads = line_quads(line.xy, line.paint, self.phases[line.id])
                fill_quads(codes, quads, corner, CELL_M, mat, on_road)
        stops = self.index.stop_line_tree.query(box.buffer(12.0), predicate="intersects")
        for k in np.sort(stops):
            line = self.index.world.stop_lines[k]
            on_stop = only_on(*_ROAD_CODES, Mat.PAINT_WHITE, Mat.PAINT_YELLOW)
            fill_quads(codes, stop_line_quads(line), corner, CELL_M, Mat.STOP_PAINT, on_stop)
            for arrow in self.arrows.get(int(k), ()):
                fill_area(codes, arrow, corner, CELL_M, Mat.SYMBOL_PAINT, on_road)
        for k in np.sort(self.index.crosswalk_tree.query(box, predicate="intersects")):
            self._zebra(codes, corner, int(k))

    def _zebra(self, codes: NDArrayByte, corner: tuple[float, float], k: int) -> None:
        """Stripes along the driving direction over the whole area of a crossing."""
        crossing = self.index.world.crosswalks[k]
        on_road = only_on(*_ROAD_CODES, Mat.PAINT_WHITE, Mat.PAINT_YELLOW, Mat.SYMBOL_PAINT)
        fill_area(codes, crossing, corner, CELL_M, Mat.ZEBRA_GAP, on_road)
        ahead = self.crossing_directions[k]
        across = np.array([-ahead[1], ahead[0]])
        centre = np.array([crossing.centroid.x, crossing.centroid.y])
        reach = float(np.linalg.norm(np.ptp(shapely.get_coordinates(crossing), axis=0)))
        n = int(reach / ZEBRA_STRIPE_M) + 2
        starts = (np.arange(-n, n, 2) - 0.5) * ZEBRA_STRIPE_M
        left = centre + np.outer(starts, across)
        right = centre + np.outer(starts + ZEBRA_STRIPE_M, across)
        quads = np.stack(
            [
                left - reach * ahead,
                right - reach * ahead,
                right + reach * ahead,
                left + reach * ahead,
            ],
            axis=1,
        )
        # Other crossings' cells are gaps too, so stripes are cut to their own crossing.
        for stripe in shapely.intersection(shapely.polygons(quads), crossing):
            if not stripe.is_empty:
                fill_area(codes, stripe, corner, CELL_M, Mat.ZEBRA_PAINT, only_on(Mat.ZEBRA_GAP))

    def _wear(
        self,
        codes: NDArrayByte,
        wear: NDArrayByte,
        corner: tuple[float, float],
        box: BaseGeometry,
    ) -> None:
        """How much of the paint is left: less where it is old, in spots, and under wheels."""
        rows, cols = np.nonzero(np.isin(codes, _PAINTS))
        if len(rows) == 0:
            return
        xy = np.column_stack([cols + 0.5, rows + 0.5]) * CELL_M + corner
        seed = self.settings.place_seed
        least, tracks, worn = _WEAR[self.settings.difficulty]
        fine = value_noise(xy, 0.12, seed, Purpose.WEAR)
        middle = value_noise(xy, 0.9, seed, Purpose.WEAR, 1)
        stretch = value_noise(xy, 14.0, seed, Purpose.WEAR, 2)
        age = np.clip((stretch - (1.0 - worn)) / 0.15, 0.0, 1.0) if worn > 0 else 0.0
        left = 1.0 - (1.0 - least) * (0.4 * fine + 0.6 * middle)
        left = left - age * (0.25 + 0.35 * fine + 0.25 * middle)
        left = left - tracks * self._in_wheel_tracks(xy, box)
        wear[rows, cols] = np.clip(left * 255.0, 0, 255).astype(np.uint8)

    def _in_wheel_tracks(self, xy: NDArrayFloat, box: BaseGeometry) -> NDArrayFloat:
        """(N,) 0..1, 1 where the wheels of a car in the middle of its lane roll."""
        lanes = self.index.lanes_near(box.buffer(1.0))
        if not lanes:
            return np.zeros(len(xy))
        from scipy.spatial import cKDTree

        centres = np.concatenate([lane_centre(lane, 0.25) for lane in lanes])
        distance, _ = cKDTree(centres).query(xy, distance_upper_bound=3.0)
        track: NDArrayFloat = np.exp(-(((distance - 0.8) / 0.25) ** 2))
        return track

    @cached_property
    def phases(self) -> dict[str, float]:
        """By line id, where in the dash pattern it begins: lines that go on from others go on in step."""
        return dash_phases(self.index.lines)

    @cached_property
    def crossing_directions(self) -> list[NDArrayFloat]:
        """(2,) unit vector of each crossing along which vehicles drive over it."""
        return [crossing_direction(self.index, c) for c in self.index.world.crosswalks]

    @cached_property
    def arrows(self) -> dict[int, list[shapely.Polygon]]:
        """By stop line, the lane arrows before it."""
        found: dict[int, list[shapely.Polygon]] = {}
        for k, line in enumerate(self.index.world.stop_lines):
            for lane in self.index.lanes_near(line):
                if lane.kind != "road":
                    continue
                centre = shapely.LineString(lane_centre(lane, 0.5))
                at = shapely.intersection(centre, line)
                if at.is_empty or at.geom_type != "Point":
                    continue
                place = np.array([at.x, at.y])
                rng = rng_at(self.settings.place_seed, Purpose.SYMBOL, *np.round(place).astype(int))
                reached = centre.project(at)
                if rng.uniform() > 0.6 or reached < 9.0:
                    continue
                tip, back = (shapely.line_interpolate_point(centre, reached - d) for d in (3, 5))
                ahead = np.array([tip.x - back.x, tip.y - back.y])
                ahead /= np.linalg.norm(ahead)
                turn = int(rng.choice([0, 0, 1, -1]))
                arrow = arrow_polygon(np.array([tip.x, tip.y]), ahead, turn)
                found.setdefault(k, []).append(arrow)
        return found


def block_of_tile(ix: int, iy: int) -> tuple[int, int]:
    """The block of the road area that a tile lies in."""
    per_block = round(BLOCK_M / TILE_M)
    return ix // per_block, iy // per_block


def sidewalk_width(corner: tuple[float, float], seed: int) -> float:
    """Metres of pavement beyond the kerb, one for a whole world."""
    return float(rng_at(seed, Purpose.SIDEWALK).uniform(1.6, 2.8))


def crossing_direction(index: WorldIndex, crossing: shapely.Polygon) -> NDArrayFloat:
    """(2,) unit vector along which vehicles drive over a crossing; its sign means nothing."""
    total = np.zeros(2)
    for lane in index.lanes_near(crossing):
        centre = lane_centre(lane, 0.5)
        steps = np.diff(centre, axis=0)
        inside = shapely.intersects_xy(crossing, (centre[:-1] + centre[1:]) / 2)
        # Opposite directions are one: doubled angles.
        angle = 2 * np.arctan2(steps[inside, 1], steps[inside, 0])
        total += [np.cos(angle).sum(), np.sin(angle).sum()]
    if np.linalg.norm(total) < 0.5:  # no lane: the short side of the crossing
        ring = shapely.get_coordinates(crossing.minimum_rotated_rectangle)[:3]
        side = min(np.diff(ring, axis=0), key=lambda s: float(np.linalg.norm(s)))
        return np.asarray(side / max(float(np.linalg.norm(side)), 1e-9))
    angle = np.arctan2(total[1], total[0]) / 2
    return np.array([np.cos(angle), np.sin(angle)])


def lane_centre(lane: WorldLane, step_m: float, share: float = 0.5) -> NDArrayFloat:
    """(N, 2) a line along a lane, city metres, about step_m apart.

    Args:
        lane: The lane.
        step_m: Between vertices.
        share: Of the way from its left to its right bound; 0.5 is the middle.
    """
    lengths = [arc_lengths(side)[-1] for side in (lane.left, lane.right)]
    n = max(int(max(lengths) / step_m), 1) + 1
    sides = []
    for side in (lane.left, lane.right):
        along = arc_lengths(side)
        at = np.linspace(0, along[-1], n)
        sides.append(np.column_stack([np.interp(at, along, side[:, d]) for d in (0, 1)]))
    middle: NDArrayFloat = sides[0] * (1.0 - share) + sides[1] * share
    return middle


def dash_phases(lines: tuple[WorldLine, ...]) -> dict[str, float]:
    """By line id, metres of the dash pattern that lines before it in one run have used up."""
    ends: dict[tuple[int, int], WorldLine] = {}
    for line in lines:
        if line.paint is not None:
            ends[_node(line.xy[-1])] = line
    phases: dict[str, float] = {}
    for line in lines:
        run: list[WorldLine] = []
        on_run = set()
        at: WorldLine | None = line
        while at is not None and at.id not in phases and at.id not in on_run:
            run.append(at)
            on_run.add(at.id)
            before = ends.get(_node(at.xy[0]))
            at = before if before is not None and before.paint == at.paint else None
        start = 0.0
        if at is not None and at.id in phases:
            start = phases[at.id] + float(arc_lengths(at.xy)[-1])
        for piece in reversed(run):
            phases[piece.id] = start
            start += float(arc_lengths(piece.xy)[-1])
    return phases


def _node(xy: NDArrayFloat) -> tuple[int, int]:
    return round(float(xy[0]) * 100), round(float(xy[1]) * 100)
