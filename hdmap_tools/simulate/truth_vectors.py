"""The true vector map of a drive: what is painted, where the road ends, with heights."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from hdmap_tools.geometry.polyline import drop_repeats
from hdmap_tools.map_model.elements import (
    BoundaryKind,
    Crosswalk,
    LaneMark,
    MapElement,
    RoadBoundary,
    StopLine,
)
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.simulate.road_area import BLOCK_M, KERB_LOW_M, WorldIndex
from hdmap_tools.simulate.road_paint import STOP_LINE_M
from hdmap_tools.simulate.route import Route
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.simulate.truth_raster import REACH_M
from hdmap_tools.simulate.world_map import LineKind
from hdmap_tools.types import NDArrayAny, NDArrayFloat

if TYPE_CHECKING:
    from hdmap_tools.simulate.build_scene import SceneBuilder

_STEP_M: Final = 2.0
"""Longest distance between vertices, so that lines follow the ground."""

_SHORTEST_M: Final = 0.3


def truth_vector_map(builder: SceneBuilder, route: Route, reach_m: float = REACH_M) -> VectorMap:
    """Lane marks, stop lines, crosswalks and road boundaries around a route, with heights.

    They are what the surface raster shows: paint that lies on the road only, boundaries at
    the foot of the kerb, with the road on their right.

    Args:
        builder: Of the scenes of the same drive.
        route: Where the vehicle drives.
        reach_m: All is cut so far from it.
    """
    return VectorMap(
        builder.world.frame,
        with_stable_ids(
            element for element in _elements(builder.index, builder.terrain, route, reach_m)
        ),
        {"source": "simulation", "world": builder.world.name},
    )


def _elements(
    index: WorldIndex, terrain: Terrain, route: Route, reach_m: float
) -> Iterable[MapElement]:
    around = shapely.LineString(route.xy).simplify(0.05).buffer(reach_m)
    blocks = _blocks(around)
    road = shapely.union_all(
        [
            shapely.intersection(index.road_area(block).drivable, _block_box(block))
            for block in blocks
        ],
        grid_size=1e-7,
    )
    seen = shapely.intersection(road, around)
    shapely.prepare(seen)
    yield from _marks(index, terrain, seen)
    for line in index.world.stop_lines:
        for part in _lines(shapely.intersection(line, seen)):
            yield StopLine(geometry=_on_ground(part, terrain), width_m=STOP_LINE_M)
    for crossing in index.world.crosswalks:
        if not crossing.intersects(seen):
            continue
        for part in shapely.get_parts(shapely.intersection(crossing, seen)):
            if part.geom_type == "Polygon" and part.area > 0.5:
                ring = _with_heights(shapely.segmentize(part, _STEP_M), terrain)
                yield Crosswalk(geometry=ring)
    yield from _boundaries(index, terrain, road, around)


def _marks(index: WorldIndex, terrain: Terrain, seen: BaseGeometry) -> Iterable[MapElement]:
    zebras = shapely.union_all([c for c in index.world.crosswalks if c.intersects(seen)])
    for k in index.lines_near(seen):
        line = index.lines[k]
        if line.kind != LineKind.PAINT or line.paint is None:
            continue
        visible = shapely.intersection(shapely.LineString(line.xy), seen)
        for part in _lines(shapely.difference(visible, zebras)):
            yield LaneMark(
                geometry=_on_ground(part, terrain),
                style=line.paint.style,
                color=line.paint.color,
                width_m=line.paint.width_m,
            )


def _boundaries(
    index: WorldIndex, terrain: Terrain, road: BaseGeometry, around: BaseGeometry
) -> Iterable[MapElement]:
    for polygon in shapely.get_parts(shapely.orient_polygons(road, exterior_cw=True)):
        if polygon.geom_type != "Polygon":
            continue
        for ring in (polygon.exterior, *polygon.interiors):
            # An outer ring clockwise, a hole counter-clockwise: the road is on the right.
            whole = shapely.LineString(ring.coords)
            is_island = ring is not polygon.exterior and around.contains(whole)
            inside = [whole] if around.contains(whole) else _lines(whole.intersection(around))
            for part in inside:
                for kind, piece in _by_kind(shapely.segmentize(part, _STEP_M), index):
                    if piece.length < _SHORTEST_M:
                        continue
                    yield RoadBoundary(
                        geometry=_with_heights(piece, terrain),
                        kind=kind,
                        is_island=is_island and piece.is_closed,
                    )


def _by_kind(line: BaseGeometry, index: WorldIndex) -> Iterable[tuple[BoundaryKind, BaseGeometry]]:
    """Pieces of a boundary by how high the kerb is there."""
    xy = shapely.get_coordinates(line)
    middle = (xy[:-1] + xy[1:]) / 2
    blocks = np.floor(middle / BLOCK_M).astype(int)
    raise_m = np.zeros(len(middle))
    for block in np.unique(blocks, axis=0):
        mine = (blocks == block).all(axis=1)
        area = index.road_area((int(block[0]), int(block[1])))
        raise_m[mine] = area.raise_at(middle[mine])
    kinds = np.where(raise_m > 2 * KERB_LOW_M, 2, np.where(raise_m > 0, 1, 0))
    names = (BoundaryKind.EDGE, BoundaryKind.KERB_LOW, BoundaryKind.KERB_HIGH)
    at = 0
    for kind, group in itertools.groupby(kinds.tolist()):
        n = len(list(group))
        yield names[kind], shapely.LineString(xy[at : at + n + 1])
        at += n


def _blocks(around: BaseGeometry) -> list[tuple[int, int]]:
    x0, y0, x1, y1 = (np.floor(np.array(around.bounds) / BLOCK_M)).astype(int).tolist()
    found = [(bx, by) for bx in range(x0, x1 + 1) for by in range(y0, y1 + 1)]
    return [block for block in found if _block_box(block).intersects(around)]


def _block_box(block: tuple[int, int]) -> BaseGeometry:
    bx, by = block
    return shapely.box(bx * BLOCK_M, by * BLOCK_M, (bx + 1) * BLOCK_M, (by + 1) * BLOCK_M)


def _lines(geometry: BaseGeometry) -> list[BaseGeometry]:
    parts = [p for p in shapely.get_parts(geometry) if p.geom_type == "LineString"]
    if len(parts) > 1:
        parts = list(
            shapely.get_parts(shapely.line_merge(shapely.multilinestrings(parts), directed=True))
        )
    return [p for p in parts if p.length >= _SHORTEST_M]


def _on_ground(line: BaseGeometry, terrain: Terrain) -> BaseGeometry:
    xy = drop_repeats(shapely.get_coordinates(shapely.segmentize(line, _STEP_M)))
    return shapely.linestrings(_lifted(xy, terrain))


def _with_heights(geometry: BaseGeometry, terrain: Terrain) -> BaseGeometry:
    def lift(xy: NDArrayAny) -> NDArrayFloat:
        return _lifted(xy[:, :2], terrain)

    with_z = shapely.force_3d(geometry)
    return shapely.transform(with_z, lift, include_z=True)


def _lifted(xy: NDArrayFloat, terrain: Terrain) -> NDArrayFloat:
    return np.column_stack([xy, terrain.height_at(xy)])
