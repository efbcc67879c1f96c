"""What happens to each ray around the caster: made, sorted out, and its hit given a material."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from hdmap_tools.simulate.compiled import compiled
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32

_BUNDLE = 32
"""Rays that are looked at as one."""

_GROUND = 0
_GRASS = 13
_SKY = 255


@compiled
def pixel_rays(
    first: int,
    last: int,
    width: int,
    intrinsics: NDArrayFloat,
    rotation: NDArrayFloat,
    origin: NDArrayFloat,
    rays: NDArrayFloat32,
) -> None:
    """Rays through the pixel centres; directions have length one along the optical axis."""
    fx, fy, cx, cy = intrinsics
    for i in range(first, last):
        x = (i % width - cx) / fx
        y = (i // width - cy) / fy
        for k in range(3):
            rays[i, k] = origin[k]
            rays[i, 3 + k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2]


@compiled
def turn_normals(first: int, last: int, rays: NDArrayFloat32, normal: NDArrayFloat32) -> None:
    """Turn normals (N, 3) towards where the rays come from."""
    for i in range(first, last):
        if normal[i, 0] * rays[i, 3] + normal[i, 1] * rays[i, 4] + normal[i, 2] * rays[i, 5] > 0.0:
            for k in range(3):
                normal[i, k] = -normal[i, k]


@compiled
def resolve_materials(
    first: int,
    last: int,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    triangle: NDArrayAny,
    triangle_materials: NDArrayByte,
    codes: NDArrayByte,
    wear: NDArrayByte,
    raster: NDArrayFloat,
    material: NDArrayByte,
    paint_left: NDArrayByte,
    on_ground: NDArrayAny,
) -> None:
    """Materials of hits; those of the ground from the surface raster.

    Takes:
        first, last: Rows to do.
        rays, t, triangle: Of the cast; no hit where t is infinite.
        triangle_materials: (T,) of the mesh.
        codes, wear: The surface raster.
        raster: (resolution, x of the first cell's edge, y of it), metres from the scene's
            origin, float64.
        material, paint_left, on_ground: Written.
    """
    rows, cols = codes.shape
    per_cell = 1.0 / raster[0]
    for i in range(first, last):
        on_ground[i] = False
        paint_left[i] = 255
        if not t[i] < np.inf:
            material[i] = _SKY
            continue
        code = triangle_materials[triangle[i]]
        if code == _GROUND:
            on_ground[i] = True
            depth = np.float64(t[i])
            col = floor((rays[i, 0] + depth * rays[i, 3] - raster[1]) * per_cell)
            row = floor((rays[i, 1] + depth * rays[i, 4] - raster[2]) * per_cell)
            if 0 <= col < cols and 0 <= row < rows:
                code = codes[row, col]
                paint_left[i] = wear[row, col]
                if code == _GROUND:
                    code = _GRASS
            else:
                code = _GRASS
        material[i] = code


@compiled
def near_spheres(
    first: int,
    last: int,
    rays: NDArrayFloat32,
    t: NDArrayFloat32,
    spheres: NDArrayFloat32,
    is_near: NDArrayAny,
) -> None:
    """Which rays pass through a sphere before they hit; spheres (K, 4) are centre and radius.

    Neighbouring rays are alike: most spheres are far from all of a bundle of them, and are
    left out for the bundle.
    """
    around = np.empty(len(spheres), np.int64)
    for begin in range(first, last, _BUNDLE):
        end = min(begin + _BUNDLE, last)
        count = _spheres_around(begin, end, rays, spheres, around)
        for i in range(begin, end):
            is_near[i] = False
            if count == 0:
                continue
            dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
            length2 = dx * dx + dy * dy + dz * dz
            reach = t[i]
            for n in range(count):
                k = around[n]
                x = spheres[k, 0] - rays[i, 0]
                y = spheres[k, 1] - rays[i, 1]
                z = spheres[k, 2] - rays[i, 2]
                along = x * dx + y * dy + z * dz
                gap2 = x * x + y * y + z * z
                radius = spheres[k, 3]
                # Squared distance of the centre from the ray, times length2.
                if gap2 * length2 - along * along > radius * radius * length2:
                    continue
                if along < 0 and gap2 > radius * radius:
                    continue
                if along - radius * sqrt(length2) < reach * length2:
                    is_near[i] = True
                    break


@compiled
def _spheres_around(
    begin: int, end: int, rays: NDArrayFloat32, spheres: NDArrayFloat32, around: NDArrayAny
) -> int:
    """How many spheres a bundle may meet, and into `around` which.

    The rays begin within `spread` of the middle one's origin, and their unit directions are
    within `bend` of its own: where they come near a sphere they are within ``spread + bend *
    distance`` of its line.
    """
    middle = (begin + end) // 2
    ox, oy, oz = float(rays[middle, 0]), float(rays[middle, 1]), float(rays[middle, 2])
    dx, dy, dz = float(rays[middle, 3]), float(rays[middle, 4]), float(rays[middle, 5])
    length = sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    spread2 = bend2 = 0.0
    for i in range(begin, end):
        x, y, z = rays[i, 0] - ox, rays[i, 1] - oy, rays[i, 2] - oz
        spread2 = max(spread2, x * x + y * y + z * z)
        x, y, z = float(rays[i, 3]), float(rays[i, 4]), float(rays[i, 5])
        scale = 1.0 / sqrt(x * x + y * y + z * z)
        x, y, z = x * scale - dx, y * scale - dy, z * scale - dz
        bend2 = max(bend2, x * x + y * y + z * z)
    spread, bend = sqrt(spread2), sqrt(bend2)
    count = 0
    for k in range(len(spheres)):
        x, y, z = spheres[k, 0] - ox, spheres[k, 1] - oy, spheres[k, 2] - oz
        gap2 = x * x + y * y + z * z
        gap = sqrt(gap2)
        along = x * dx + y * dy + z * dz
        # A ray is as far along as the sphere's far side, at most; a millimetre for rounding.
        wide = spheres[k, 3] + spread + bend * (gap + spread + spheres[k, 3]) + 1e-3
        if gap <= wide or (along > 0.0 and gap2 - along * along <= wide * wide):
            around[count] = k
            count += 1
    return count
