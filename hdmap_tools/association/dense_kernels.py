"""Dense association, compiled: a pass that clips and projects, one for depths, one for labels.

The plain form is `PinholeCamera.project`, `is_unoccluded` and `labels_at`, which the
tests hold it equal to; it takes ten times as long, most of it for arrays in between.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hdmap_tools.geometry.camera import MIN_DEPTH_M
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def see_points(
    points_city: NDArrayFloat,
    ego_R_city: NDArrayFloat,
    ego_t_city: NDArrayFloat,
    clip: tuple[float, float, float],
    camera_ego: NDArrayFloat,
    cam_R_city: NDArrayFloat,
    cam_t_city: NDArrayFloat,
    lens: tuple[float, ...],
    size_px: tuple[int, int],
    max_radius: float,
) -> tuple[NDArrayInt, NDArrayAny, NDArrayFloat, NDArrayBool]:
    """Points of the clip that land in the image.

    Args:
        points_city: (N, 3) metres.
        ego_R_city: (3, 3), with
        ego_t_city: (3,) the inverse of the ego pose.
        clip: Metres ahead, to either side, and from the camera in x-y, nearer than
            which a point is only good to hide others.
        camera_ego: (3,) the camera's place.
        cam_R_city: (3, 3), with
        cam_t_city: (3,) from city into the camera.
        lens: With
        size_px: and
        max_radius: the three of `PinholeCamera.lens`.

    Returns:
        Rows (M,), their pixels (M, 2) int32 as (row, column), depth (M,) metres, and
        which are far enough from the camera.
    """
    count = len(points_city)
    at = np.empty(count, dtype=np.int64)
    pixel = np.empty((count, 2), dtype=np.int32)
    depth = np.empty(count)
    is_far = np.empty(count, dtype=np.bool_)
    ahead, across, min_range = clip
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    width, height = size_px
    R, t, C, s = ego_R_city, ego_t_city, cam_R_city, cam_t_city
    is_clipped = ahead < np.inf
    n = 0
    for i in range(count):
        x, y, z = points_city[i]
        ex = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        ey = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        if is_clipped and (ex <= 0.0 or ex > ahead or abs(ey) > across):
            continue
        d = C[2, 0] * x + C[2, 1] * y + C[2, 2] * z + s[2]
        if not d > MIN_DEPTH_M:
            continue
        a = (C[0, 0] * x + C[0, 1] * y + C[0, 2] * z + s[0]) / d
        b = (C[1, 0] * x + C[1, 1] * y + C[1, 2] * z + s[1]) / d
        r2 = a * a + b * b
        if r2 > max_radius * max_radius:
            continue
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + cx
        v = fy * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + cy
        if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
            continue
        at[n] = i
        pixel[n, 0], pixel[n, 1] = int(np.rint(v)), int(np.rint(u))
        depth[n] = d
        gx, gy = ex - camera_ego[0], ey - camera_ego[1]
        is_far[n] = gx * gx + gy * gy >= min_range * min_range
        n += 1
    return at[:n], pixel[:n], depth[:n], is_far[:n]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def lay_depth(
    buffer: NDArrayFloat,
    at: NDArrayInt,
    pixel: NDArrayAny,
    depth: NDArrayFloat,
    is_far: NDArrayBool,
    is_ground: NDArrayBool,
    cell_px: int,
    nearest_m: float,
) -> None:
    """Lay what stands into a depth buffer (rows, columns) of cells of cell_px pixels.

    Args:
        buffer: Changed: the nearest depth.
        at: With
        pixel: and
        depth: and
        is_far: what `see_points` gave.
        is_ground: (N,) of all points: ground hides nothing.
        cell_px: Edge of a cell.
        nearest_m: What is nearer belongs to the vehicle.
    """
    for i in range(len(at)):
        if is_ground[at[i]] or depth[i] <= nearest_m:
            continue
        row, column = pixel[i, 0] // cell_px, pixel[i, 1] // cell_px
        buffer[row, column] = min(buffer[row, column], depth[i])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def look_up(
    at: NDArrayInt,
    pixel: NDArrayAny,
    depth: NDArrayFloat,
    is_far: NDArrayBool,
    is_ground: NDArrayBool,
    hides_from_m: NDArrayFloat,
    cell_px: int,
    label_image: NDArrayByte,
    speaks: NDArrayBool,
) -> tuple[NDArrayInt, NDArrayByte]:
    """Rows (K,) of the ground points that the image shows, and the labels (K,) found there.

    Args:
        at: With
        pixel: and
        depth: and
        is_far: what `see_points` gave.
        is_ground: (N,) of all points.
        hides_from_m: Depth by cell from which on points are hidden; empty: nothing is.
        cell_px: Edge of a cell.
        label_image: (height, width).
        speaks: (256,) labels that say something about the ground.
    """
    found = np.empty(len(at), dtype=np.int64)
    labels = np.empty(len(at), dtype=np.uint8)
    tested = hides_from_m.size > 0
    n = 0
    for i in range(len(at)):
        if not (is_far[i] and is_ground[at[i]]):
            continue
        row, column = pixel[i]
        label = label_image[row, column]
        if not speaks[label]:
            continue
        if tested and depth[i] > hides_from_m[row // cell_px, column // cell_px]:
            continue
        found[n], labels[n] = at[i], label
        n += 1
    return found[:n], labels[:n]
