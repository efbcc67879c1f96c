"""Compiled shading: what light comes from each hit to the camera, in linear units.

Matte reflection of sun and sky, glossy reflection of the sky, grain and blotches that are
fixed in the world, and the air between.
"""

from __future__ import annotations

from math import exp, floor, sqrt

import numpy as np

from hdmap_tools.simulate.compiled import compiled_fast
from hdmap_tools.simulate.light import Light
from hdmap_tools.simulate.noise_kernels import hash_unit, noise2, noise3
from hdmap_tools.simulate.surface_noise import (
    Places,
    Variation,
    grain,
    places,
    variations,
    vary_ground,
    vary_lawn,
    vary_leaves,
)
from hdmap_tools.simulate.texture_kernels import Footprints, footprints, look_up
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32, NDArrayInt

MATTE, ASPHALT, PAINT, GLASS, LEAVES, LACQUER, PAVING, BRICK, LAWN = range(9)
"""How a material answers to light; `camera_image` says which does how."""

_SKY = 255
_SKY_COLOUR_OF_GROUND = 0.12

_BLOCK_ROWS, _BLOCK_COLS = 8, 64
"""Pixels that are shaded together: what a block sees of the ground's texture stays near the
processor. Row after row of the image, it is fetched anew for most pixels, for four times the
time of all else."""


@compiled_fast
def sky_colour(dx: float, dy: float, dz: float, light: Light) -> tuple[float, float, float]:
    """Brightness of the sky in a unit direction; the far ground below the horizon."""
    up = max(dz, 0.0)
    near_horizon = exp(-4.5 * up)
    red = light.zenith[0] + (light.horizon[0] - light.zenith[0]) * near_horizon
    green = light.zenith[1] + (light.horizon[1] - light.zenith[1]) * near_horizon
    blue = light.zenith[2] + (light.horizon[2] - light.zenith[2]) * near_horizon
    if dz > 0.015:
        # Clouds lie in a layer: the same angle spans more of it near the horizon.
        x, y = dx / (dz + 0.12), dy / (dz + 0.12)
        seed = light.noise_seed
        lumps = (
            0.55 * noise2(1.3 * x, 1.3 * y, seed)
            + 0.27 * noise2(3.1 * x, 3.1 * y, seed + 1)
            + 0.13 * noise2(7.0 * x, 7.0 * y, seed + 2)
            + 0.06 * noise2(15.0 * x, 15.0 * y, seed + 3)
        )
        cover = min(max((lumps + 1.6 * light.cloud - 0.9) * 2.2, 0.0), 1.0)
        cover *= min(up * 14.0, 1.0) * 0.85
        thick = 0.78 + 0.3 * lumps
        red += (light.cloud_rgb[0] * thick - red) * cover
        green += (light.cloud_rgb[1] * thick - green) * cover
        blue += (light.cloud_rgb[2] * thick - blue) * cover
    sx, sy, sz = light.sun_direction
    towards_sun = dx * sx + dy * sy + dz * sz
    if towards_sun > 0.6 and light.sun[0] > 0.2:
        glow = ((towards_sun - 0.6) / 0.4) ** 6
        disk = 12.0 if towards_sun > 0.9998 else 0.0
        red += light.sun[0] * (0.35 * glow + disk)
        green += light.sun[1] * (0.33 * glow + disk)
        blue += light.sun[2] * (0.28 * glow + disk)
    return red, green, blue


@compiled_fast
def _locate(
    pixels: NDArrayInt,
    count: int,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    normal: NDArrayFloat32,
    focal_px: float,
    origin: NDArrayFloat,
    seed: int,
    at: Places,
) -> None:
    """Where the rays of pixels hit, in the city frame, and the side of what they cover."""
    for j in range(count):
        i = pixels[j]
        depth = float(t[i])
        dx, dy, dz = float(rays[i, 3]), float(rays[i, 4]), float(rays[i, 5])
        length = sqrt(dx * dx + dy * dy + dz * dz)
        at.x[j] = rays[i, 0] + depth * dx + origin[0]
        at.y[j] = rays[i, 1] + depth * dy + origin[1]
        at.z[j] = rays[i, 2] + depth * dz + origin[2]
        towards = -(normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz) / length
        across_m = depth / focal_px
        along_m = min(across_m * length / max(towards, 0.02), 40.0 * across_m)
        at.footprint_m[j] = sqrt(across_m * along_m)
        at.seed[j] = seed


@compiled_fast
def _vary(
    pixels: NDArrayInt,
    num_pixels: int,
    material: NDArrayByte,
    answers: NDArrayByte,
    at: Places,
    varied: Variation,
    rows: NDArrayInt,
    some: Places,
    shown: Variation,
) -> None:
    """What varies at pixels, kind by kind; `rows`, `some` and `shown` are room for it."""
    for kind in (ASPHALT, LAWN, LEAVES):
        count = 0
        for j in range(num_pixels):
            code = material[pixels[j]]
            answer = answers[code]
            if answer != kind and not (kind == ASPHALT and answer in (PAINT, PAVING)):
                continue
            if code == _SKY:
                continue
            rows[count] = j
            some.x[count], some.y[count], some.z[count] = at.x[j], at.y[j], at.z[j]
            some.footprint_m[count], some.seed[count] = at.footprint_m[j], at.seed[j]
            if answer == PAVING:
                # Its stones are smooth and whole.
                some.footprint_m[count] = max(at.footprint_m[j], 0.06)
                some.seed[count] += 40
            count += 1
        if count == 0:
            continue
        if kind == ASPHALT:
            vary_ground(count, some, shown)
        elif kind == LAWN:
            vary_lawn(count, some, shown)
        else:
            vary_leaves(count, some, shown)
        for k in range(count):
            j = rows[k]
            varied.value[j], varied.other[j] = shown.value[k], shown.other[k]
            varied.lean_x[j], varied.lean_y[j] = shown.lean_x[k], shown.lean_y[k]
            varied.lean_z[j] = shown.lean_z[k]


@compiled_fast
def _footprints(
    pixels: NDArrayInt,
    num_pixels: int,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    normal: NDArrayFloat32,
    on_ground: NDArrayAny,
    material: NDArrayByte,
    answers: NDArrayByte,
    focal_px: float,
    origin: NDArrayFloat,
    at: Places,
    varied: Variation,
    rows: NDArrayInt,
    ground: Footprints,
) -> int:
    """What pixels see of the ground, which ones into `rows`, and how many they are."""
    count = 0
    for j in range(num_pixels):
        i = pixels[j]
        if not on_ground[i]:
            continue
        rows[count] = j
        dx, dy, dz = float(rays[i, 3]), float(rays[i, 4]), float(rays[i, 5])
        length = sqrt(dx * dx + dy * dy + dz * dz)
        towards = -(normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz) / length
        across_m = float(t[i]) / focal_px
        ground.across_m[count] = across_m
        ground.along_m[count] = across_m * length / max(towards, 0.02)
        flat = sqrt(dx * dx + dy * dy) + 1e-9
        ground.toward_x[count], ground.toward_y[count] = dx / flat, dy / flat
        ground.x[count], ground.y[count] = at.x[j] - origin[0], at.y[j] - origin[1]
        if across_m < 0.015 and answers[material[i]] in (ASPHALT, PAINT, PAVING):
            # Edges of paint are ragged; those of the raster are stairs.
            ground.x[count] += varied.lean_x[j]
            ground.y[count] += varied.lean_y[j]
        count += 1
    return count


@compiled_fast
def shade(
    first: int,
    last: int,
    width: int,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    material: NDArrayByte,
    normal: NDArrayFloat32,
    on_ground: NDArrayAny,
    sunlight: NDArrayFloat32,
    open_sky: NDArrayFloat32,
    origin: NDArrayFloat,
    focal_px: float,
    answers: NDArrayByte,
    texture: NDArrayFloat32,
    codes: NDArrayByte,
    wear: NDArrayByte,
    albedo: NDArrayFloat32,
    cells: NDArrayAny,
    pyramid: NDArrayAny,
    level_shapes: NDArrayInt,
    raster: NDArrayFloat,
    light: Light,
    image: NDArrayFloat32,
) -> None:
    """Light of each ray, written to image (N, 3) float32.

    Takes:
        first, last: Rows of the image to do.
        width: Of the image; its N pixels row by row.
        rays: (N, 6) from the scene's origin; directions of length one along the optical axis.
        t, material, normal, on_ground: Of the hits.
        sunlight: (N,) float32 part of the sun that nothing hides.
        open_sky: (N,) float32 part of the sky's light that reaches the hit.
        origin: (3,) of the scene, city frame: what varies is fixed in the city.
        focal_px: Of the camera.
        answers, texture: By material: how it answers to light, amplitude of its variation.
        codes, wear, albedo, cells, pyramid, level_shapes, raster: The ground's texture.
        light: Light and air.
        image: Written.
    """
    sx, sy, sz = light.sun_direction
    seed = light.noise_seed
    size = _BLOCK_ROWS * _BLOCK_COLS
    at, varied = places(size), variations(size)
    rows, some, shown = np.empty(size, np.int64), places(size), variations(size)
    pixels, seen, colour = np.empty(size, np.int64), np.empty((size, 3)), np.empty((size, 3))
    ground = footprints(size)
    blocks = (width + _BLOCK_COLS - 1) // _BLOCK_COLS
    bands = (last - first + _BLOCK_ROWS - 1) // _BLOCK_ROWS
    for block in range(bands * blocks):
        top = first + block // blocks * _BLOCK_ROWS
        left = block % blocks * _BLOCK_COLS
        count = 0
        for row in range(top, min(top + _BLOCK_ROWS, last)):
            for col in range(left, min(left + _BLOCK_COLS, width)):
                pixels[count] = row * width + col
                count += 1
        _locate(pixels, count, rays, t, normal, focal_px, origin, seed, at)
        _vary(pixels, count, material, answers, at, varied, rows, some, shown)
        on = _footprints(
            pixels,
            count,
            rays,
            t,
            normal,
            on_ground,
            material,
            answers,
            focal_px,
            origin,
            at,
            varied,
            rows,
            ground,
        )
        look_up(on, ground, codes, wear, cells, pyramid, level_shapes, raster, seen)
        for j in range(count):
            code = material[pixels[j]]
            for k in range(3):
                colour[j, k] = albedo[code, k]
        for n in range(on):
            for k in range(3):
                colour[rows[n], k] = seen[n, k]
        for j in range(count):
            i = pixels[j]
            dx, dy, dz = float(rays[i, 3]), float(rays[i, 4]), float(rays[i, 5])
            length = sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx / length, dy / length, dz / length
            if material[i] == _SKY:
                r, g, b = sky_colour(dx, dy, dz, light)
                image[i, 0], image[i, 1], image[i, 2] = r, g, b
                continue
            code = material[i]
            answer = answers[code]
            depth = float(t[i])
            distance = depth * length
            cx, cy, cz = at.x[j], at.y[j], at.z[j]
            nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
            facing = max(-(nx * dx + ny * dy + nz * dz), 0.02)
            across_m = depth / focal_px
            footprint_m = at.footprint_m[j]
            amplitude = float(texture[code])
            red, green, blue = colour[j, 0], colour[j, 1], colour[j, 2]

            gloss = 0.0
            if answer in (ASPHALT, PAINT, PAVING):
                softer = 0.7 if answer == PAVING else 1.0
                factor = max(varied.other[j] * (1.0 + softer * amplitude * varied.value[j]), 0.25)
                gloss = 0.25 * light.wet
                if answer == PAVING:
                    joint = grain(0.35, footprint_m)
                    if joint > 0.0:
                        column, row = floor(cx / 0.5), floor(cy / 0.5)
                        if cx / 0.5 - column < 0.03 or cy / 0.5 - row < 0.03:
                            factor *= 1.0 - 0.3 * joint
                        factor *= 1.0 + 0.08 * joint * (
                            hash_unit(int(column), int(row), seed) - 0.5
                        )
                    gloss = 0.15 * light.wet
            elif answer in (LAWN, LEAVES):
                factor = max(1.0 + amplitude * varied.value[j], 0.15)
                red *= 1.0 + 0.35 * varied.other[j]
                blue *= 1.0 + 0.15 * varied.other[j]
                nx, ny, nz = nx + varied.lean_x[j], ny + varied.lean_y[j], nz + varied.lean_z[j]
                scale = 1.0 / sqrt(nx * nx + ny * ny + nz * nz + 1e-9)
                nx, ny, nz = nx * scale, ny * scale, nz * scale
            elif answer == BRICK:
                across = cx * ny - cy * nx
                factor = 1.0 + amplitude * noise3(cx * 0.6, cy * 0.6, cz * 0.6, seed + 60)
                course = floor(cz / 0.08)
                along = across / 0.25 + 0.5 * (course % 2)
                fine = grain(0.06, across_m)
                if fine > 0.0:
                    factor *= 1.0 + 0.25 * fine * (hash_unit(floor(along), course, seed) - 0.5)
                mortar = grain(0.01, across_m)
                if mortar > 0.0 and (cz / 0.08 - course < 0.13 or along - floor(along) < 0.04):
                    factor *= 1.0 + 0.5 * mortar
            else:
                factor = (
                    1.0
                    + amplitude * noise3(cx * 0.25, cy * 0.25, cz * 0.6, seed + 61)
                    + 0.5 * amplitude * noise3(cx * 1.7, cy * 1.7, cz * 1.7, seed + 62)
                )
            if light.wet > 0.0 and on_ground[i]:
                # Water in the pores keeps light from coming out again.
                puddle = 0.5 + 0.5 * noise2(cx * 0.4, cy * 0.4, seed + 70)
                factor *= 1.0 - light.wet * (0.35 + 0.2 * puddle)
                gloss *= 0.5 + puddle

            n_dot_sun = nx * sx + ny * sy + nz * sz
            if answer == LEAVES:
                # Some of the sun shines through, and leaves face all ways.
                n_dot_sun = max(n_dot_sun, 0.0) * 0.7 + 0.2 * abs(n_dot_sun) + 0.1
            sunlit = max(n_dot_sun, 0.0) * sunlight[i]
            sky = open_sky[i] * (0.5 + 0.5 * nz)
            bounce = _SKY_COLOUR_OF_GROUND * (0.5 - 0.5 * nz) + 0.06
            red *= factor * (
                light.sun[0] * (sunlit + 0.4 * bounce) + light.ambient[0] * (sky + bounce)
            )
            green *= factor * (
                light.sun[1] * (sunlit + 0.4 * bounce) + light.ambient[1] * (sky + bounce)
            )
            blue *= factor * (
                light.sun[2] * (sunlit + 0.4 * bounce) + light.ambient[2] * (sky + bounce)
            )

            if answer in (GLASS, LACQUER) or gloss > 0.0:
                along_normal = 2.0 * (nx * dx + ny * dy + nz * dz)
                mx, my, mz = dx - along_normal * nx, dy - along_normal * ny, dz - along_normal * nz
                fresnel = 0.04 + 0.96 * (1.0 - min(facing, 1.0)) ** 5
                if answer == GLASS:
                    fresnel = min(0.10 + fresnel, 1.0)
                elif answer != LACQUER:
                    fresnel *= gloss
                if mz > 0.0:
                    r, g, b = sky_colour(mx, my, mz, light)
                    # Opposite houses and trees, as far as they hide the low sky.
                    hidden = exp(-6.0 * mz) * 0.75
                    r, g, b = r * (1.0 - hidden), g * (1.0 - hidden), b * (1.0 - hidden)
                else:
                    r = g = b = 0.0
                dark = 0.12
                r += dark * light.ambient[0]
                g += dark * light.ambient[1]
                b += dark * light.ambient[2]
                red += fresnel * (min(r, 6.0) - red)
                green += fresnel * (min(g, 6.0) - green)
                blue += fresnel * (min(b, 6.0) - blue)

            clear = exp(-light.haze_per_m * distance)
            image[i, 0] = red * clear + light.haze[0] * (1.0 - clear)
            image[i, 1] = green * clear + light.haze[1] * (1.0 - clear)
            image[i, 2] = blue * clear + light.haze[2] * (1.0 - clear)
