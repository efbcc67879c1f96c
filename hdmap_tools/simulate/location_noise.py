"""Randomness that follows from a seed and a place, whatever was asked for before."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit

from hdmap_tools.types import NDArrayFloat


class Purpose(IntEnum):
    """Keeps the random numbers of different things at one place apart."""

    WEAR = 1
    GROUND_COVER = 2
    SIDEWALK = 3
    PATCH = 4
    MANHOLE = 5
    LOT = 6
    TREE = 7
    PARKED = 8
    LAMP = 9
    SIGN = 10
    SYMBOL = 11
    TERRAIN = 12
    TRAFFIC = 13
    PEOPLE = 14
    HEDGE = 15


def rng_at(seed: int, purpose: Purpose, *place: int) -> np.random.Generator:
    """A generator of its own for one place, given in whole numbers."""
    return np.random.default_rng([seed, int(purpose), *(p & 0xFFFFFFFF for p in place)])


def value_noise(
    xy: NDArrayFloat, scale_m: float, seed: int, purpose: Purpose, octave: int = 0
) -> NDArrayFloat:
    """Smooth noise (N,) of 0..1 at city points (N, 2), of features about scale_m wide."""
    mixed = (seed * 1_000_003 + int(purpose) * 7919 + octave * 104_729) & 0x7FFFFFFFFFFFFFFF
    xy = np.ascontiguousarray(xy, dtype=np.float64)
    noise: NDArrayFloat = _value_noise(xy, 1.0 / scale_m, np.uint64(mixed))
    return noise


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def _lattice(ix: int, iy: int, seed: np.uint64) -> float:
    """0..1 of a lattice node (the finalizer of splitmix64 over seed and position)."""
    h = seed ^ (np.uint64(ix) * np.uint64(0x9E3779B97F4A7C15))
    h ^= np.uint64(iy) * np.uint64(0xC2B2AE3D27D4EB4F)
    for _ in range(2):
        h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        h = h ^ (h >> np.uint64(31))
    return float(h >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True)  # type: ignore[untyped-decorator,unused-ignore]
def _value_noise(xy: NDArrayFloat, frequency: float, seed: np.uint64) -> NDArrayFloat:
    result = np.empty(len(xy))
    for i in range(len(xy)):
        x, y = xy[i, 0] * frequency, xy[i, 1] * frequency
        ix, iy = int(np.floor(x)), int(np.floor(y))
        u, v = x - ix, y - iy
        u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
        south = _lattice(ix, iy, seed) * (1.0 - u) + _lattice(ix + 1, iy, seed) * u
        north = _lattice(ix, iy + 1, seed) * (1.0 - u) + _lattice(ix + 1, iy + 1, seed) * u
        result[i] = south * (1.0 - v) + north * v
    return result
