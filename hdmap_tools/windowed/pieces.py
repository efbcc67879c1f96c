"""What one window hands over of the elements that it found: cut to what it answers for.

Lines are cut a little beyond the core, so that neighbours share a stretch of each line that
crosses; small areas are handed over whole; large ones are cut along the core's edge.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from shapely.geometry import box
from shapely.geometry.base import BaseGeometry

from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.types import NDArrayFloat
from hdmap_tools.windowed.windows import OVERLAP_M, WHOLE_M, Bounds, Window

_BESIDE_M: Final = 0.5
"""A line along a seam is seen a little to this side by one window, a little to that by the other."""


@dataclass(frozen=True, eq=False)
class Piece:
    """An element, or the part of it that a window answers for.

    Attributes:
        element: As its vectorizer made it, the whole of it, without id.
        geometry: The part: a LineString or a Polygon.
        is_cut: Whether it is less than the element.
        depth_m: Of an area handed over whole: how far its middle lies inside the core.
    """

    element: MapElement
    geometry: BaseGeometry
    is_cut: bool = False
    depth_m: float = 0.0


def pieces_of(elements: Iterable[MapElement], window: Window) -> list[Piece]:
    """The part of each element that a window hands over, in the order of the elements."""
    if window.core is None:
        return [Piece(element, element.geometry) for element in elements]
    result: list[Piece] = []
    for element in elements:
        if element.geometry_type == "LineString":
            result += _pieces_of_line(element, window)
        else:
            result += _pieces_of_area(element, window)
    return result


def _pieces_of_line(element: MapElement, window: Window) -> list[Piece]:
    bounds = window.line_bounds_m
    assert bounds is not None
    points = shapely.get_coordinates(element.geometry, include_z=True)
    if _is_inside(points, bounds):
        found = [Piece(element, element.geometry)]
    else:
        found = [
            Piece(element, shapely.linestrings(part), is_cut=True)
            for part in parts_inside(points, bounds)
        ]
    # What lies beside the core is its neighbour's, who hands it over if there is such a thing.
    x0, y0, x1, y1 = window.area_bounds_m or bounds
    beside = box(x0 - _BESIDE_M, y0 - _BESIDE_M, x1 + _BESIDE_M, y1 + _BESIDE_M)
    return [piece for piece in found if piece.geometry.intersects(beside)]


def _pieces_of_area(element: MapElement, window: Window) -> list[Piece]:
    bounds = window.area_bounds_m
    assert bounds is not None
    assert window.core is not None
    geometry = element.geometry
    x0, y0, x1, y1 = geometry.bounds
    if np.hypot(x1 - x0, y1 - y0) <= WHOLE_M:
        middle = geometry.centroid
        cx0, cy0, cx1, cy1 = window.core.bounds_m
        depth = min(middle.x - cx0, cx1 - middle.x, middle.y - cy0, cy1 - middle.y)
        # Neighbours see the middle a little elsewhere; two of them may hand it over, none may not.
        return [Piece(element, geometry, depth_m=depth)] if depth >= -OVERLAP_M else []
    if x0 >= bounds[0] and y0 >= bounds[1] and x1 <= bounds[2] and y1 <= bounds[3]:
        return [Piece(element, geometry)]
    inside = shapely.get_parts(geometry.intersection(box(*bounds)))
    return [
        Piece(element, part, is_cut=True)
        for part in inside
        if part.geom_type == "Polygon" and part.area > 0.0
    ]


def parts_inside(points: NDArrayFloat, bounds: Bounds) -> list[NDArrayFloat]:
    """The parts (K, 3) of a polyline (N, 3) inside a rectangle, each with its ends on the edge.

    A ring that is cut is opened there, not at its first vertex. Where a line crosses itself it
    is not cut, as an intersection of geometries would.
    """
    first, last = points[:-1], points[1:]
    step = (last - first)[:, :2]
    enter, leave = np.zeros(len(step)), np.ones(len(step))
    for axis in (0, 1):
        low, high = bounds[axis], bounds[axis + 2]
        at, way = first[:, axis], step[:, axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - at) / way, (high - at) / way
        still = way == 0.0
        is_in = (at >= low) & (at <= high)
        a = np.where(still, np.where(is_in, -np.inf, np.inf), a)
        b = np.where(still, np.where(is_in, np.inf, -np.inf), b)
        enter = np.maximum(enter, np.minimum(a, b))
        leave = np.minimum(leave, np.maximum(a, b))
        # Beside it all the way: the two are in the wrong order already.
        leave = np.where(still & ~is_in, -1.0, leave)
    result: list[list[NDArrayFloat]] = []
    is_open = False
    for k in np.flatnonzero(enter < leave):
        start = first[k] + enter[k] * (last[k] - first[k])
        end = last[k] if leave[k] == 1.0 else first[k] + leave[k] * (last[k] - first[k])
        if not (is_open and enter[k] == 0.0 and np.array_equal(result[-1][-1], first[k])):
            result.append([start])
        result[-1].append(end)
        is_open = bool(leave[k] == 1.0)
    is_ring = len(points) > 3 and np.array_equal(points[0], points[-1])
    goes_on = len(result) > 1 and np.array_equal(result[0][0], result[-1][-1])
    if is_ring and goes_on and np.array_equal(result[0][0], points[0]):
        result[0] = result.pop() + result[0][1:]
    return [np.array(part) for part in result]


def _is_inside(points: NDArrayFloat, bounds: Bounds) -> bool:
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return bool(np.all(low >= bounds[:2]) and np.all(high <= bounds[2:]))
