"""Where the road ends: the outline of the drivable area, islands kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field
from scipy import ndimage
from shapely.geometry import LineString

from hdmap_plugins.contours import Contour, contours, edge_sigma_cells, edge_slope
from hdmap_plugins.fragments import lengths_with_company
from hdmap_plugins.lines import MIN_STEP_M, kept_by_simplification, smooth
from hdmap_plugins.sampling import (
    bilinear,
    fill_small_gaps,
    height_surface,
    heights_along,
    nearest,
    to_city,
    votes_at,
)
from hdmap_tools.geometry.polyline import drop_repeats, normals, resample
from hdmap_tools.plugin_api import (
    DRIVABLE_CLASSES,
    BoundaryKind,
    MapElement,
    MapWindow,
    RoadBoundary,
    Vectorizer,
    VectorizerOptions,
    VectorMap,
)
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_STATION_CELLS = 0.5
"""Spacing of the stations that are smoothed: marching squares has about one vertex per half cell."""

_SMOOTHING_SHARE = 0.7
"""Leaving out vertices puts chords inside of every bend, so it gets the smaller share."""


class RoadBoundaryOptions(VectorizerOptions):
    """Options of `RoadBoundaryOutline`.

    Attributes:
        threshold: Probability of road, crosswalk or lane mark on the outline.
        min_road_area_m2: Smaller drivable patches are dropped as specks.
        min_island_area_m2: Smaller islands in the road are dropped as specks.
        min_length_m: Shorter open lines are dropped, unless others go on with them:
            pieces of one boundary, each of a metre or more, with gaps no longer than
            they are, count together.
            Heights and smoothing need about as much line to say anything.
        min_confidence: Lines that are less sure are dropped: as likely as not, the road
            does not end there.
        fill_gap_m: Unknown stripes (between lidar rings) up to this wide are filled;
            wider ones end the boundary, for nothing is known of it there.
        tolerance_m: The line stays this near to the outline: 0.7 of it for smoothing
            (or half a cell, if that is more: stairs of cells are no shape of the
            road), the rest for leaving out vertices.
        smooth_wavelength_m: Wiggles shorter than this are smoothed, within the tolerance.
        kerb_min_m: Least step up from the road that makes a kerb.
        kerb_high_m: Least step of a high kerb, which a car does not drive over.
        kerb_max_m: Highest kerb; what rises more is no kerb, and its kind unknown.
        kind_share: Share of the line that must agree on a kind; else it is unknown.
    """

    threshold: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    min_road_area_m2: Annotated[float, Field(ge=0.0)] = 4.0
    min_island_area_m2: Annotated[float, Field(ge=0.0)] = 1.0
    min_length_m: Annotated[float, Field(ge=0.0)] = 2.0
    min_confidence: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.5
    fill_gap_m: Annotated[float, Field(ge=0.0, le=5.0)] = 0.3
    tolerance_m: Annotated[float, Field(ge=0.0, le=2.0)] = 0.1
    smooth_wavelength_m: Annotated[float, Field(ge=0.0, le=20.0)] = 1.5
    kerb_min_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.05
    kerb_high_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.12
    kerb_max_m: Annotated[float, Field(gt=0.0, le=2.0)] = 0.30
    kind_share: Annotated[float, Field(gt=0.5, le=1.0)] = 0.6


class RoadBoundaryOutline(Vectorizer):
    """Traces the drivable area by marching squares, road on the right of each line.

    Only known cells are traced: where the road meets what nobody saw, or the edge
    of the window, there is no line, because that is not where the road ends. Rings
    around areas that are not drivable are islands.

    The confidence is the mean along the line of the probability that one side is road
    and the other is not, each looked at where the blur of the edge has ended, or as far
    away as anything is known. (Where the edge lies within the blur
    is not its question, but that of ``sigma_m``.)
    """

    name = "road_boundary"
    element_types: ClassVar[tuple[type[MapElement], ...]] = (RoadBoundary,)
    halo_m: ClassVar[float] = 6.0
    Options = RoadBoundaryOptions

    def vectorize(
        self, window: MapWindow, upstream: VectorMap, options: Any, *, rng: np.random.Generator
    ) -> list[MapElement]:
        """Road boundaries of the window; see the class for the method."""
        resolution = window.grid.resolution_m
        raw = window.probability(*DRIVABLE_CLASSES).astype(np.float64)
        if min(raw.shape) < 2 or not (raw >= options.threshold).any():
            return []
        drivable, is_known = fill_small_gaps(raw, window.is_known, options.fill_gap_m / resolution)
        drivable = _without_specks(drivable, is_known, options, resolution)
        field = np.where(is_known, drivable, np.nan)
        surface = height_surface(window.layer("height"))
        has_height = np.isfinite(window.layer("height"))

        slope = edge_slope(drivable)
        outlines = []
        for contour in contours(field, options.threshold, close_at_edge=False):
            area_m2 = contour.signed_area_cells * resolution**2 if contour.is_closed else 0.0
            least = options.min_island_area_m2 if area_m2 > 0.0 else options.min_road_area_m2
            # A ring can be small though what it parts from the rest is not: where
            # areas touch at corners only.
            if contour.is_closed and abs(area_m2) < least:
                continue
            xy = _smoothed(contour, options, resolution)
            sigma_cells = edge_sigma_cells(slope, contour.xy_cells)
            confidence = _confidence(field, xy, sigma_cells, resolution)
            if confidence >= options.min_confidence:
                outlines.append(_Outline(xy, contour.is_closed, area_m2, sigma_cells, confidence))

        result: list[MapElement] = []
        for outline in _long_enough(outlines, options, resolution):
            xy = outline.xy_cells
            kept = kept_by_simplification(
                xy,
                (1.0 - _SMOOTHING_SHARE) * options.tolerance_m / resolution,
                is_closed=outline.is_closed,
            )
            # The road is on the right, against the normal.
            to_road = -normals(xy)
            road_side = xy + to_road * max(0.3 / resolution, 1.0)
            far_side = xy - to_road * max(0.3 / resolution, 1.0)
            z = heights_along(surface, road_side, round(2.0 / resolution / _STATION_CELLS))
            xyz = np.column_stack([to_city(xy[kept], window.grid), z[kept]])
            vertices = drop_repeats(xyz, MIN_STEP_M)
            if len(vertices) < 2 or not (geometry := LineString(vertices)).is_valid:
                continue
            result.append(
                RoadBoundary(
                    geometry=geometry,
                    kind=_kind(surface, has_height, xy, to_road, options, resolution),
                    is_island=outline.area_m2 > 0.0,
                    confidence=outline.confidence,
                    sigma_m=outline.sigma_cells * resolution,
                    num_observations=votes_at(
                        window.layer("observations"), np.vstack([road_side, far_side])
                    ),
                )
            )
        return result


@dataclass(frozen=True)
class _Outline:
    """A smoothed contour in cells, the road on its right; its area is positive for an island."""

    xy_cells: NDArrayFloat
    is_closed: bool
    area_m2: float
    sigma_cells: float
    confidence: float


def _confidence(
    field: NDArrayFloat, xy: NDArrayFloat, sigma_cells: float, resolution: float
) -> float:
    """Mean probability that there is road on the right of a line and none on its left.

    Args:
        field: (y, x) probability of road, NaN where unknown.
        xy: (N, 2) stations, cells.
        sigma_cells: Blur of the edge; beyond two sigmas it does not reach.
        resolution: Metres a cell.
    """
    # Half a metre away there may be something else already: the far side of an island.
    farthest = min(max(2.0 * sigma_cells, 1.0), max(0.5 / resolution, 1.0))
    is_known = np.isfinite(field)
    known_share = is_known.astype(np.float64)
    known_road = np.where(is_known, field, 0.0)
    sides = []
    for direction in (-normals(xy), normals(xy)):
        side = np.full(len(xy), 0.5)
        # Nearer to the line where nothing was seen as far away; beside it something was.
        for reach in (0.5, 1.0, farthest):
            places = xy + reach * direction
            share = bilinear(known_share, places)
            is_seen = share > 0.7
            side[is_seen] = bilinear(known_road, places)[is_seen] / share[is_seen]
        sides.append(side)
    return float(np.clip(np.mean(sides[0] * (1.0 - sides[1])), 0.0, 1.0))


def _long_enough(
    outlines: list[_Outline], options: RoadBoundaryOptions, resolution: float
) -> list[_Outline]:
    """Rings, and open lines that are long enough alone or with those that go on with them."""
    is_open = [index for index, outline in enumerate(outlines) if not outline.is_closed]
    lengths = lengths_with_company(
        [outlines[index].xy_cells for index in is_open], 1.0 / resolution
    )
    least = max(options.min_length_m / resolution, 1.0)
    dropped = {index for index, length in zip(is_open, lengths, strict=True) if length < least}
    return [outline for index, outline in enumerate(outlines) if index not in dropped]


def _without_specks(
    drivable: NDArrayFloat, is_known: NDArrayBool, options: RoadBoundaryOptions, resolution: float
) -> NDArrayFloat:
    """The probability with small patches of road, and small islands in it, painted over.

    An area that touches what is unknown or the window's edge may be larger than what
    was seen of it, so as an island it stays; a small patch of road goes all the same.
    """
    result = drivable.copy()
    is_road = is_known & (drivable >= options.threshold)
    patches, count = ndimage.label(is_road)
    sizes = np.bincount(patches.ravel(), minlength=count + 1) * resolution**2
    small = sizes < options.min_road_area_m2
    small[0] = False
    result[small[patches]] = 0.0

    # Diagonal touches join the lower side, as in the outline.
    others, count = ndimage.label(~is_road | small[patches], structure=np.ones((3, 3)))
    sizes = np.bincount(others.ravel(), minlength=count + 1) * resolution**2
    is_open = np.zeros(count + 1, dtype=bool)
    is_open[np.unique(others[~is_known])] = True
    for edge in (others[0], others[-1], others[:, 0], others[:, -1]):
        is_open[np.unique(edge)] = True
    small = (sizes < options.min_island_area_m2) & ~is_open
    small[0] = False
    result[small[others]] = 1.0
    return result


def _smoothed(contour: Contour, options: RoadBoundaryOptions, resolution: float) -> NDArrayFloat:
    """Equally spaced stations of a contour, smoothed within its share of the tolerance."""
    xy = resample(contour.xy_cells, _STATION_CELLS)
    if options.smooth_wavelength_m <= 0.0 or options.tolerance_m <= 0.0:
        return xy
    return smooth(
        xy,
        options.smooth_wavelength_m / resolution / _STATION_CELLS,
        is_closed=contour.is_closed,
        max_move=max(_SMOOTHING_SHARE * options.tolerance_m / resolution, 0.5),
    )


def _kind(
    surface: NDArrayFloat | None,
    has_height: NDArrayBool,
    xy: NDArrayFloat,
    to_road: NDArrayFloat,
    options: RoadBoundaryOptions,
    resolution: float,
) -> BoundaryKind:
    """What most of the line is, by the step in the ground across it.

    The step is the median height 0.2 to 0.6 m beyond the line less that on the road,
    each from measured cells only, smoothed along 2 m.
    """
    if surface is None:
        return BoundaryKind.UNKNOWN
    reach = np.unique(np.maximum(np.array([0.2, 0.4, 0.6]) / resolution, 1.0))
    sides = []
    for sign in (1.0, -1.0):
        places = xy[None] + sign * reach[:, None, None] * to_road[None]
        heights = np.where(nearest(has_height, places) > 0, nearest(surface, places), np.nan)
        known = np.isfinite(heights).any(axis=0)
        sides.append(np.full(len(xy), np.nan))
        sides[-1][known] = np.nanmedian(heights[:, known], axis=0)
    step = sides[1] - sides[0]
    step = step[np.isfinite(step)]
    # A line mostly without heights on both sides says nothing.
    if len(step) < 0.5 * len(xy) or not len(step):
        return BoundaryKind.UNKNOWN
    along = min(round(2.0 / resolution / _STATION_CELLS), len(step))
    step = ndimage.median_filter(step, size=max(along, 1), mode="nearest")
    is_kerb = (step >= options.kerb_min_m) & (step <= options.kerb_max_m)
    is_edge = np.abs(step) < options.kerb_min_m
    if is_kerb.mean() >= options.kind_share:
        is_high = float(np.median(step[is_kerb])) >= options.kerb_high_m
        return BoundaryKind.KERB_HIGH if is_high else BoundaryKind.KERB_LOW
    return BoundaryKind.EDGE if is_edge.mean() >= options.kind_share else BoundaryKind.UNKNOWN
