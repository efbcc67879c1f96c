"""What paint looks like in lidar intensity: the threshold k between asphalt and paint."""

from __future__ import annotations

import numpy as np

from hdmap_tools.types import NDArrayByte


def otsu_threshold(intensity: NDArrayByte) -> int | None:
    """The intensity from which on a return on the road looks like paint, by Otsu's method.

    Args:
        intensity: (N,) uint8 of returns on road and lane marks.

    Returns:
        k in 1..255, or None when all values are equal or there are none: then
        nothing tells the two apart.

    Source:
        Otsu, A threshold selection method from gray-level histograms, 1979.
    """
    counts = np.bincount(intensity, minlength=256).astype(np.float64)
    total = counts.sum()
    if total == 0 or np.count_nonzero(counts) < 2:
        return None
    below = np.cumsum(counts)[:-1]
    above = total - below
    sum_below = np.cumsum(counts * np.arange(256))[:-1]
    mean_gap = sum_below / np.maximum(below, 1) - (
        sum_below[-1] + counts[255] * 255 - sum_below
    ) / np.maximum(above, 1)
    between = below * above * mean_gap**2
    # The gap between two groups is flat: take its middle, not its first value.
    best = np.flatnonzero(between >= between.max() * (1 - 1e-12))
    return int(best[len(best) // 2]) + 1
