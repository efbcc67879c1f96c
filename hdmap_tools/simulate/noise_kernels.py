"""Value noise of city coordinates: the same place has the same grain from wherever it is seen.

All hashes are counted in 32 bits, which wrap: eight of them fit a vector register, so that
the corners of a lattice cell are hashed at once.
"""

from __future__ import annotations

from math import floor
from typing import Any

import numpy as np

from hdmap_tools.simulate.compiled import compiled_fast

_X, _Y, _Z = np.uint32(374761393), np.uint32(668265263), np.uint32(2147483647)
_FIRST, _SECOND = np.uint32(1274126177), np.uint32(1103515245)
_13, _15, _16 = np.uint32(13), np.uint32(15), np.uint32(16)
_24_BITS = np.uint32(0xFFFFFF)


@compiled_fast
def _unit(h: Any) -> float:
    """A number in 0..1 that follows from 32 bits and looks random."""
    h = np.uint32(np.uint32(h ^ (h >> _13)) * _FIRST)
    h = np.uint32(np.uint32(h ^ (h >> _15)) * _SECOND)
    # By way of a signed number, for which processors have an instruction.
    return float(np.int32((h ^ (h >> _16)) & _24_BITS)) * (1.0 / 16777216.0)


@compiled_fast
def hash_unit(x: int, y: int, z: int) -> float:
    """A number in 0..1 that follows from three integers and looks random."""
    return _unit(np.uint32(np.uint32(x) * _X + np.uint32(y) * _Y + np.uint32(z) * _Z))


@compiled_fast
def noise2(x: float, y: float, seed: int) -> float:
    """Smooth noise of the plane in -1..1, its lattice at whole numbers."""
    fx, fy = floor(x), floor(y)
    u, v = x - fx, y - fy
    corner = np.uint32(
        np.uint32(np.int64(fx)) * _X + np.uint32(np.int64(fy)) * _Y + np.uint32(seed) * _Z
    )
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    a = _unit(corner)
    b = _unit(np.uint32(corner + _X))
    c = _unit(np.uint32(corner + _Y))
    d = _unit(np.uint32(np.uint32(corner + _X) + _Y))
    return 2.0 * ((a + (b - a) * u) * (1.0 - v) + (c + (d - c) * u) * v) - 1.0


@compiled_fast
def noise3(x: float, y: float, z: float, seed: int) -> float:
    """Smooth noise of space in -1..1."""
    fz = floor(z)
    w = z - fz
    iz = int(fz)
    w = w * w * (3.0 - 2.0 * w)
    below = noise2(x, y, seed + 7919 * iz)
    above = noise2(x, y, seed + 7919 * (iz + 1))
    return below + (above - below) * w
