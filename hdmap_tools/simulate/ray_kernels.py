"""What happens to each ray around the caster: made, sorted out, and its hit given a material."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from hdmap_tools.simulate.compiled import compiled
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32

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
    """Which rays pass through a sphere before they hit; spheres (K, 4) are centre and radius."""
    for i in range(first, last):
        is_near[i] = False
        dx, dy, dz = rays[i, 3], rays[i, 4], rays[i, 5]
        length2 = dx * dx + dy * dy + dz * dz
        reach = t[i]
        for k in range(len(spheres)):
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
