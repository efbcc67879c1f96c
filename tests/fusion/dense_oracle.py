"""Dense fusion in plain numpy: every point of every block projected, no culling, no sorting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdmap_tools.association.dense import MAP_GAP_DEG
from hdmap_tools.association.observations import Observations
from hdmap_tools.association.visibility import CELL_PX, MARGIN_M, NEAREST_M, depth_shape, widened
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.dense_fusion import slots_of
from hdmap_tools.fusion.frame_view import FrameView
from hdmap_tools.fusion.point_blocks import PointBlock, block_cells
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.grid import cells_of
from hdmap_tools.point_map.values import MapPoints
from tests.fusion.plain_voting import add_plainly


@dataclass(frozen=True, eq=False)
class AllPoints:
    """Points in memory, in place of a point map on disk."""

    points: MapPoints

    def points_in(self, bounds_m):
        return self.points


def project_plainly(local, n, camera: PinholeCamera):
    """Pixel (row, column), whether it is in the image, whether it is far enough; and depth."""
    f = np.float32
    assert local.dtype == n.dtype == f
    x, y, z = local.T

    def row(k):
        return n[k] * x + n[k + 1] * y + n[k + 2] * z + n[k + 3]

    ex, ey, depth = row(0), row(4), row(16)
    fx, fy, cx, cy, k1, k2, p1, p2, k3, ahead, across, nearest2, px, py, least, radius2 = n[20:]
    with np.errstate(all="ignore"):
        inverse = f(1) / depth
        a, b = row(8) * inverse, row(12) * inverse
        ok = (ex > 0) & (ex <= ahead) & (abs(ey) <= across) & (depth > least)
        if camera.is_distorted:
            r2 = a * a + b * b
            ok &= r2 <= radius2
            radial = f(1) + r2 * (k1 + r2 * (k2 + r2 * k3))
            tangent = a * b
            a, b = (
                a * radial + (f(2) * p1 * tangent + p2 * (r2 + f(2) * a * a)),
                b * radial + (p1 * (r2 + f(2) * b * b) + f(2) * p2 * tangent),
            )
        u, v = fx * a + cx + f(0.5), fy * b + cy + f(0.5)
        ok &= (u >= 0) & (u < f(camera.width_px)) & (v >= 0) & (v < f(camera.height_px))
    pixel = np.column_stack([np.where(ok, v, f(0)), np.where(ok, u, f(0))]).astype(np.int64)
    gx, gy = ex - px, ey - py
    return pixel, ok, gx * gx + gy * gy >= nearest2, depth


def fuse_plainly(counts: CellCounts, points: MapPoints, labels, camera, pose, key, config) -> int:
    """What `DenseFusion.add` does, without a live sweep."""
    meta = counts.meta
    side = block_cells(meta.resolution_m)
    blocks = np.unique(cells_of(points.points_city, meta.resolution_m) // side, axis=0)
    buffer = np.full(depth_shape(camera), np.inf, dtype=np.float32)
    ground = []
    for index in map(tuple, blocks.tolist()):
        inside = (cells_of(points.points_city, meta.resolution_m) // side == np.array(index)).all(
            axis=1
        )
        block = PointBlock.from_points(index, points, meta)
        frame = FrameView.of(camera, pose, config)
        numbers, _ = frame.of_block(block.ground, block.corner_city, meta.resolution_m)
        local_m = points.points_city[inside] - block.corner_city
        local = np.rint(1000.0 * local_m).astype(np.float32)
        pixel, ok, is_far, depth = project_plainly(local, numbers, camera)
        is_ground = points.is_ground[inside]
        hides = ok & ~is_ground & (depth > NEAREST_M)
        np.minimum.at(buffer, tuple(pixel[hides].T // CELL_PX), depth[hides])
        takes = ok & is_ground & is_far
        ground.append((np.flatnonzero(inside)[takes], pixel[takes], depth[takes]))
    at, pixel, depth = (np.concatenate(column) for column in zip(*ground, strict=True))
    found = labels[pixel[:, 0], pixel[:, 1]]
    seen = slots_of(meta.label_set)[2 * found.astype(np.int64)] > 0
    if config.occlusion_test:
        far = widened(buffer, camera, MAP_GAP_DEG, MAP_GAP_DEG) + np.float32(MARGIN_M)
        seen &= depth <= far[tuple(pixel.T // CELL_PX)]
    observed = Observations(points.points_city[at[seen]], found[seen], points.intensity[at[seen]])
    if len(observed) == 0:
        counts.num_frames += 1
    else:
        add_plainly(counts, observed, key)
    return len(observed)
