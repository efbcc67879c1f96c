"""A scene over six windows with one of everything that seams could spoil."""

from types import SimpleNamespace

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon, box

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.testing.scenes import window_from_shapes

RESOLUTION_M = 0.2
TILES = tuple((x, y) for x in (-1, 0, 1) for y in (-1, 0))
TILE_M = 51.2
META = SimpleNamespace(resolution_m=RESOLUTION_M, frame=BevGrid(0.2, 0, 0, 1, 1).frame)


def shapes():
    """Seams run along x = 0 and 51.2 m and y = 0; four windows meet at the ends of y = 0."""
    road = shapely.union_all(
        [
            box(-47.0, -8.0, 99.0, 8.0),
            LineString([(-6.0, -6.0), (20.0, 20.0)]).buffer(5.0),
            Point(55.0, 26.0).buffer(22.0),
        ]
    ).difference(Point(55.0, 28.0).buffer(12.0))
    paint = [
        box(-40.0, -0.1, 40.0, 0.1),  # along a seam
        box(-40.0, -6.1, 90.0, -5.9),
        *(box(x, 3.9, x + 3.0, 4.1) for x in np.arange(-44.0, 95.0, 9.0)),
        LineString([(9.5, 9.5), (19.0, 19.0)]).buffer(0.1, cap_style="flat"),
    ]
    return {
        "sidewalk": Polygon(
            box(-45.0, -45.0, 95.0, -12.0).exterior, [box(-10.0, -40.0, 60.0, -20.0).exterior]
        ).difference(road),
        "road": road,
        "lane_mark": shapely.union_all(paint).difference(box(47.0, -9.0, 56.0, 9.0)),
        "crosswalk": box(49.0, -7.5, 53.0, 7.5),
    }


def scene(noise: float = 0.0) -> MapWindow:
    """The scene in one piece."""
    grid = BevGrid(RESOLUTION_M, -256, -256, 512, 256)
    return window_from_shapes(shapes(), grid, noise=noise, rng=np.random.default_rng(3))
