"""What a map says of a world: lanes, lines, crossings. Flat; the terrain is the simulator's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
import shapely

from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MarkColor, MarkStyle
from hdmap_tools.types import NDArrayFloat

LaneKind = Literal["road", "bicycle", "walkway"]


class LineKind(StrEnum):
    """What a line of the map is on the ground."""

    PAINT = "paint"
    KERB_HIGH = "kerb_high"
    KERB_LOW = "kerb_low"
    EDGE = "edge"
    FENCE = "fence"
    WALL = "wall"
    GUARD_RAIL = "guard_rail"
    VIRTUAL = "virtual"


@dataclass(frozen=True)
class Paint:
    """How a line is painted.

    Attributes:
        style: Solid, dashed, double; sides as seen along the line.
        color: Of the paint.
        width_m: Of one stripe.
        dash_m, gap_m: Length of a dash and of the gap after it.
    """

    style: MarkStyle = MarkStyle.SOLID
    color: MarkColor = MarkColor.WHITE
    width_m: float = 0.12
    dash_m: float = 3.0
    gap_m: float = 6.0


@dataclass(frozen=True, eq=False)
class WorldLine:
    """A line of the map.

    Attributes:
        id: As in the map.
        xy: (N, 2) float64 metres, city frame, N >= 2, the centre of paint or edge.
        kind: What it is on the ground.
        paint: Where kind is ``paint``.
    """

    id: str
    xy: NDArrayFloat
    kind: LineKind
    paint: Paint | None = None


@dataclass(frozen=True, eq=False)
class WorldLane:
    """A piece of lane.

    Attributes:
        id: As in the map.
        left, right: (N, 2) and (M, 2) float64 metres, city frame, in driving direction.
        kind: Who it is for.
        successors: Ids of the lanes one can drive into.
        left_line, right_line: Ids of the lines that bound it, where the map says so.
        speed_limit_mps: Where known.
    """

    id: str
    left: NDArrayFloat
    right: NDArrayFloat
    kind: LaneKind = "road"
    successors: tuple[str, ...] = ()
    left_line: str | None = None
    right_line: str | None = None
    speed_limit_mps: float | None = None

    def polygon(self) -> shapely.Polygon | shapely.MultiPolygon:
        """The ground between its bounds, valid; in parts where they cross."""
        ring = np.concatenate([self.left, self.right[::-1]])
        valid = shapely.make_valid(shapely.Polygon(ring))
        parts = [p for p in shapely.get_parts(valid) if p.geom_type == "Polygon"]
        return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


@dataclass(frozen=True, eq=False)
class WorldMap:
    """A map as the simulator needs it.

    Attributes:
        name: Of the file, without its suffix; part of a drive's name.
        frame: The city frame of all coordinates.
        lanes: By id.
        lines: Painted lines, kerbs, edges, fences.
        crosswalks: Areas of zebra crossings.
        stop_lines: Lines before which vehicles stop, the centre of the paint.
        areas: Other polygons the map knows, by what they are: ``sidewalk``,
            ``vegetation``, ``building``, ``island``, ``drivable``.
    """

    name: str
    frame: MapFrame
    lanes: Mapping[str, WorldLane]
    lines: tuple[WorldLine, ...] = ()
    crosswalks: tuple[shapely.Polygon, ...] = ()
    stop_lines: tuple[shapely.LineString, ...] = ()
    areas: Mapping[str, tuple[shapely.Polygon, ...]] = field(default_factory=dict)
