"""Crosswalk areas as polygons, from the map's crosswalk probability."""

from __future__ import annotations

import logging
from typing import Annotated, Any, ClassVar

import numpy as np
import shapely
from pydantic import Field
from scipy import ndimage
from shapely.geometry import Polygon

from hdmap_plugins.contours import contours, edge_sigma_cells, edge_slope
from hdmap_plugins.lines import kept_by_simplification
from hdmap_plugins.rectangles import fit_rectangle
from hdmap_plugins.sampling import disk, fill_small_gaps, plane_heights, to_city
from hdmap_tools.plugin_api import (
    Crosswalk,
    MapClass,
    MapElement,
    MapWindow,
    Vectorizer,
    VectorizerOptions,
    VectorMap,
)
from hdmap_tools.types import NDArrayBool, NDArrayFloat

logger = logging.getLogger(__name__)


class CrosswalkPolygonOptions(VectorizerOptions):
    """Options of `CrosswalkPolygon`.

    Attributes:
        threshold: Probability on the outline.
        min_area_m2: Smaller areas are dropped as specks.
        gap_m: Gaps up to this wide are closed: bare ground between the stripes of a
            zebra, stripes that were seen as lane mark. Two crossings nearer than
            this become one.
        fill_gap_m: Unknown stripes (between lidar rings) up to this wide are filled.
        rectangle_iou: An area whose overlap with its best rectangle is at least
            this becomes that rectangle; 1 keeps every outline as it is.
        simplify_m: Tolerance of the other outlines.
    """

    threshold: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    min_area_m2: Annotated[float, Field(ge=0.0)] = 2.0
    gap_m: Annotated[float, Field(ge=0.0, le=5.0)] = 0.8
    fill_gap_m: Annotated[float, Field(ge=0.0, le=5.0)] = 0.3
    rectangle_iou: Annotated[float, Field(ge=0.0, le=1.0)] = 0.85
    simplify_m: Annotated[float, Field(ge=0.0, le=2.0)] = 0.05


class CrosswalkPolygon(Vectorizer):
    """Outlines connected crosswalk areas and squares them where they are nearly rectangles.

    Gaps are closed on the probability itself (grey closing), so that the outline
    keeps its place between cell centres; it is then traced by marching squares.
    Holes are dropped: a crosswalk of the map has none.
    """

    name = "crosswalk_polygon"
    element_types: ClassVar[tuple[type[MapElement], ...]] = (Crosswalk,)
    halo_m: ClassVar[float] = 12.0
    Options = CrosswalkPolygonOptions

    def vectorize(
        self, window: MapWindow, upstream: VectorMap, options: Any, *, rng: np.random.Generator
    ) -> list[MapElement]:
        """Crosswalks of the window; see the class for the method."""
        resolution = window.grid.resolution_m
        raw = window.probability(MapClass.CROSSWALK).astype(np.float64)
        if min(raw.shape) == 0 or not (raw >= options.threshold).any():
            return []
        is_known = window.is_known
        probability, _ = fill_small_gaps(raw, is_known, options.fill_gap_m / resolution)
        probability = _close_gaps(probability, options.gap_m / resolution)
        height, votes = window.layer("height"), window.layer("observations")

        slope = edge_slope(probability)
        result: list[MapElement] = []
        for contour in contours(probability, options.threshold, close_at_edge=True):
            # Positive rings run around holes.
            if not contour.is_closed or contour.signed_area_cells >= 0.0:
                continue
            outline = _valid_polygon(contour.xy_cells)
            if outline is None or outline.area * resolution**2 < max(options.min_area_m2, 1e-9):
                continue
            corners = fit_rectangle(contour.xy_cells)
            rectangle = None if corners is None else Polygon(corners)
            if rectangle is None or _iou(outline, rectangle) < options.rectangle_iou:
                ring = np.asarray(outline.exterior.coords)
                kept = kept_by_simplification(ring, options.simplify_m / resolution, is_closed=True)
                simpler = _valid_polygon(ring[kept])
                shape = outline if simpler is None else simpler
            else:
                shape = rectangle
            inside = _cells_inside(shape, raw.shape)
            evidence = raw[inside & is_known]
            if not evidence.size:
                continue
            xy = np.asarray(shape.exterior.coords)[:, :2]
            near = ndimage.binary_dilation(inside, iterations=max(round(0.3 / resolution), 1))
            xyz = np.column_stack([to_city(xy, window.grid), plane_heights(height, near, xy)])
            geometry = Polygon(xyz)
            if not geometry.is_valid:
                logger.debug("crosswalk of %.1f m2 has no valid outline, dropped", geometry.area)
                continue
            seen = votes[inside & (votes > 0)]
            result.append(
                Crosswalk(
                    geometry=geometry,
                    confidence=float(np.clip(evidence.mean(), 0.0, 1.0)),
                    sigma_m=edge_sigma_cells(slope, contour.xy_cells) * resolution,
                    num_observations=round(float(np.median(seen))) if seen.size else 0,
                )
            )
        return result


def _close_gaps(probability: NDArrayFloat, gap_cells: float) -> NDArrayFloat:
    """Grey closing by a disk: dark gaps up to ``gap_cells`` wide take their sides' level."""
    # A stripe of k cells needs a disk of at least k + 1 cells across to be closed.
    radius = int(np.ceil(gap_cells / 2.0))
    if radius < 1:
        return probability
    padded = np.pad(probability, 2 * radius)
    closed = ndimage.grey_closing(padded, footprint=disk(radius))
    return np.asarray(closed[2 * radius : -2 * radius, 2 * radius : -2 * radius])


def _valid_polygon(ring: NDArrayFloat) -> Polygon | None:
    """The largest valid polygon of a ring, without holes; None when there is none."""
    if len(ring) < 4:
        return None
    polygon = Polygon(ring)
    if not polygon.is_valid:
        polygon = max(
            (p for p in shapely.get_parts(polygon.buffer(0.0)) if p.geom_type == "Polygon"),
            key=lambda p: p.area,
            default=Polygon(),
        )
    if polygon.is_empty or polygon.area <= 0.0:
        return None
    return Polygon(polygon.exterior)


def _iou(a: Polygon, b: Polygon) -> float:
    return float(a.intersection(b).area / a.union(b).area)


def _cells_inside(polygon: Polygon, shape: tuple[int, int]) -> NDArrayBool:
    """(y, x) bool of the cells whose centres lie in a polygon given in cells."""
    x0, y0, x1, y1 = polygon.bounds
    inside = np.zeros(shape, dtype=bool)
    cols = np.arange(max(int(np.floor(x0)), 0), min(int(np.ceil(x1)) + 1, shape[1]))
    rows = np.arange(max(int(np.floor(y0)), 0), min(int(np.ceil(y1)) + 1, shape[0]))
    if len(cols) and len(rows):
        shapely.prepare(polygon)
        inside[np.ix_(rows, cols)] = shapely.contains_xy(polygon, *np.meshgrid(cols, rows))
    return inside
