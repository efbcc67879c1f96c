"""Dashes of a few cells, which are too short for a skeleton to say where they point."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from hdmap_plugins.profiles import Stroke, measure_across
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_LONGEST_CELLS = 8
"""Longer areas have a skeleton of several cells, whose direction is good to some degrees."""

_LEAST_ELONGATION = 1.5
"""Length over width below which a patch points nowhere."""


def take_short_strokes(
    paint: NDArrayFloat, mask: NDArrayBool, *, reach: float
) -> tuple[list[Stroke], NDArrayBool]:
    """Strokes of the small areas of a mask, from the moments of the paint in them.

    A uniform stroke of length L drawn in cells has the variance ``L^2 / 12 + 1 / 12``
    along itself, and its main axis is its direction.

    Args:
        paint: (y, x) probability above the ground's.
        mask: (y, x) bool, cells of lines.
        reach: Half length of the profiles across, cells.

    Returns:
        The strokes, and the mask without all small areas: those that are as wide as
        long are specks.
    """
    labels, _ = ndimage.label(mask, structure=np.ones((3, 3)))
    rest = mask.copy()
    strokes = []
    for label, area in enumerate(ndimage.find_objects(labels), start=1):
        rows, cols = area
        if max(rows.stop - rows.start, cols.stop - cols.start) > _LONGEST_CELLS:
            continue
        rest[area] &= labels[area] != label
        # The flanks carry the place between cells, unless they are another area's.
        row0, col0 = max(rows.start - 1, 0), max(cols.start - 1, 0)
        around = (slice(row0, rows.stop + 1), slice(col0, cols.stop + 1))
        member = ndimage.binary_dilation(labels[around] == label, np.ones((3, 3)))
        member &= (labels[around] == 0) | (labels[around] == label)
        stroke = _stroke_from_moments(
            paint, np.argwhere(member) + [row0, col0], paint[around][member], reach
        )
        if stroke is not None:
            strokes.append(stroke)
    return strokes, rest


def _stroke_from_moments(
    paint: NDArrayFloat, rows_cols: NDArrayFloat, weight: NDArrayFloat, reach: float
) -> Stroke | None:
    total = float(weight.sum())
    if total <= 0.0:
        return None
    xy = rows_cols[:, ::-1].astype(np.float64)
    centre = weight @ xy / total
    spread = ((xy - centre) * weight[:, None]).T @ (xy - centre) / total
    variances, axes = np.linalg.eigh(spread)
    lengths = np.sqrt(np.maximum(12.0 * variances - 1.0, 0.0))
    if lengths[1] < max(_LEAST_ELONGATION * lengths[0], 1.0):
        return None
    direction = axes[:, 1]
    if direction[np.argmax(np.abs(direction))] < 0.0:
        direction = -direction
    along = np.linspace(-0.5, 0.5, max(round(float(lengths[1])), 1) + 1) * lengths[1]
    stations = centre + along[:, None] * direction
    normal = np.tile([-direction[1], direction[0]], (len(stations), 1))
    _, _, peak = measure_across(paint, stations, normal, reach)
    mass = np.full(len(stations), total / float(lengths[1]))
    return Stroke(stations, mass, peak, 0.0, (False, False))
