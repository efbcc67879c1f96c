"""Compiled parts of shadows: rays from what is seen to the sun and the sky, and what they tell."""

from __future__ import annotations

from math import cos, sin, sqrt

from hdmap_tools.simulate.compiled import compiled_fast
from hdmap_tools.simulate.light import Light
from hdmap_tools.simulate.noise_kernels import hash_unit
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat32


@compiled_fast
def sun_rays(
    first: int,
    last: int,
    rows: NDArrayAny,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    normal: NDArrayFloat32,
    light: Light,
    result: NDArrayFloat32,
) -> None:
    """Rays from hits towards a point of the sun's disk each, which blurs the shadows' edges."""
    for j in range(first, last):
        i = rows[j]
        # Off the surface by more than float32 loses along a long ray.
        lift = 0.01 + 1e-4 * t[i]
        for k in range(3):
            result[j, k] = rays[i, k] + t[i] * rays[i, 3 + k] + lift * normal[i, k]
            result[j, 3 + k] = light.sun_direction[k] + light.sun_blur * (
                2.0 * hash_unit(i, k, light.noise_seed) - 1.0
            )


@compiled_fast
def sky_rays(
    first: int,
    last: int,
    rows: NDArrayAny,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    normal: NDArrayFloat32,
    seed: int,
    result: NDArrayFloat32,
) -> None:
    """A ray each from hits to some place of the sky before them, more often where it counts more."""
    for j in range(first, last):
        i = rows[j]
        lift = 0.01 + 1e-4 * t[i]
        # A point of the ball that touches the surface: cosine-weighted directions.
        up = 2.0 * hash_unit(i, 0, seed) - 1.0
        around = 6.2831853 * hash_unit(i, 1, seed)
        wide = sqrt(max(1.0 - up * up, 0.0))
        ball = (wide * cos(around), wide * sin(around), up)
        for k in range(3):
            result[j, k] = rays[i, k] + t[i] * rays[i, 3 + k] + lift * normal[i, k]
            result[j, 3 + k] = 1.02 * normal[i, k] + ball[k]


@compiled_fast
def spread_sunlight(
    first: int,
    last: int,
    traced: NDArrayByte,
    on_ground: NDArrayAny,
    t: NDArrayFloat32,
    normal: NDArrayFloat32,
    sunlight: NDArrayFloat32,
) -> None:
    """Sunlight 0..1 of all pixels from those of every fourth one that were asked.

    The mean over the neighbours, of two by two at most, that lie on the same surface: a fourth
    of the rays, and edges of shadows as soft as two pixels.

    Takes:
        first, last: Image rows to do.
        traced: (h, w) uint8: 0 in shadow, 1 in the sun, 2 not asked.
        on_ground, t, normal: (h, w) and (h, w, 3) of the hits.
        sunlight: (h, w) written.
    """
    height, width = traced.shape
    for row in range(first, last):
        for col in range(width):
            total = 0.0
            count = 0
            # Asked were those of even rows and columns.
            for i in range(row - row % 2, min(row + 2, height), 2):
                for j in range(col - col % 2, min(col + 2, width), 2):
                    if traced[i, j] == 2 or on_ground[i, j] != on_ground[row, col]:
                        continue
                    if not on_ground[row, col]:
                        alike = (
                            normal[i, j, 0] * normal[row, col, 0]
                            + normal[i, j, 1] * normal[row, col, 1]
                            + normal[i, j, 2] * normal[row, col, 2]
                        )
                        if alike < 0.5 or abs(t[i, j] - t[row, col]) > 0.05 * t[row, col]:
                            continue
                    total += traced[i, j]
                    count += 1
            sunlight[row, col] = total / count if count > 0 else 1.0
