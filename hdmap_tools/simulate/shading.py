"""Compiled shading: what light comes from each hit to the camera, in linear units.

Matte reflection of sun and sky, glossy reflection of the sky, grain and blotches that are
fixed in the world, and the air between.
"""

from __future__ import annotations

from math import cos, exp, floor, log2, sin, sqrt

from hdmap_tools.simulate.compiled import compiled_fast, compiled_inline
from hdmap_tools.simulate.light import Light
from hdmap_tools.simulate.noise_kernels import hash_unit, noise2, noise3
from hdmap_tools.simulate.texture_kernels import sample_texture
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32, NDArrayInt

MATTE, ASPHALT, PAINT, GLASS, LEAVES, LACQUER, PAVING, BRICK, LAWN = range(9)
"""How a material answers to light; `camera_image` says which does how."""

_SKY = 255
_MOST_TAPS = 6
_SKY_COLOUR_OF_GROUND = 0.12


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

    The mean over the neighbours, of three by three, that lie on the same surface: a fourth
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
            for i in range(max(row - 1, 0), min(row + 2, height)):
                for j in range(max(col - 1, 0), min(col + 2, width)):
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


@compiled_inline
def _ground_albedo(
    x: float,
    y: float,
    toward_x: float,
    toward_y: float,
    across_m: float,
    along_m: float,
    codes: NDArrayByte,
    wear: NDArrayByte,
    cells: NDArrayFloat32,
    pyramid: NDArrayByte,
    level_shapes: NDArrayInt,
    raster: NDArrayFloat,
) -> tuple[float, float, float]:
    """Mean albedo over a pixel's footprint: taps along its long axis, each as wide as its short one."""
    fine = max(across_m, along_m / _MOST_TAPS)
    level = 0
    if fine > raster[0]:
        level = int(log2(fine / raster[0]) + 0.5)
        level = min(max(level, 0), len(level_shapes))
    cell = raster[0] * (1 << level)
    taps = min(max(int(along_m / max(fine, cell) + 0.5), 1), _MOST_TAPS)
    red = green = blue = 0.0
    for k in range(taps):
        offset = ((k + 0.5) / taps - 0.5) * along_m
        r, g, b = sample_texture(
            codes,
            wear,
            cells,
            pyramid,
            level_shapes,
            raster,
            level,
            x + offset * toward_x,
            y + offset * toward_y,
        )
        red += r
        green += g
        blue += b
    return red / taps, green / taps, blue / taps


@compiled_fast
def _grain(wavelength_m: float, footprint_m: float) -> float:
    """How much of a variation is left when a pixel averages over its footprint, 0..1."""
    return min(max(1.4 - 0.9 * footprint_m / wavelength_m, 0.0), 1.0)


@compiled_fast
def _ground_variation(x: float, y: float, footprint_m: float, amplitude: float, seed: int) -> float:
    """Factor on the albedo of asphalt, paving and paint: grain, blotches, a few cracks."""
    value = 0.0
    weight = _grain(0.02, footprint_m)
    if weight > 0.0:
        value += weight * 1.1 * noise2(x * 80.0, y * 80.0, seed)
    weight = _grain(0.09, footprint_m)
    if weight > 0.0:
        value += weight * 0.45 * noise2(x * 14.0, y * 14.0, seed + 11)
    weight = _grain(0.5, footprint_m)
    if weight > 0.0:
        value += weight * 0.35 * noise2(x * 2.3, y * 2.3, seed + 12)
    value += 0.75 * noise2(x * 0.31, y * 0.37, seed + 13)
    value += 0.75 * noise2(x * 0.06, y * 0.07, seed + 14)
    factor = 1.0 + amplitude * value
    # Few places have cracks: those are found first, it costs least.
    if footprint_m < 0.06 and noise2(x * 0.11, y * 0.11, seed + 17) > 0.25:
        bend = noise2(x * 1.7, y * 1.7, seed + 15)
        crack = abs(noise2(x * 0.45 + 0.3 * bend, y * 0.45 - 0.3 * bend, seed + 16))
        if crack < 0.006:
            factor *= 0.6 + 0.4 * min(footprint_m / 0.06, 1.0)
    return max(factor, 0.25)


@compiled_fast
def shade(
    first: int,
    last: int,
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
    cells: NDArrayFloat32,
    pyramid: NDArrayByte,
    level_shapes: NDArrayInt,
    raster: NDArrayFloat,
    light: Light,
    image: NDArrayFloat32,
) -> None:
    """Light of each ray, written to image (N, 3) float32.

    Takes:
        first, last: Rows to do.
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
    for i in range(first, last):
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
        x = rays[i, 0] + distance * dx
        y = rays[i, 1] + distance * dy
        z = rays[i, 2] + distance * dz
        cx, cy, cz = x + origin[0], y + origin[1], z + origin[2]
        nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        facing = max(-(nx * dx + ny * dy + nz * dz), 0.02)
        across_m = depth / focal_px
        along_m = across_m * length / facing
        footprint_m = sqrt(across_m * min(along_m, 40.0 * across_m))
        amplitude = float(texture[code])
        if on_ground[i]:
            flat = sqrt(dx * dx + dy * dy) + 1e-9
            if across_m < 0.015:
                # Edges of paint are ragged; those of the raster are stairs.
                x += 0.006 * noise2(cx * 30.0, cy * 30.0, seed + 30)
                y += 0.006 * noise2(cx * 30.0, cy * 30.0, seed + 31)
            red, green, blue = _ground_albedo(
                x,
                y,
                dx / flat,
                dy / flat,
                across_m,
                along_m,
                codes,
                wear,
                cells,
                pyramid,
                level_shapes,
                raster,
            )
        else:
            red, green, blue = (
                float(albedo[code, 0]),
                float(albedo[code, 1]),
                float(albedo[code, 2]),
            )

        gloss = 0.0
        if answer in (ASPHALT, PAINT):
            factor = _ground_variation(cx, cy, footprint_m, amplitude, seed)
            gloss = 0.25 * light.wet
        elif answer == PAVING:
            factor = _ground_variation(cx, cy, max(footprint_m, 0.06), 0.7 * amplitude, seed + 40)
            joint = _grain(0.35, footprint_m)
            if joint > 0.0:
                column, row = floor(cx / 0.5), floor(cy / 0.5)
                if cx / 0.5 - column < 0.03 or cy / 0.5 - row < 0.03:
                    factor *= 1.0 - 0.3 * joint
                factor *= 1.0 + 0.08 * joint * (hash_unit(int(column), int(row), seed) - 0.5)
            gloss = 0.15 * light.wet
        elif answer == LAWN:
            # Tufts; a lawn is flat, so noise of the plane does, at half the price.
            value = 0.6 * noise2(cx * 0.9, cy * 0.9, seed + 50)
            scale = 3.5
            for octave in range(3):
                weight = _grain(1.0 / scale, footprint_m)
                if weight > 0.0:
                    value += weight * 0.8 * noise2(cx * scale, cy * scale, seed + 51 + octave)
                scale *= 3.1
            factor = max(1.0 + amplitude * value, 0.15)
            tint = noise2(cx * 0.15, cy * 0.15, seed + 55)
            red *= 1.0 + 0.35 * tint
            blue *= 1.0 + 0.15 * tint
            nx += 0.2 * noise2(cx * 5.0, cy * 5.0, seed + 56)
            ny += 0.2 * noise2(cx * 5.0, cy * 5.0, seed + 57)
            scale = 1.0 / sqrt(nx * nx + ny * ny + nz * nz + 1e-9)
            nx, ny, nz = nx * scale, ny * scale, nz * scale
        elif answer == LEAVES:
            # Clumps with their own slope towards the light, and dark gaps.
            value = 0.6 * noise3(cx * 0.9, cy * 0.9, cz * 0.9, seed + 50)
            scale = 3.5
            for octave in range(3):
                weight = _grain(1.0 / scale, footprint_m)
                if weight > 0.0:
                    value += (
                        weight
                        * 0.8
                        * noise3(cx * scale, cy * scale, cz * scale, seed + 51 + octave)
                    )
                scale *= 3.1
            factor = max(1.0 + 1.5 * amplitude * value, 0.15)
            tint = noise2(cx * 0.15, cy * 0.15, seed + 55)
            red *= 1.0 + 0.35 * tint
            blue *= 1.0 + 0.15 * tint
            nx += 0.9 * noise3(cx * 5.0, cy * 5.0, cz * 5.0, seed + 56)
            ny += 0.9 * noise3(cx * 5.0, cy * 5.0, cz * 5.0, seed + 57)
            nz += 0.9 * noise3(cx * 5.0, cy * 5.0, cz * 5.0, seed + 58)
            scale = 1.0 / sqrt(nx * nx + ny * ny + nz * nz + 1e-9)
            nx, ny, nz = nx * scale, ny * scale, nz * scale
        elif answer == BRICK:
            across = cx * ny - cy * nx
            factor = 1.0 + amplitude * noise3(cx * 0.6, cy * 0.6, cz * 0.6, seed + 60)
            course = floor(cz / 0.08)
            along = across / 0.25 + 0.5 * (course % 2)
            fine = _grain(0.06, across_m)
            if fine > 0.0:
                factor *= 1.0 + 0.25 * fine * (hash_unit(floor(along), course, seed) - 0.5)
            mortar = _grain(0.01, across_m)
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
        red *= factor * (light.sun[0] * (sunlit + 0.4 * bounce) + light.ambient[0] * (sky + bounce))
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
