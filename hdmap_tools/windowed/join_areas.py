"""Areas that several windows saw: those handed over whole kept once, those that were cut united."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import networkx as nx
import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.types import NDArrayFloat
from hdmap_tools.windowed.combining import combined
from hdmap_tools.windowed.pieces import Piece

_SAME_SHARE: Final = 0.3
"""Two windows' areas that share more of the smaller one are the same area."""

_STEP_M: Final = 0.5
"""An outline that changes windows makes a step along the seam; a longer one is a shape of its own."""

_ON_SEAM_M: Final = 1e-6


@dataclass(frozen=True, eq=False)
class _Area:
    window: int
    piece: Piece

    @property
    def geometry(self) -> BaseGeometry:
        return self.piece.geometry


def join_areas(
    windows: Sequence[Sequence[Piece]], seams_m: tuple[NDArrayFloat, NDArrayFloat]
) -> list[MapElement]:
    """The areas of all windows as elements of the map.

    Args:
        windows: What each handed over, of one vectorizer and one type of element.
        seams_m: City x, and city y, of the edges of the windows' cores.
    """
    areas = [_Area(k, piece) for k, pieces in enumerate(windows) for piece in pieces]
    if not areas:
        return []
    whole = _kept_once([area for area in areas if not area.piece.is_cut])
    result = [area.piece.element for area in whole]
    for group in _touching([area for area in areas if area.piece.is_cut]):
        parts = [(area.piece.element, float(area.geometry.area)) for area in group]
        united = shapely.union_all([area.geometry for area in group], grid_size=_ON_SEAM_M)
        for polygon in shapely.get_parts(united):
            if polygon.geom_type == "Polygon" and polygon.area > 0.0:
                result.append(combined(parts, _without_steps(polygon, seams_m)))
    return result


def _kept_once(areas: list[_Area]) -> list[_Area]:
    """Of areas of different windows that are the same one, that which lies deepest in its core."""
    order = sorted(range(len(areas)), key=lambda k: (-areas[k].piece.depth_m, k))
    geometries = [area.geometry for area in areas]
    tree = shapely.STRtree(geometries)
    kept: set[int] = set()
    for k in order:
        near = sorted(int(n) for n in tree.query(geometries[k], predicate="intersects"))
        mine = geometries[k]
        if not any(
            other in kept
            and areas[other].window != areas[k].window
            and mine.intersection(geometries[other]).area
            > _SAME_SHARE * min(mine.area, geometries[other].area)
            for other in near
        ):
            kept.add(k)
    return [areas[k] for k in sorted(kept)]


def _touching(areas: list[_Area]) -> list[list[_Area]]:
    """Pieces in groups that share edges across seams."""
    graph: nx.Graph[int] = nx.Graph()
    graph.add_nodes_from(range(len(areas)))
    geometries = [area.geometry for area in areas]
    if geometries:
        first, second = shapely.STRtree(geometries).query(
            geometries, predicate="dwithin", distance=_ON_SEAM_M
        )
        for a, b in zip(first.tolist(), second.tolist(), strict=True):
            if a < b and areas[a].window != areas[b].window:
                shared = geometries[a].intersection(geometries[b].buffer(10 * _ON_SEAM_M))
                # A common corner does not make them one.
                if shared.length > 100 * _ON_SEAM_M:
                    graph.add_edge(a, b)
    groups = [sorted(group) for group in nx.connected_components(graph)]
    return [[areas[k] for k in group] for group in sorted(groups)]


def _without_steps(polygon: Polygon, seams_m: tuple[NDArrayFloat, NDArrayFloat]) -> Polygon:
    """A united area without the vertices that only the seams put there."""
    rings = [
        _ring_without_steps(shapely.get_coordinates(ring, include_z=True), seams_m)
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    result = Polygon(rings[0], [ring for ring in rings[1:] if ring is not None])
    return result if result.is_valid and result.area > 0.0 else polygon


def _ring_without_steps(
    ring: NDArrayFloat, seams_m: tuple[NDArrayFloat, NDArrayFloat]
) -> NDArrayFloat | None:
    points = ring[:-1]
    on_seam = np.column_stack(
        [
            np.abs(points[:, axis, None] - seams[None]).min(axis=1) <= 10 * _ON_SEAM_M
            for axis, seams in enumerate(seams_m)
        ]
    )
    is_free = ~on_seam.any(axis=1)
    if is_free.all() or not is_free.any():
        return ring
    first = int(np.argmax(is_free))
    points, on_seam = np.roll(points, -first, axis=0), np.roll(on_seam, -first, axis=0)
    along = np.abs(np.diff(points[:, :2], axis=0)) <= 10 * _ON_SEAM_M
    # Whether a vertex lies on the seam of the one before: both have its x, or its y.
    goes_on = np.append(False, (on_seam[1:] & on_seam[:-1] & along).any(axis=1))
    result: list[NDArrayFloat] = []
    k = 0
    while k < len(points):
        last = k
        while last + 1 < len(points) and goes_on[last + 1]:
            last += 1
        run = points[k : last + 1]
        if last > k and np.hypot(*(run[-1] - run[0])[:2]) <= _STEP_M:
            result.append((run[0] + run[-1]) / 2.0)
        else:
            result += list(run)
        k = last + 1
    if len(result) < 3:
        return None
    return np.array([*result, result[0]])
