"""Lidar intensity made comparable over rings and ranges, from what the road itself looks like.

Lasers of one lidar differ, and the return of the same asphalt weakens with range and
grazing angle. On ground near the driven path, most of which is asphalt, the typical
intensity of each ring and range is measured, a gain for each ring and a smooth
response over range are fitted, and both are divided out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt

_RANGE_BIN_M: Final = 1.0
_NUM_BINS: Final = 100
_NUM_RINGS: Final = 256
_FEWEST: Final = 30
"""Returns of a ring and range bin from which its typical intensity is known."""
_SMOOTH: Final = 30.0
_FLAT: Final = 0.02
_RIDGE: Final = 1.0
_MAX_GAIN: Final = 20.0


@dataclass(frozen=True, eq=False)
class IntensityResponse:
    """What the lidar makes of one reflectivity, by ring and range.

    Attributes:
        log_ring: (256,) natural logarithm of each ring's gain; mean 0 over those seen.
        log_range: (100,) of the response at the middle of bins of 1 m.
        asphalt: Level to which asphalt is brought, 0..255.
    """

    log_ring: NDArrayFloat
    log_range: NDArrayFloat
    asphalt: float

    def normalized(
        self, intensity: NDArrayByte, ring: NDArrayByte, range_m: NDArrayFloat
    ) -> NDArrayByte:
        """Intensity (N,) with the response divided out, 0..255, asphalt at `asphalt`."""
        gain_of_ring = self.asphalt / np.exp(self.log_ring)
        normal: NDArrayByte = _normalized(intensity, ring, range_m, gain_of_ring, self.log_range)
        return normal


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _normalized(
    intensity: NDArrayByte,
    ring: NDArrayByte,
    range_m: NDArrayFloat,
    gain_of_ring: NDArrayFloat,
    log_range: NDArrayFloat,
) -> NDArrayByte:
    result = np.empty(len(intensity), dtype=np.uint8)
    last = len(log_range) - 1
    for i in range(len(intensity)):
        # Between the middles of the bins; level beyond the first and the last.
        at = min(max(range_m[i] / _RANGE_BIN_M - 0.5, 0.0), float(last))
        low = min(int(at), last - 1)
        share = at - low
        log = log_range[low] * (1.0 - share) + log_range[low + 1] * share
        gain = min(gain_of_ring[ring[i]] / np.exp(log), _MAX_GAIN)
        result[i] = np.uint8(min(max(np.rint(intensity[i] * gain), 0.0), 255.0))
    return result


@dataclass
class IntensityStatistics:
    """Histograms of intensity by ring and range of asphalt-like ground."""

    counts: NDArrayInt = field(
        default_factory=lambda: np.zeros((_NUM_RINGS * _NUM_BINS, 256), np.int64)
    )

    def add(
        self,
        intensity: NDArrayByte,
        ring: NDArrayByte,
        range_m: NDArrayFloat,
        is_asphalt: NDArrayBool,
    ) -> None:
        """Add the returns (N,) of a sweep that lie on ground near the driven path."""
        bins = np.floor(range_m / _RANGE_BIN_M).astype(np.int64)
        use = is_asphalt & (bins < _NUM_BINS)
        flat = (ring[use].astype(np.int64) * _NUM_BINS + bins[use]) * 256 + intensity[use]
        at, number = np.unique(flat, return_counts=True)
        self.counts.reshape(-1)[at] += number

    def found(self) -> tuple[NDArrayInt, NDArrayInt]:
        """What was counted: places in the histograms, and how often each; for `add_found`."""
        at = np.flatnonzero(self.counts)
        return at, self.counts.reshape(-1)[at]

    def add_found(self, at: NDArrayInt, number: NDArrayInt) -> None:
        """Add what others counted."""
        self.counts.reshape(-1)[at] += number

    def response(self) -> IntensityResponse | None:
        """The response that explains them; None when too little ground was seen."""
        number = self.counts.sum(axis=1)
        cells = np.flatnonzero(number >= _FEWEST)
        typical = _midmeans(self.counts[cells])
        cells, typical = cells[typical > 0], typical[typical > 0]
        if len(cells) < 3:
            return None
        ring, bins = np.divmod(cells, _NUM_BINS)
        weight = np.sqrt(number[cells].astype(np.float64))
        rings = np.unique(ring)
        level = float(_midmeans(self.counts.sum(axis=0, keepdims=True))[0])
        # Unknowns: each ring seen, then the response at each range. Every ring meets
        # level ground at one range only, so on a level road the two cannot be told
        # apart: the ridge then gives the smooth part to range and the rest to rings.
        rows = np.zeros((len(cells), len(rings) + _NUM_BINS))
        rows[np.arange(len(cells)), np.searchsorted(rings, ring)] = 1.0
        rows[np.arange(len(cells)), len(rings) + bins] = 1.0
        strength = float(np.median(weight))
        ridge = np.zeros((len(rings), rows.shape[1]))
        ridge[np.arange(len(rings)), np.arange(len(rings))] = _RIDGE * strength
        bend = np.zeros((_NUM_BINS - 2, rows.shape[1]))
        for step, value in enumerate((1.0, -2.0, 1.0)):
            bend[np.arange(_NUM_BINS - 2), len(rings) + step + np.arange(_NUM_BINS - 2)] = value
        # Where no ground was seen the response runs on level.
        tilt = np.zeros((_NUM_BINS - 1, rows.shape[1]))
        for step, value in enumerate((1.0, -1.0)):
            tilt[np.arange(_NUM_BINS - 1), len(rings) + step + np.arange(_NUM_BINS - 1)] = value
        design = np.concatenate(
            [rows * weight[:, None], ridge, bend * _SMOOTH * strength, tilt * _FLAT * strength]
        )
        wanted = np.zeros(len(design))
        wanted[: len(cells)] = np.log(typical) * weight
        solution = np.linalg.lstsq(design, wanted, rcond=None)[0]
        log_ring = np.zeros(_NUM_RINGS)
        log_ring[rings] = solution[: len(rings)]
        mean = float(log_ring[rings].mean())
        log_ring[rings] -= mean
        return IntensityResponse(log_ring, solution[len(rings) :] + mean, level)


def _midmeans(counts: NDArrayInt) -> NDArrayFloat:
    """Mean of the middle half of each histogram (N, 256): paint does not reach into it.

    Unlike a median it tells 2.4 from 2.6, which matters where asphalt returns little.
    """
    total = counts.sum(axis=1, keepdims=True)
    below = np.cumsum(counts, axis=1)
    low, high = total / 4.0, total * 3.0 / 4.0
    inside = np.clip(np.minimum(below, high) - np.maximum(below - counts, low), 0.0, None)
    return np.asarray((inside * np.arange(256)).sum(axis=1) / np.maximum(inside.sum(axis=1), 1e-9))
