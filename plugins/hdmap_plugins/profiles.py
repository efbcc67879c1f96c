"""Where a painted line truly runs, how wide it is and where it ends, from the probability across it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import cKDTree
from shapely.geometry import LineString, Point

from hdmap_plugins.lines import fold_cuts, smooth
from hdmap_plugins.sampling import bilinear
from hdmap_tools.geometry.polyline import arc_lengths, normals, resample
from hdmap_tools.types import NDArrayFloat, NDArrayInt

_ACROSS_STEP = 0.25
"""Spacing of samples across a line, cells: bilinear interpolation has nothing finer to show."""

_MAX_EXTENSION = 12.0
"""How far beyond its skeleton a line may go on straight, cells: over a bend of radius 20 m, 4 cm off."""


@dataclass(frozen=True)
class Stroke:
    """An unbroken painted line, in cells, at stations about one cell apart.

    Attributes:
        xy_cells: (N, 2) centre of the paint.
        mass: (N,) integral of the probability across, cells: the width of the paint.
        peak: (N,) highest probability across.
        scatter_cells: Robust sigma of the single stations about the smooth line.
        at_junction: Whether the first and last station lie on another line.
        is_fused: Whether it was put together over gaps and is not smooth yet.
    """

    xy_cells: NDArrayFloat
    mass: NDArrayFloat
    peak: NDArrayFloat
    scatter_cells: float
    at_junction: tuple[bool, bool]
    is_fused: bool = False

    @property
    def length(self) -> float:
        """Cells."""
        return float(arc_lengths(self.xy_cells)[-1])

    @property
    def is_closed(self) -> bool:
        """Whether it is a ring."""
        return len(self.xy_cells) > 3 and bool(np.all(self.xy_cells[0] == self.xy_cells[-1]))

    @property
    def width_cells(self) -> float:
        """Width of the paint: mean of the mass, without its highest and lowest tenth."""
        ordered = np.sort(self.mass)
        cut = len(ordered) // 10
        return float(np.mean(ordered[cut : len(ordered) - cut]))

    def reversed(self) -> Stroke:
        """The same line the other way."""
        return replace(
            self,
            xy_cells=self.xy_cells[::-1],
            mass=self.mass[::-1],
            peak=self.peak[::-1],
            at_junction=self.at_junction[::-1],
        )


def measure_across(
    probability: NDArrayFloat, xy_cells: NDArrayFloat, normal: NDArrayFloat, reach: float
) -> tuple[NDArrayFloat, NDArrayFloat, NDArrayFloat]:
    """Centre, mass and peak of the line's own lobe of the probability across it.

    The lobe ends where the probability has fallen to a tenth of its peak or, beside
    another line, in the valley between the two. The mass is the integral of the
    probability, which sampling by cells preserves: a line thinner than a cell gives
    its true width although no cell is fully covered. (A full width at half maximum
    could never be less than a cell.)

    Args:
        probability: (y, x).
        xy_cells: (N, 2) stations.
        normal: (N, 2) unit normals.
        reach: Half length of the profile, cells.

    Returns:
        offset (N,) of the centre along the normal, cells; mass (N,), cells; peak (N,).
    """
    half = int(np.ceil(reach / _ACROSS_STEP))
    across = np.arange(-half, half + 1) * _ACROSS_STEP
    places = xy_cells[:, None, :] + across[None, :, None] * normal[:, None, :]
    profile = bilinear(probability, places)
    profile = np.maximum(profile - float(np.median(profile.min(axis=1))), 0.0)

    centred = np.where(np.abs(across) <= 1.5, profile, -1.0)
    top = np.argmax(centred, axis=1)
    rows = np.arange(len(profile))
    peak = profile[rows, top]
    reaches = [_lobe_reach(profile, top, peak, direction) for direction in (-1, 1)]
    columns = np.arange(profile.shape[1])
    in_lobe = (columns >= (top - reaches[0])[:, None]) & (columns <= (top + reaches[1])[:, None])
    lobe = np.where(in_lobe, profile, 0.0)
    mass = lobe.sum(axis=1) * _ACROSS_STEP
    offset = (lobe @ across) * _ACROSS_STEP / np.maximum(mass, 1e-9)
    return np.where(mass > 1e-9, offset, 0.0), mass, np.clip(peak, 0.0, 1.0)


def _lobe_reach(
    profile: NDArrayFloat, top: NDArrayInt, peak: NDArrayFloat, direction: int
) -> NDArrayInt:
    """How many samples (N,) a lobe reaches from its top to one side."""
    outward = np.arange(profile.shape[1])
    at = top[:, None] + direction * outward
    is_inside = (at >= 0) & (at < profile.shape[1])
    values = np.take_along_axis(profile, np.where(is_inside, at, 0), axis=1)
    values = np.where(is_inside, values, np.inf)
    lowest = np.minimum.accumulate(values, axis=1)
    # Up again by an eighth of the peak: the flank of a neighbour.
    is_past = values > lowest + 0.125 * peak[:, None]
    is_past[:, 1:] |= lowest[:, :-1] <= 0.1 * peak[:, None]
    is_past = np.logical_or.accumulate(is_past, axis=1) | ~is_inside
    is_past[:, 0] = False
    return np.asarray(np.argmin(np.where(is_past, np.inf, values), axis=1))


def refine(
    probability: NDArrayFloat,
    path_cells: NDArrayFloat,
    at_junction: tuple[bool, bool],
    *,
    reach: float,
    wavelength: float,
) -> Stroke:
    """Move a skeleton onto the centre of the paint.

    Twice: smooth, measure across, move by the centroid, smooth with the mass as
    weight. The skeleton only says roughly where to look.

    Args:
        probability: (y, x), 0 where unknown.
        path_cells: (N, 2) skeleton.
        at_junction: See `Stroke`.
        reach: Half length of the profiles, cells.
        wavelength: Wiggles along the line shorter than this are smoothed, cells.
    """
    is_closed = len(path_cells) > 3 and bool(np.all(path_cells[0] == path_cells[-1]))
    xy = smooth(resample(path_cells, 1.0), 8.0, is_closed=is_closed)
    measured = xy
    for _ in range(2):
        xy = resample(xy, 1.0)
        if is_closed:
            xy[-1] = xy[0]
        normal = _normals(xy, is_closed)
        offset, mass, _ = measure_across(probability, xy, normal, reach)
        measured = xy + np.clip(offset, -1.5, 1.5)[:, None] * normal
        xy = smooth(measured, wavelength, weights=_weights(mass), is_closed=is_closed)
    normal = _normals(xy, is_closed)
    residual = np.einsum("nk,nk->n", measured - xy, normal)
    scatter = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    _, mass, peak = measure_across(probability, xy, normal, reach)
    return Stroke(xy, mass, peak, scatter, at_junction)


def extend_to_ends(probability: NDArrayFloat, stroke: Stroke, *, reach: float) -> Stroke:
    """Let a line end where the paint does: where the mass across has fallen to half.

    A skeleton ends about half a width early and bends towards a corner of the mask,
    so each free end is first cut back by a width and then carried on straight.
    """
    for _ in range(2):
        stroke = stroke.reversed()
        if stroke.at_junction[1] or stroke.is_closed:
            continue
        stroke = _extend_last(probability, stroke, reach)
    return stroke


def _extend_last(probability: NDArrayFloat, stroke: Stroke, reach: float) -> Stroke:
    width = stroke.width_cells
    half = 0.5 * float(np.median(stroke.mass))
    # A mask may lead on along something faint; five stations outvote a worn cell or two.
    steady = ndimage.median_filter(stroke.mass, size=min(5, len(stroke.mass)), mode="nearest")
    count = int(np.flatnonzero(steady >= half)[-1]) + 1 if (steady >= half).any() else 0
    cut = min(int(np.ceil(width)) + 1, max(count - 1, 0) // 3)
    keep = count - cut
    body = stroke.xy_cells[:keep]
    if len(body) < 2:
        return stroke
    tail = body[-min(len(body), 10) :]
    heading = tail[-1] - tail[0]
    length = float(np.hypot(*heading))
    if length < 1e-9:
        return stroke
    heading = heading / length
    if len(tail) >= 6:
        # On a curve the chord lags behind the tangent by half the turn of its two halves.
        middle = len(tail) // 2
        first, second = tail[middle] - tail[0], tail[-1] - tail[middle]
        turn = np.arctan2(first[0] * second[1] - first[1] * second[0], first @ second)
        turn = float(np.clip(turn, -0.15, 0.15))
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        heading = rotation @ heading
    farthest = cut + width + _MAX_EXTENSION
    along = np.arange(0.0, farthest + _ACROSS_STEP, _ACROSS_STEP)
    places = body[-1] + along[:, None] * heading
    normal = np.tile([-heading[1], heading[0]], (len(along), 1))
    offset, mass, peak = measure_across(probability, places, normal, reach)
    # Paint beside the way ahead is another line's.
    mass = np.where(np.abs(offset) <= 1.0, mass, 0.0)
    below = np.flatnonzero(mass < half)
    if len(below) == 0:
        end = float(cut)
    elif below[0] == 0:
        end = 0.0
    else:
        k = int(below[0])
        end = along[k - 1] + _ACROSS_STEP * float((mass[k - 1] - half) / (mass[k - 1] - mass[k]))
    steps = np.append(np.arange(1.0, end - 0.5, 1.0), end) if end > 1e-6 else np.empty(0)
    added = body[-1] + steps[:, None] * heading
    return replace(
        stroke,
        xy_cells=np.vstack([body, added]),
        # The end cells are partly covered by nature; their mass would thin the line.
        mass=np.append(stroke.mass[:keep], np.full(len(steps), 2.0 * half)),
        peak=np.append(stroke.peak[:keep], np.interp(steps, along, peak)),
    )


def meet_at_junctions(strokes: list[Stroke]) -> list[Stroke]:
    """Let each line that ends at a junction end exactly on the line that runs on there.

    Where two marks run into one another the profile across one holds paint of the
    other. So the last stations, where the paint overlaps, are left out and the line
    goes straight on to the other.
    """
    result = list(strokes)
    if len(strokes) < 2:
        return result
    owner = np.concatenate([np.full(len(s.xy_cells), k) for k, s in enumerate(strokes)])
    tree = cKDTree(np.vstack([s.xy_cells for s in strokes]))
    for index in range(len(result)):
        for _ in range(2):
            result[index] = result[index].reversed()
            stroke = result[index]
            if not stroke.at_junction[1]:
                continue
            end = stroke.xy_cells[-1]
            near = np.sort(tree.query_ball_point(end, stroke.width_cells + 3.0)).astype(np.int64)
            near = near[owner[near] != index]
            if len(near):
                closest = near[np.argmin(np.hypot(*(tree.data[near] - end).T))]
                result[index] = _meet_at_last(stroke, result[owner[closest]])
    return result


def _meet_at_last(stroke: Stroke, other: Stroke) -> Stroke:
    end = stroke.xy_cells[-1]
    limit = stroke.width_cells + 3.0
    if len(stroke.xy_cells) < 6:
        return stroke
    line = LineString(other.xy_cells)
    # Cells blur each by one: nearer than this the two are not told apart.
    overlap = (stroke.width_cells + other.width_cells) / 2.0 + 2.0
    apart = np.flatnonzero(shapely.distance(shapely.points(stroke.xy_cells), line) > overlap)
    if len(apart) == 0 or apart[-1] < 2:
        return stroke
    keep = int(apart[-1]) + 1
    body = stroke.xy_cells[:keep]
    tail = body[-min(len(body), 8) :]
    heading = tail[-1] - tail[0]
    heading = heading / max(float(np.hypot(*heading)), 1e-9)
    # A branch that leaves at a small angle meets the other far ahead; no farther than it overlaps.
    ahead = LineString(
        [body[-1], body[-1] + heading * (2.0 * (len(stroke.xy_cells) - keep) + limit)]
    )
    hit = ahead.intersection(line)
    points = shapely.get_coordinates(hit)
    if len(points):
        foot = points[int(np.argmin(np.hypot(*(points - body[-1]).T)))]
    else:
        foot = shapely.get_coordinates(line.interpolate(line.project(Point(end))))[0]
    count = max(round(float(np.hypot(*(foot - body[-1])))), 1)
    added = np.linspace(body[-1], foot, count + 1)[1:]
    typical = float(np.median(stroke.mass[:keep]))
    return replace(
        stroke,
        xy_cells=np.vstack([body, added]),
        mass=np.append(stroke.mass[:keep], np.full(count, typical)),
        peak=np.append(stroke.peak[:keep], np.full(count, float(stroke.peak[keep - 1]))),
    )


def unfolded(stroke: Stroke, max_fold: float) -> list[Stroke]:
    """The stroke cut wherever it would fold back on itself; see `fold_cuts`."""
    cuts = fold_cuts(stroke.xy_cells, max_fold)
    if not cuts:
        return [stroke]
    bounds = [0, *cuts, len(stroke.xy_cells) - 1]
    return [
        replace(
            stroke,
            xy_cells=stroke.xy_cells[a : b + 1],
            mass=stroke.mass[a : b + 1],
            peak=stroke.peak[a : b + 1],
            at_junction=(
                stroke.at_junction[0] and a == 0,
                stroke.at_junction[1] and b == bounds[-1],
            ),
        )
        for a, b in pairwise(bounds)
        if b > a
    ]


def highest_across(probability: NDArrayFloat, xy_cells: NDArrayFloat) -> NDArrayFloat:
    """Highest probability (N,) across a line, within a cell and a half of each station."""
    across = np.arange(-6, 7) * _ACROSS_STEP
    places = xy_cells[:, None, :] + across[None, :, None] * normals(xy_cells)[:, None, :]
    return np.asarray(np.clip(bilinear(probability, places).max(axis=1), 0.0, 1.0))


def _normals(xy: NDArrayFloat, is_closed: bool) -> NDArrayFloat:
    if not is_closed:
        return normals(xy)
    return normals(np.vstack([xy[-2:-1], xy, xy[1:2]]))[1:-1]


def _weights(mass: NDArrayFloat) -> NDArrayFloat:
    return np.asarray(np.clip(mass / max(float(np.median(mass)), 1e-9), 0.02, 2.0))
