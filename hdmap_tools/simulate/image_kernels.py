"""Compiled part of the image's formation."""

from __future__ import annotations

from math import sqrt

from hdmap_tools.simulate.compiled import compiled_fast
from hdmap_tools.types import NDArrayByte, NDArrayFloat, NDArrayFloat32


@compiled_fast
def finish(
    first: int,
    last: int,
    width: int,
    image: NDArrayFloat32,
    falloff: NDArrayFloat32,
    gains: NDArrayFloat,
    shot: float,
    read: float,
    seed: int,
    curve: NDArrayByte,
    result: NDArrayByte,
) -> None:
    """Exposure, vignetting, noise of photons and electronics, and the tone curve, to uint8.

    Takes:
        first, last: Pixels to do.
        width: Of the image.
        image: (N, 3) light on the sensor.
        falloff: (N,) light lost to the lens and to dirt on it.
        gains: (3,) exposure times white balance.
        shot, read: Noise of one sigma at full well and in the dark, 1 is full well.
        seed: Of this image's noise.
        curve: (4096,) uint8: the tone curve over the square root of 0..4 full wells.
        result: (N, 3) written.
    """
    for i in range(first, last):
        for c in range(3):
            value = image[i, c] * falloff[i] * gains[c]
            # Two uniforms and their sum: near enough to normal, four times as fast.
            h = (i * 3 + c) * 668265263 + seed * 374761393
            h = ((h ^ (h >> 13)) & 0xFFFFFFFF) * 1274126177
            h = (h ^ (h >> 16)) & 0xFFFFFFFFFFFF
            noise = ((h & 0xFFFF) + ((h >> 16) & 0xFFFF) + ((h >> 32) & 0xFFFF)) / 65536.0 - 1.5
            value += 2.0 * noise * sqrt(read * read + shot * shot * max(value, 0.0))
            at = int(sqrt(max(value, 0.0)) * 2047.5)
            result[i, c] = curve[min(at, 4095)]
