"""Value noise of city coordinates: the same place has the same grain from wherever it is seen."""

from __future__ import annotations

from math import floor

from hdmap_tools.simulate.compiled import compiled_fast


@compiled_fast
def hash_unit(x: int, y: int, z: int) -> float:
    """A number in 0..1 that follows from three integers and looks random."""
    h = (x * 374761393 + y * 668265263 + z * 2147483647) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 1103515245) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


@compiled_fast
def noise2(x: float, y: float, seed: int) -> float:
    """Smooth noise of the plane in -1..1, its lattice at whole numbers."""
    fx, fy = floor(x), floor(y)
    u, v = x - fx, y - fy
    ix, iy = int(fx), int(fy)
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    a = hash_unit(ix, iy, seed)
    b = hash_unit(ix + 1, iy, seed)
    c = hash_unit(ix, iy + 1, seed)
    d = hash_unit(ix + 1, iy + 1, seed)
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
