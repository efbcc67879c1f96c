"""Worlds made by hand: a curved street of two lanes with all that a street has."""

import numpy as np
import shapely

from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.simulate.route import Route
from hdmap_tools.simulate.world_map import LineKind, Paint, WorldLane, WorldLine, WorldMap

LANE_M = 3.5
LENGTH_M = 260.0
RADIUS_M = 240.0
SHIFT = np.array([1000.3, -500.7])
"""Away from the city origin, and off the lattice of cells."""


def bend(along_m: np.ndarray, left_m: np.ndarray | float) -> np.ndarray:
    """(N, 2) city points by arc length along the street's middle and distance to its left."""
    turn = np.asarray(along_m) / RADIUS_M
    radius = RADIUS_M - np.asarray(left_m)
    return SHIFT + np.column_stack([radius * np.sin(turn), RADIUS_M - radius * np.cos(turn)])


def curved_street() -> WorldMap:
    """Two lanes that bend to the left, crosswalk at 100 m, stop line at 95 m, kerbs both sides."""
    s = np.arange(0.0, LENGTH_M + 0.1, 2.0)
    right, middle, left = (bend(s, d) for d in (-LANE_M, 0.0, LANE_M))
    dashed = Paint(MarkStyle.DASHED, MarkColor.WHITE, 0.12, 3.0, 6.0)
    solid = Paint(MarkStyle.SOLID, MarkColor.WHITE, 0.15)
    lines = (
        WorldLine("middle", middle, LineKind.PAINT, dashed),
        WorldLine("edge", bend(s, -LANE_M + 0.4), LineKind.PAINT, solid),
        WorldLine("kerb_right", right, LineKind.KERB_HIGH),
        WorldLine("kerb_left", left, LineKind.KERB_LOW),
    )
    lanes = {
        "there": WorldLane("there", middle, right),
        "back": WorldLane("back", middle[::-1], left[::-1]),
    }
    across = np.linspace(-LANE_M - 0.2, LANE_M + 0.2, 9)
    crossing = np.concatenate(
        [bend(np.full(9, 100.0), across), bend(np.full(9, 104.0), across[::-1])]
    )
    stop = shapely.LineString(bend(np.full(2, 95.0), np.array([-LANE_M + 0.1, -0.1])))
    return WorldMap(
        "curved_street",
        MapFrame(),
        lanes,
        lines,
        (shapely.Polygon(crossing),),
        (stop,),
    )


def street_route() -> Route:
    """Along the middle of the right lane."""
    s = np.arange(10.0, LENGTH_M - 10.0, 0.5)
    return Route(bend(s, -LANE_M / 2), 0.5, ("there",))
