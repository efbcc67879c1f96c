"""What is painted on the road: the shapes of lines, zebra stripes and arrows."""

from __future__ import annotations

from typing import Final

import numpy as np
import shapely

from hdmap_tools.geometry.polyline import arc_lengths, drop_repeats
from hdmap_tools.map_model.elements import MarkStyle
from hdmap_tools.simulate.world_map import Paint
from hdmap_tools.types import NDArrayFloat

DOUBLE_GAP_M: Final = 0.12
"""Between the two stripes of a double line (RMS and MUTCD: about the width of a stripe)."""

ZEBRA_STRIPE_M: Final = 0.5
"""Width of a stripe of a zebra crossing, and of the gap beside it (0.5 m in most of Europe)."""

STOP_LINE_M: Final = 0.4

_STYLES: Final[dict[MarkStyle, tuple[bool, ...]]] = {
    MarkStyle.SOLID: (False,),
    MarkStyle.UNKNOWN: (False,),
    MarkStyle.DASHED: (True,),
    MarkStyle.SOLID_SOLID: (False, False),
    MarkStyle.SOLID_DASHED: (False, True),
    MarkStyle.DASHED_SOLID: (True, False),
}
"""Whether each stripe is dashed, from left to right along the line."""


def line_quads(xy: NDArrayFloat, paint: Paint, phase_m: float = 0.0) -> NDArrayFloat:
    """The painted area of a line as quadrilaterals (N, 4, 2), city metres.

    Args:
        xy: (K, 2) centre of the paint, city metres.
        paint: How it is painted.
        phase_m: Where in its dash pattern the line begins.
    """
    dashed = _STYLES[paint.style]
    quads = []
    for k, is_dashed in enumerate(dashed):
        side = 0.0
        if len(dashed) == 2:
            side = (0.5 - k) * (paint.width_m + DOUBLE_GAP_M)
        quads.append(stripe_quads(xy, side, paint, is_dashed, phase_m))
    return np.concatenate(quads)


def stripe_quads(
    xy: NDArrayFloat, side_m: float, paint: Paint, is_dashed: bool, phase_m: float
) -> NDArrayFloat:
    """One stripe whose centre runs side_m to the left of a line, as quadrilaterals (N, 4, 2)."""
    xy = drop_repeats(np.asarray(xy, dtype=np.float64)[:, :2])
    if len(xy) < 2:
        return np.zeros((0, 4, 2))
    along = arc_lengths(xy)
    mitre = _mitres(xy)
    cuts = along
    if is_dashed:
        period = paint.dash_m + paint.gap_m
        first = np.floor(phase_m / period) * period - phase_m
        starts = np.arange(first, along[-1], period)
        cuts = np.unique(
            np.clip(np.concatenate([along, starts, starts + paint.dash_m]), 0.0, along[-1])
        )
    centre = np.column_stack([np.interp(cuts, along, xy[:, d]) for d in (0, 1)])
    offset = np.column_stack([np.interp(cuts, along, mitre[:, d]) for d in (0, 1)])
    left = centre + offset * (side_m + paint.width_m / 2)
    right = centre + offset * (side_m - paint.width_m / 2)
    quads = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
    if is_dashed:
        middle = (cuts[:-1] + cuts[1:]) / 2 + phase_m
        quads = quads[np.mod(middle, paint.dash_m + paint.gap_m) < paint.dash_m]
    return quads


def _mitres(xy: NDArrayFloat) -> NDArrayFloat:
    """(K, 2) per vertex: times an offset to the left, the corner of the parallel line."""
    steps = np.diff(xy, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    normal = np.column_stack([-steps[:, 1], steps[:, 0]])
    before = np.concatenate([normal[:1], normal])
    after = np.concatenate([normal, normal[-1:]])
    total = before + after
    square = np.maximum(np.einsum("ij,ij->i", total, total), 1.0)  # no spikes at sharp turns
    mitre: NDArrayFloat = 2.0 * total / square[:, None]
    return mitre


def stop_line_quads(line: shapely.LineString) -> NDArrayFloat:
    """The painted area of a stop line (N, 4, 2), city metres."""
    paint = Paint(style=MarkStyle.SOLID, width_m=STOP_LINE_M)
    return line_quads(shapely.get_coordinates(line), paint)


def arrow_polygon(tip: NDArrayFloat, ahead: NDArrayFloat, turn: int) -> shapely.Polygon:
    """A lane arrow of 4 m, straight on (0), to the left (1) or to the right (-1).

    Args:
        tip: (2,) city metres, its foremost point.
        ahead: (2,) unit vector, driving direction.
        turn: Which.
    """
    if turn == 0:
        x = [0, -1.5, -1.5, -4.0, -4.0, -1.5, -1.5]
        y = [0, 0.38, 0.08, 0.08, -0.08, -0.08, -0.38]
    else:
        x = [-0.9, -0.2, -0.75, -0.75, -1.3, -4.0, -4.0, -1.15, -1.05, -1.6]
        y = [0.95, 0.25, 0.25, 0.05, -0.08, -0.08, 0.08, 0.08, 0.25, 0.25]
        y = [turn * v for v in y]
    left = np.array([-ahead[1], ahead[0]])
    return shapely.Polygon(tip + np.outer(x, ahead) + np.outer(y, left))
