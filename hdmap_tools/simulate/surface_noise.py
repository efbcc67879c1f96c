"""Noise of the surfaces that need much of it: roads, lawns, leaves, for many pixels at a time.

Noise asked for pixel by pixel costs twenty times what it costs in a loop that does nothing
else, which the compiler turns into vector instructions: so the pixels of a kind are gathered
first, and what they show is written back to where they were.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hdmap_tools.simulate.compiled import compiled_fast
from hdmap_tools.simulate.noise_kernels import noise2, noise3
from hdmap_tools.types import NDArrayFloat, NDArrayInt


class Places(NamedTuple):
    """Points of surfaces, arrays (N,).

    Attributes:
        x, y, z: Metres in the city frame.
        footprint_m: What a pixel averages over there.
        seed: Of the noise.
    """

    x: NDArrayFloat
    y: NDArrayFloat
    z: NDArrayFloat
    footprint_m: NDArrayFloat
    seed: NDArrayInt


class Variation(NamedTuple):
    """What varies there, arrays (N,).

    Attributes:
        value: Light and dark: the albedo is 1 + amplitude * value of its mean.
        other: Of the ground the factor of its cracks, of plants the tint, -1..1.
        lean_x, lean_y, lean_z: What the normal leans by; of the ground, x and y are
            how far the edges of its paint are moved, metres.
    """

    value: NDArrayFloat
    other: NDArrayFloat
    lean_x: NDArrayFloat
    lean_y: NDArrayFloat
    lean_z: NDArrayFloat


@compiled_fast
def places(count: int) -> Places:
    """Room for some places."""
    return Places(
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count, np.int64),
    )


@compiled_fast
def variations(count: int) -> Variation:
    """Room for what varies there."""
    return Variation(
        np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    )


@compiled_fast
def grain(wavelength_m: float, footprint_m: float) -> float:
    """How much of a variation is left when a pixel averages over its footprint, 0..1."""
    return min(max(1.4 - 0.9 * footprint_m / wavelength_m, 0.0), 1.0)


@compiled_fast
def vary_ground(count: int, at: Places, varied: Variation) -> None:
    """Asphalt, paving and paint: grain, blotches, a few cracks; ragged edges of paint."""
    for i in range(count):
        x, y, size, seed = at.x[i], at.y[i], at.footprint_m[i], at.seed[i]
        varied.value[i] = (
            1.1 * grain(0.02, size) * noise2(x * 80.0, y * 80.0, seed)
            + 0.45 * grain(0.09, size) * noise2(x * 14.0, y * 14.0, seed + 11)
            + 0.35 * grain(0.5, size) * noise2(x * 2.3, y * 2.3, seed + 12)
            + 0.75 * noise2(x * 0.31, y * 0.37, seed + 13)
            + 0.75 * noise2(x * 0.06, y * 0.07, seed + 14)
        )
    for i in range(count):
        x, y, size, seed = at.x[i], at.y[i], at.footprint_m[i], at.seed[i]
        has_cracks = noise2(x * 0.11, y * 0.11, seed + 17)
        bend = 0.3 * noise2(x * 1.7, y * 1.7, seed + 15)
        off_crack = abs(noise2(x * 0.45 + bend, y * 0.45 - bend, seed + 16))
        is_crack = (has_cracks > 0.25) & (off_crack < 0.006) & (size < 0.06)
        varied.other[i] = 0.6 + 0.4 * min(size / 0.06, 1.0) if is_crack else 1.0
    for i in range(count):
        x, y, seed = 30.0 * at.x[i], 30.0 * at.y[i], at.seed[i]
        varied.lean_x[i] = 0.006 * noise2(x, y, seed + 30)
        varied.lean_y[i] = 0.006 * noise2(x, y, seed + 31)


@compiled_fast
def vary_lawn(count: int, at: Places, varied: Variation) -> None:
    """Tufts; a lawn is flat, so noise of the plane does."""
    for i in range(count):
        x, y, size, seed = at.x[i], at.y[i], at.footprint_m[i], at.seed[i]
        value = 0.6 * noise2(x * 0.9, y * 0.9, seed + 50)
        scale = 3.5
        for octave in range(3):
            weight = 0.8 * grain(1.0 / scale, size)
            value += weight * noise2(x * scale, y * scale, seed + 51 + octave)
            scale *= 3.1
        varied.value[i] = value
        varied.other[i] = noise2(x * 0.15, y * 0.15, seed + 55)
        varied.lean_x[i] = 0.2 * noise2(x * 5.0, y * 5.0, seed + 56)
        varied.lean_y[i] = 0.2 * noise2(x * 5.0, y * 5.0, seed + 57)
        varied.lean_z[i] = 0.0


@compiled_fast
def vary_leaves(count: int, at: Places, varied: Variation) -> None:
    """Clumps with their own slope towards the light, and dark gaps."""
    for i in range(count):
        x, y, z, size, seed = at.x[i], at.y[i], at.z[i], at.footprint_m[i], at.seed[i]
        value = 0.6 * noise3(x * 0.9, y * 0.9, z * 0.9, seed + 50)
        scale = 3.5
        for octave in range(3):
            weight = 0.8 * grain(1.0 / scale, size)
            value += weight * noise3(x * scale, y * scale, z * scale, seed + 51 + octave)
            scale *= 3.1
        varied.value[i] = 1.5 * value
        varied.other[i] = noise2(x * 0.15, y * 0.15, seed + 55)
    for i in range(count):
        x, y, z, seed = 5.0 * at.x[i], 5.0 * at.y[i], 5.0 * at.z[i], at.seed[i]
        varied.lean_x[i] = 0.9 * noise3(x, y, z, seed + 56)
        varied.lean_y[i] = 0.9 * noise3(x, y, z, seed + 57)
        varied.lean_z[i] = 0.9 * noise3(x, y, z, seed + 58)
