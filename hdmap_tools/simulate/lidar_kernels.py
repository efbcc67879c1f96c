"""Compiled parts of the lidar: rays of a turn, and what the receiver makes of each hit."""

from __future__ import annotations

from math import cos, exp, log, pi, sin, sqrt

import numpy as np

from hdmap_tools.simulate.compiled import compiled
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32, NDArrayInt

_SKY = 255


@compiled
def turn_rays(
    first: int,
    last: int,
    elevations_rad: NDArrayFloat,
    rotations: NDArrayFloat,
    origins: NDArrayFloat,
    rays: NDArrayFloat32,
) -> None:
    """Unit rays of the azimuths first to last; all lasers fire at once.

    The lidar turns clockwise, as Velodyne's do, and begins behind the vehicle.

    Takes:
        first, last: Azimuths to do.
        elevations_rad: (R,).
        rotations, origins: (A, 3, 3) and (A, 3) of the lidar at each azimuth's time.
        rays: (A * R, 6) written.
    """
    num_azimuths, num_rings = len(origins), len(elevations_rad)
    level, up = np.cos(elevations_rad), np.sin(elevations_rad)
    for a in range(first, last):
        azimuth = pi - 2.0 * pi * a / num_azimuths
        ahead, left = cos(azimuth), sin(azimuth)
        turn = rotations[a]
        for r in range(num_rings):
            x, y, z = level[r] * ahead, level[r] * left, up[r]
            i = a * num_rings + r
            for k in range(3):
                rays[i, k] = origins[a, k]
                rays[i, 3 + k] = turn[k, 0] * x + turn[k, 1] * y + turn[k, 2] * z


@compiled
def receive(
    first: int,
    last: int,
    num_rings: int,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    normal: NDArrayFloat32,
    material: NDArrayByte,
    wear: NDArrayByte,
    reflectivity: NDArrayFloat32,
    is_retro: NDArrayAny,
    is_glass: NDArrayAny,
    is_paint: NDArrayAny,
    asphalt: float,
    ring_gains: NDArrayFloat,
    limits: NDArrayFloat,
    range_sigma_m: float,
    haze_per_m: float,
    wet: float,
    loss: float,
    random: NDArrayFloat32,
    range_m: NDArrayFloat32,
    intensity: NDArrayByte,
) -> None:
    """Range and intensity of each return; a range of NaN where there is none.

    Takes:
        first, last: Rays to do.
        num_rings: Lasers; ray i is of laser ``i % num_rings``.
        rays, t, normal, material, wear: Of the cast.
        reflectivity, is_retro, is_glass, is_paint: By material.
        asphalt: Reflectivity under worn paint.
        ring_gains: (R,).
        limits: Nearest range, and the range at which a surface of reflectivity 0.8 is
            still seen, metres.
        range_sigma_m, haze_per_m, wet: Of the sensor and the weather.
        loss: Part of the returns lost for no reason.
        random: (3, N): two standard normals, one uniform; zeros for a perfect sensor.
        range_m, intensity: Written.
    """
    for i in range(first, last):
        range_m[i] = np.nan
        intensity[i] = 0
        mat = material[i]
        r = float(t[i])
        if mat == _SKY or r < limits[0]:
            continue
        facing = -(
            normal[i, 0] * rays[i, 3] + normal[i, 1] * rays[i, 4] + normal[i, 2] * rays[i, 5]
        )
        facing = min(max(float(facing), 0.01), 1.0)
        rho = float(reflectivity[mat])
        retro = 1.0 if is_retro[mat] else 0.0
        if is_paint[mat]:
            # Where the paint has gone, so have its glass beads.
            left = wear[i] * (1.0 / 255.0)
            rho = left * rho + (1.0 - left) * asphalt
            retro *= left
        # Water fills the pores and the beads and turns rough ground into a mirror.
        rho *= 1.0 - 0.45 * wet
        retro *= 1.0 - 0.6 * wet
        air = exp(-2.0 * haze_per_m * r)
        # Of the light that comes back, against the least that is noticed.
        slant = log(facing)
        signal = rho / 0.8 * exp(slant * (0.4 + 0.4 * wet) * (1.0 - 0.6 * retro))
        signal *= 2.0 * (limits[1] / r) ** 2 * air
        signal *= signal
        signal *= signal
        kept = signal / (1.0 + signal) * (1.0 - loss)
        if is_glass[mat]:
            kept *= 0.4
        if random[2, i] > kept or r > 1.5 * limits[1]:
            continue
        range_m[i] = r + range_sigma_m * random[0, i]
        # Near the lens the spot is out of focus; far away the receiver's gain gives out.
        response = 1.12 * (1.0 - exp(-r / 4.0)) / (1.0 + (r / 70.0) ** 2)
        shown = 234.0 * rho * exp(slant * 0.3 * (1.0 - 0.5 * retro)) * response * sqrt(air)
        shown *= ring_gains[i % num_rings]
        shown *= 1.0 + 0.08 * random[1, i]
        intensity[i] = int(min(max(shown + 0.5, 0.0), 255.0))


@compiled
def collect(
    kept: NDArrayInt,
    num_rings: int,
    rays: NDArrayFloat32,
    range_m: NDArrayFloat32,
    rotation: NDArrayFloat,
    place: NDArrayFloat,
    intensity: NDArrayByte,
    material: NDArrayByte,
    azimuth_ns: NDArrayInt,
    points: NDArrayFloat32,
    received: NDArrayByte,
    materials: NDArrayByte,
    rings: NDArrayByte,
    offset_ns: NDArrayAny,
) -> None:
    """What the kept rays tell, one after the other.

    Takes:
        kept: (K,) rays with a return.
        num_rings: Lasers; ray i is of laser ``i % num_rings``.
        rays, range_m, intensity, material: By ray.
        rotation, place: (3, 3) and (3,) of the ego frame, from the scene's origin.
        azimuth_ns: (A,) time of each azimuth.
        points: (K, 3) written, ego frame.
        received, materials, rings, offset_ns: (K,) written.
    """
    for j in range(len(kept)):
        i = kept[j]
        x = rays[i, 0] + range_m[i] * rays[i, 3] - place[0]
        y = rays[i, 1] + range_m[i] * rays[i, 4] - place[1]
        z = rays[i, 2] + range_m[i] * rays[i, 5] - place[2]
        for k in range(3):
            points[j, k] = x * rotation[0, k] + y * rotation[1, k] + z * rotation[2, k]
        azimuth = i // num_rings
        received[j], materials[j] = intensity[i], material[i]
        rings[j], offset_ns[j] = i - azimuth * num_rings, azimuth_ns[azimuth]
