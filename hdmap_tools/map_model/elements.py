"""Map elements: what vectorizers emit and formats carry.

Lengths are metres, geometry is 3D (x east, y north, z up) in the city frame.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar, Literal

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema, model_validator
from shapely.geometry.base import BaseGeometry

Geometry = Annotated[BaseGeometry, Field(exclude=True), WithJsonSchema({"type": "object"})]


class MapElement(BaseModel):
    """Anything on the map.

    Attributes:
        id: Stable between runs; the runner fills it in when a plugin leaves it empty.
        geometry: shapely LineString or Polygon with z, city frame, metres.
        confidence: Posterior probability mass behind the element, 0..1.
        sigma_m: One standard deviation of its position across itself, metres.
        num_observations: Votes (frames) that the map held where it lies.
        plugin, plugin_version: Which vectorizer made it; empty for a map that was read.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False
    )

    element_type: ClassVar[str] = "map_element"
    geometry_type: ClassVar[Literal["LineString", "Polygon"]] = "LineString"

    geometry: Geometry
    id: str = ""
    confidence: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0
    sigma_m: Annotated[float, Field(ge=0.0)] = 0.0
    num_observations: Annotated[int, Field(ge=0)] = 0
    plugin: str = ""
    plugin_version: str = ""

    @model_validator(mode="after")
    def _geometry_is_usable(self) -> MapElement:
        geometry = self.geometry
        # By name, not isinstance: a LinearRing is a LineString to Python, to no file format.
        if geometry.geom_type != self.geometry_type:
            raise ValueError(
                f"{self.element_type} needs a {self.geometry_type}, found {geometry.geom_type}"
            )
        if geometry.is_empty:
            raise ValueError(f"{self.element_type} has an empty geometry")
        if not geometry.has_z:
            raise ValueError(f"{self.element_type} needs 3D coordinates, found 2D")
        if not np.isfinite(shapely.get_coordinates(geometry, include_z=True)).all():
            raise ValueError(f"{self.element_type} has NaN or infinite coordinates")
        if not geometry.is_valid:
            raise ValueError(
                f"{self.element_type} is not a valid geometry: {shapely.is_valid_reason(geometry)}"
            )
        return self


class MarkStyle(StrEnum):
    """How a lane mark is painted, left to right along the line for the mixed ones."""

    SOLID = "solid"
    DASHED = "dashed"
    SOLID_SOLID = "solid_solid"
    DASHED_SOLID = "dashed_solid"
    SOLID_DASHED = "solid_dashed"
    UNKNOWN = "unknown"


class MarkColor(StrEnum):
    """Colour of paint."""

    WHITE = "white"
    YELLOW = "yellow"
    BLUE = "blue"
    UNKNOWN = "unknown"


class LaneMark(MapElement):
    """A painted line along the lane; the geometry is the centre of the paint.

    Attributes:
        style, color: As painted.
        width_m: Of the paint, where it is known.
        is_thick: Whether the map it was read from calls it a thick line, where that does not
            follow from the width; None where it does.
    """

    element_type: ClassVar[str] = "lane_mark"

    style: MarkStyle = MarkStyle.UNKNOWN
    color: MarkColor = MarkColor.UNKNOWN
    width_m: Annotated[float, Field(gt=0.0)] | None = None
    is_thick: bool | None = None


class BoundaryKind(StrEnum):
    """What ends the road."""

    KERB_HIGH = "kerb_high"
    KERB_LOW = "kerb_low"
    EDGE = "edge"
    UNKNOWN = "unknown"


class RoadBoundary(MapElement):
    """Where the drivable area ends; a closed line for an island, road on the outside.

    The road lies on the right of a boundary that a vectorizer made.
    """

    element_type: ClassVar[str] = "road_boundary"

    kind: BoundaryKind = BoundaryKind.UNKNOWN
    is_island: bool = False


class VirtualBoundary(MapElement):
    """An unpainted bound of a lanelet, for example inside a junction."""

    element_type: ClassVar[str] = "virtual_boundary"


class StopLine(MapElement):
    """The line before which vehicles stop."""

    element_type: ClassVar[str] = "stop_line"

    width_m: Annotated[float, Field(gt=0.0)] | None = None


class Crosswalk(MapElement):
    """The area where people cross the road."""

    element_type: ClassVar[str] = "crosswalk"
    geometry_type: ClassVar[Literal["LineString", "Polygon"]] = "Polygon"


class SidewalkArea(MapElement):
    """Pavement for people on foot."""

    element_type: ClassVar[str] = "sidewalk_area"
    geometry_type: ClassVar[Literal["LineString", "Polygon"]] = "Polygon"


class VegetationArea(MapElement):
    """Lawn, hedges, planting."""

    element_type: ClassVar[str] = "vegetation_area"
    geometry_type: ClassVar[Literal["LineString", "Polygon"]] = "Polygon"


class Centerline(MapElement):
    """The line in the middle of a lane, in driving direction."""

    element_type: ClassVar[str] = "centerline"


class Lanelet(MapElement):
    """A piece of lane between two bounds that are elements of the same map.

    The geometry is its centerline in driving direction.

    Attributes:
        left_id, right_id: Elements that bound it.
        is_left_reversed, is_right_reversed: Whether that element's line runs
            against the driving direction.
        successor_ids: Lanelets one can drive into.
        subtype: Lanelet2 subtype, for example ``road`` or ``crosswalk``.
        tags: Lanelet2 tags beyond these, for example ``speed_limit``.
    """

    element_type: ClassVar[str] = "lanelet"

    left_id: str
    right_id: str
    is_left_reversed: bool = False
    is_right_reversed: bool = False
    successor_ids: tuple[str, ...] = ()
    subtype: str = "road"
    tags: dict[str, str] = Field(default_factory=dict)


ELEMENT_TYPES: tuple[type[MapElement], ...] = (
    LaneMark,
    Crosswalk,
    RoadBoundary,
    VirtualBoundary,
    StopLine,
    SidewalkArea,
    VegetationArea,
    Centerline,
    Lanelet,
)
"""Every element type that formats and schemas know."""


def element_type_by_name(name: str) -> type[MapElement] | None:
    """The element class of that ``element_type``, or None."""
    return next((t for t in ELEMENT_TYPES if t.element_type == name), None)
