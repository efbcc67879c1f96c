"""Painted lines along the lane, from the map's lane-mark probability."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final

import numpy as np
import shapely
from pydantic import Field
from scipy import ndimage
from shapely.geometry import LineString

from hdmap_plugins.dashes import JoinRules, Line, join_strokes, stations_of
from hdmap_plugins.lines import MIN_STEP_M, kept_by_simplification, smooth
from hdmap_plugins.profiles import (
    Stroke,
    extend_to_ends,
    highest_across,
    meet_at_junctions,
    refine,
    unfolded,
)
from hdmap_plugins.sampling import (
    disk,
    fill_small_gaps,
    height_surface,
    heights_along,
    to_city,
    votes_at,
)
from hdmap_plugins.short_strokes import take_short_strokes
from hdmap_plugins.skeleton_graph import skeleton_lines
from hdmap_tools.geometry.polyline import drop_repeats
from hdmap_tools.plugin_api import (
    LaneMark,
    MapClass,
    MapElement,
    MapWindow,
    MarkStyle,
    Vectorizer,
    VectorizerOptions,
    VectorMap,
)
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_MAX_FOLD_M: Final = 1.0
"""Within this length no painted line turns round, not even at the nose of an island."""


class LaneMarkSkeletonOptions(VectorizerOptions):
    """Options of `LaneMarkSkeleton`.

    Attributes:
        high_threshold: A line needs this probability somewhere. Cells that a thin
            line only partly covers never come near 1: 0.15 m of paint in cells of
            0.2 m may give 0.38 in two of them.
        low_threshold: And goes on down to this one.
        contrast: Cells below this share of the highest probability within two cells
            are flanks, not lines: keeps double lines apart.
        max_width_m: Wider paint is an area (arrow, symbol, hatching), no line.
        max_symbol_m: Paint that is no longer than this and wider across than
            ``max_width_m`` (and a cell's blur on each side) is a symbol.
        min_stroke_m: Shorter pieces of paint are specks, not even dashes.
        min_length_m: Marks with less paint in them are dropped.
        spur_factor: Side branches shorter than this many mask widths are cut off.
        max_deflection_deg: Largest bend with which a line runs on through a junction.
        fill_gap_m: Unknown stripes (between lidar rings) up to this wide are filled.
        bridge_gap_m: An unbroken line is carried over known gaps up to this long (wear).
        max_dash_m: Longest dash.
        min_gap_m: Shortest gap between dashes; shorter known ones are wear.
        max_gap_m: Longest gap between dashes.
        min_dashes: Fewer strokes in a row are not called dashed.
        rhythm: Share by which dashes and gaps may differ from their median.
        max_angle_deg: Largest angle between the end of a dash and the way to the next.
        min_solid_m: An unbroken stroke of at least this length is solid. The style of a
            shorter one is unknown, and alone it is no line.
        keep_lone_strokes: Report also short strokes that are neither in a row of dashes
            nor pieces of a longer line; most are arrows, letters and fragments.
        smooth_wavelength_m: Wiggles shorter than this are smoothed.
        simplify_m: Tolerance of leaving out vertices.
    """

    high_threshold: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.3
    low_threshold: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.15
    contrast: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.4
    max_width_m: Annotated[float, Field(gt=0.0, le=2.0)] = 0.45
    max_symbol_m: Annotated[float, Field(ge=0.0)] = 8.0
    min_stroke_m: Annotated[float, Field(ge=0.0)] = 0.4
    min_length_m: Annotated[float, Field(ge=0.0)] = 1.0
    spur_factor: Annotated[float, Field(ge=0.0, le=20.0)] = 2.0
    max_deflection_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 35.0
    fill_gap_m: Annotated[float, Field(ge=0.0, le=5.0)] = 0.3
    bridge_gap_m: Annotated[float, Field(ge=0.0)] = 0.8
    max_dash_m: Annotated[float, Field(gt=0.0)] = 8.0
    min_gap_m: Annotated[float, Field(ge=0.0)] = 0.4
    max_gap_m: Annotated[float, Field(gt=0.0)] = 13.0
    min_dashes: Annotated[int, Field(ge=2)] = 3
    rhythm: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.35
    max_angle_deg: Annotated[float, Field(gt=0.0, le=45.0)] = 15.0
    min_solid_m: Annotated[float, Field(gt=0.0)] = 8.0
    keep_lone_strokes: bool = False
    smooth_wavelength_m: Annotated[float, Field(gt=0.0, le=50.0)] = 4.0
    simplify_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02


class LaneMarkSkeleton(Vectorizer):
    """Skeleton, graph, lines; then each line moved onto the centre of the paint.

    The thresholded map only says that there is a line. Where it runs, how wide it is
    and where it ends comes from the probability itself, between cell centres. The
    geometry is the centre of the paint; its direction means nothing. Long stop lines
    and other narrow cross lines are reported as lane marks too.

    A short stroke by itself is no line, for an arrow without its head looks the same:
    it needs a row of dashes, or other pieces of its line, unless ``keep_lone_strokes``.
    The confidence is the mean along the paint of the highest probability across it.
    """

    name = "lane_mark_skeleton"
    element_types: ClassVar[tuple[type[MapElement], ...]] = (LaneMark,)
    halo_m: ClassVar[float] = 20.0
    Options = LaneMarkSkeletonOptions

    def vectorize(
        self, window: MapWindow, upstream: VectorMap, options: Any, *, rng: np.random.Generator
    ) -> list[MapElement]:
        """Lane marks of the window; see the class for the method."""
        resolution = window.grid.resolution_m
        raw = window.probability(MapClass.LANE_MARK).astype(np.float64)
        if min(raw.shape) == 0 or not (raw >= options.low_threshold).any():
            return []
        filled, is_known = fill_small_gaps(raw, window.is_known, options.fill_gap_m / resolution)
        paint = _above_background(filled, is_known, options.max_width_m / resolution)
        wide = _wide_areas(filled, options.max_width_m / resolution)
        mask = _line_mask(paint, wide, options, resolution)
        reach = options.max_width_m / 2.0 / resolution + 2.0
        short, mask = take_short_strokes(paint, mask, reach=reach)
        strokes = [
            s
            for s in short
            if _is_narrow_paint(s, options, resolution)
            and s.length * resolution >= options.min_stroke_m
        ]
        for line in skeleton_lines(
            mask,
            spur_factor=options.spur_factor,
            max_deflection_deg=options.max_deflection_deg,
        ):
            stroke = refine(
                paint,
                line.xy_cells,
                line.at_junction,
                reach=reach,
                wavelength=options.smooth_wavelength_m / resolution,
            )
            if _is_narrow_paint(stroke, options, resolution):
                stroke = extend_to_ends(paint, stroke, reach=reach)
                if stroke.length * resolution >= options.min_stroke_m:
                    strokes.append(stroke)
        max_fold = _MAX_FOLD_M / resolution
        strokes = [
            piece
            for stroke in meet_at_junctions(strokes)
            for piece in unfolded(stroke, max_fold)
            if piece.length * resolution >= options.min_stroke_m
        ]
        rules = JoinRules(
            max_gap=options.max_gap_m / resolution,
            max_dash=options.max_dash_m / resolution,
            min_gap=options.min_gap_m / resolution,
            bridge_gap=options.bridge_gap_m / resolution,
            min_dashes=options.min_dashes,
            rhythm=options.rhythm,
            max_angle_deg=options.max_angle_deg,
            min_solid=options.min_solid_m / resolution,
            max_fold=max_fold,
        )
        surface = height_surface(window.layer("height"))
        marks = (
            _lane_mark(line, window, filled, surface, options)
            for line in join_strokes(strokes, is_known, rules)
            if options.keep_lone_strokes or not line.is_lone
        )
        return [mark for mark in marks if mark is not None]


def _is_narrow_paint(stroke: Stroke, options: LaneMarkSkeletonOptions, resolution: float) -> bool:
    """Whether a stroke is no wider than a line and mostly above the threshold."""
    is_narrow = 0.0 < stroke.width_cells * resolution <= options.max_width_m
    return is_narrow and float(np.median(stroke.peak)) >= options.low_threshold


def _above_background(
    probability: NDArrayFloat, is_known: NDArrayBool, max_width_cells: float
) -> NDArrayFloat:
    """(y, x) in 0..1: how far the probability of paint stands out of the ground around it.

    A network that often misses paint leaves every road cell with some probability of
    it (0.2 and more), which is no line however far it goes. The ground's level is the
    probability opened by a square that no line can hold, over known cells only.
    """
    size = 2 * int(np.ceil(max_width_cells / 2.0 + 1.0)) + 1
    eroded = ndimage.minimum_filter(np.where(is_known, probability, np.inf), size=size)
    ground = ndimage.maximum_filter(np.where(is_known, eroded, -np.inf), size=size)
    ground = np.where(is_known, np.minimum(ground, probability), 0.0)
    return np.asarray((probability - ground) / np.maximum(1.0 - ground, 1e-6))


def _line_mask(
    paint: NDArrayFloat, wide: NDArrayBool, options: LaneMarkSkeletonOptions, resolution: float
) -> NDArrayBool:
    """(y, x) bool: cells of thin paint, wide areas and symbols taken out."""
    from skimage.filters import apply_hysteresis_threshold

    # Half a cell of blur evens out how a thin line falls on the cells.
    blurred = ndimage.gaussian_filter(paint, 0.5, mode="constant")
    mask = np.asarray(
        apply_hysteresis_threshold(blurred, options.low_threshold, options.high_threshold)
    )
    if not mask.any():
        return mask
    # Opening takes the inside of an area; what is left of it is a rim.
    mask |= wide
    labels, count = ndimage.label(mask, structure=np.ones((3, 3)))
    is_dropped = np.zeros(count + 1, dtype=bool)
    for label, area in enumerate(ndimage.find_objects(labels), start=1):
        member = labels[area] == label
        if (wide[area] & member).sum() > 0.3 * member.sum():
            is_dropped[label] = True
            continue
        long_side, short_side = _extents(member)
        is_dropped[label] = (
            long_side * resolution <= options.max_symbol_m
            and short_side > options.max_width_m / resolution + 2.0
        )
    mask &= ~is_dropped[labels] & ~wide
    mask &= blurred >= options.contrast * ndimage.maximum_filter(blurred, size=5)
    # What the cuts left over must be sure of itself somewhere.
    labels, count = ndimage.label(mask, structure=np.ones((3, 3)))
    is_sure = np.zeros(count + 1, dtype=bool)
    is_sure[np.unique(labels[mask & (blurred >= options.high_threshold)])] = True
    return np.asarray(mask & is_sure[labels])


def _wide_areas(paint: NDArrayFloat, max_width_cells: float) -> NDArrayBool:
    """Cells in paint much wider than a line.

    Over a disk twice the widest line across, a line of that width covers 0.61 and
    only an area covers 0.8.
    """
    footprint = disk(max_width_cells).astype(np.float64)
    share = ndimage.correlate(paint, footprint / footprint.sum(), mode="constant")
    core = share >= 0.8
    return np.asarray(ndimage.binary_dilation(core, footprint > 0) if core.any() else core)


def _extents(member: NDArrayBool) -> tuple[float, float]:
    """Length and width, cells, of the smallest rectangle around a set of cells."""
    rows, cols = np.nonzero(member)
    box = shapely.MultiPoint(np.column_stack([cols, rows])).minimum_rotated_rectangle
    if box.geom_type != "Polygon":
        return float(box.length) + 1.0, 1.0
    sides = np.linalg.norm(np.diff(np.asarray(box.exterior.coords)[:3], axis=0), axis=1)
    return float(sides.max()) + 1.0, float(sides.min()) + 1.0


def _lane_mark(
    line: Line,
    window: MapWindow,
    probability: NDArrayFloat,
    surface: NDArrayFloat | None,
    options: LaneMarkSkeletonOptions,
) -> LaneMark | None:
    """The element of one line, or None when it is too short."""
    resolution = window.grid.resolution_m
    length_m = line.paint * resolution
    if length_m < max(options.min_length_m, 2.0 * resolution):
        return None
    xy, is_painted = stations_of(line)
    if len(line.strokes) > 1 or line.strokes[0].is_fused:
        xy = smooth(
            xy, options.smooth_wavelength_m / resolution, weights=is_painted.astype(np.float64)
        )
    kept = kept_by_simplification(
        xy, options.simplify_m / resolution, is_closed=line.strokes[0].is_closed
    )
    z = heights_along(surface, xy, round(2.0 / resolution))
    geometry = LineString(
        drop_repeats(np.column_stack([to_city(xy[kept], window.grid), z[kept]]), MIN_STEP_M)
    )
    painted = xy[is_painted]
    votes = votes_at(window.layer("observations"), painted)
    if line.is_dashed:
        style = MarkStyle.DASHED
    else:
        style = MarkStyle.SOLID if length_m >= options.min_solid_m else MarkStyle.UNKNOWN
    return LaneMark(
        geometry=geometry,
        style=style,
        width_m=_mean_over_paint([s.width_cells for s in line.strokes], line.strokes) * resolution,
        confidence=float(
            np.mean([p for s in line.strokes for p in highest_across(probability, s.xy_cells)])
        ),
        sigma_m=_sigma_cells(line, votes) * resolution,
        num_observations=votes,
    )


def _sigma_cells(line: Line, votes: int) -> float:
    """How well a line's place across is known, cells.

    ``sigma^2 = scatter^2 + 1 / (12 votes)``: the scatter of single stations about the
    smooth line (not divided by their number, because what moves them, poses and
    labels, moves neighbours together), and the place of one vote within its cell,
    which is uniform (variance 1/12) and averages over votes.
    """
    scatter = _mean_over_paint([s.scatter_cells**2 for s in line.strokes], line.strokes)
    return float(np.sqrt(scatter + 1.0 / (12.0 * max(votes, 1))))


def _mean_over_paint(values: list[float], strokes: tuple[Stroke, ...]) -> float:
    return float(np.average(values, weights=[s.length + 1e-9 for s in strokes]))
