"""The dense engine over a million points in the clip, beside plain numpy in the same rounds.

Numpy does what the engine's authors would write first: one matrix product, masks, `bincount`
of one count a point. The engine also apportions each cell's vote, and sums heights and
intensity. One thread each.
"""

import json
import os
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest

from hdmap_tools.association.dense import MAP_GAP_DEG
from hdmap_tools.association.visibility import CELL_PX, MARGIN_M, NEAREST_M, depth_shape, widened
from hdmap_tools.config import AssociationConfig
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.dense_fusion import DenseFusion
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import Label, LabelSet
from hdmap_tools.point_map.values import MapPoints

from .machine import projection_ns, read_gb_s

LABELS = LabelSet(
    name="five",
    labels=tuple(Label(id=k, name=f"label {k}", color=(50 * k, 0, 0)) for k in range(5)),
)
META = MapMeta(resolution_m=0.2, label_set=LABELS, count_mode="share", intensity_threshold=40)
CAMERA = PinholeCamera(
    "front", 960, 600, 480.0, 480.0, 479.5, 260.0,
    SE3.from_quaternion(0.5, -0.5, 0.5, -0.5, np.array([1.2, 0.0, 1.6])),
)  # fmt: skip
POSE = SE3.from_yaw(0.3, (7.0, -3.0, 0.0))
AHEAD_M, ACROSS_M = 15.0, 10.0
NUM_IN_CLIP = 1_000_000
BYTES_A_POINT = 7
"""Three positions of 16 bits, and the bin."""
BOX_CELLS = 256


class Place:
    """A million points of ground, all in the clip, two walls, and bright lines of paint."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        ground = np.column_stack(
            [
                rng.uniform(0.0, AHEAD_M, NUM_IN_CLIP),
                rng.uniform(-ACROSS_M, ACROSS_M, NUM_IN_CLIP),
                rng.normal(0.0, 0.02, NUM_IN_CLIP),
            ]
        )
        num_standing = NUM_IN_CLIP // 20
        wall = np.column_stack(
            [
                rng.uniform(0.0, AHEAD_M, num_standing),
                rng.choice([-9.0, 9.0], num_standing),
                rng.uniform(0.3, 3.0, num_standing),
            ]
        )
        across = np.concatenate([ground, wall])[:, 1]
        bright = np.abs(across - np.round(across / 3.5) * 3.5) < 0.08  # a line every 3.5 m
        self.points = MapPoints(
            np.round(POSE.transform_from(np.concatenate([ground, wall])), 3),
            np.where(bright, 80, 20).astype(np.uint8),
            np.arange(NUM_IN_CLIP + num_standing) < NUM_IN_CLIP,
        )

    def points_in(self, bounds_m: tuple[float, float, float, float]) -> MapPoints:
        return self.points


def fuse_with_numpy(
    points: MapPoints, labels: np.ndarray, occlusion: bool, counts: np.ndarray
) -> None:
    """Counts (BOX_CELLS ** 2 * 5,) changed: one a point, as the paper's text has it."""
    ego, cam = POSE.inverse(), (POSE @ CAMERA.ego_SE3_cam).inverse()
    xyz = points.points_city.astype(np.float32)
    in_ego = xyz @ ego.rotation.T.astype(np.float32) + ego.translation.astype(np.float32)
    inside = (in_ego[:, 0] > 0) & (in_ego[:, 0] <= AHEAD_M) & (np.abs(in_ego[:, 1]) <= ACROSS_M)
    xyz, is_ground = xyz[inside], points.is_ground[inside]
    in_cam = xyz @ cam.rotation.T.astype(np.float32) + cam.translation.astype(np.float32)
    depth = in_cam[:, 2]
    column = np.rint(CAMERA.fx * in_cam[:, 0] / depth + CAMERA.cx).astype(np.int64)
    row = np.rint(CAMERA.fy * in_cam[:, 1] / depth + CAMERA.cy).astype(np.int64)
    ok = (depth > 0.1) & (column >= 0) & (column < 960) & (row >= 0) & (row < 600)
    if occlusion:
        buffer = np.full(depth_shape(CAMERA), np.inf, dtype=np.float32)
        hides = ok & ~is_ground & (depth > NEAREST_M)
        np.minimum.at(buffer, (row[hides] // CELL_PX, column[hides] // CELL_PX), depth[hides])
        buffer = widened(buffer, CAMERA, MAP_GAP_DEG, MAP_GAP_DEG) + np.float32(MARGIN_M)
        ok &= is_ground
        ok[ok] = depth[ok] <= buffer[row[ok] // CELL_PX, column[ok] // CELL_PX]
    ok &= is_ground
    found = labels[row[ok], column[ok]]
    cell = np.floor(xyz[ok, :2] / np.float32(0.2)).astype(np.int64) + BOX_CELLS // 2
    counts += np.bincount((cell[:, 1] * BOX_CELLS + cell[:, 0]) * 5 + found, minlength=len(counts))


def best_of(rounds: int, *functions: Callable[[], object]) -> list[float]:
    """Seconds of each in its best round, the rounds interleaved."""
    best = [np.inf] * len(functions)
    for _ in range(rounds):
        for k, function in enumerate(functions):
            begin = time.perf_counter()
            function()
            best[k] = min(best[k], time.perf_counter() - begin)
    return best


@pytest.mark.benchmark_suite
def test_a_million_points_in_the_clip() -> None:
    place = Place()
    small = np.random.default_rng(2).integers(0, 5, (30, 48)).astype(np.uint8)
    labels = np.kron(small, np.ones((20, 20), np.uint8))
    plain = np.zeros(BOX_CELLS**2 * 5, dtype=np.int64)
    figures = {
        "points in the clip": NUM_IN_CLIP,
        "machine": {
            "reads_gb_s": round(read_gb_s(), 1),
            "ns_to_read_a_point": round(BYTES_A_POINT / read_gb_s(), 2),
            "ns_to_project_a_point": round(projection_ns(), 2),
        },
    }
    for occlusion in (False, True):
        config = AssociationConfig(occlusion_test=occlusion, min_range_m=0.0)
        engine, counts = DenseFusion(place, META, config), CellCounts(META)  # type: ignore[arg-type]
        seen = engine.add(counts, labels, CAMERA, POSE, 1)
        slow, fast = best_of(
            12,
            lambda occlusion=occlusion: fuse_with_numpy(place.points, labels, occlusion, plain),
            lambda engine=engine, counts=counts: engine.add(counts, labels, CAMERA, POSE, 1),
        )
        name = "with occlusion" if occlusion else "without occlusion"
        figures[name] = {
            "labelled": seen,
            "numpy_ms": round(1e3 * slow, 2),
            "engine_ms": round(1e3 * fast, 3),
            "ratio": round(slow / fast, 1),
            "ns_a_point_in_the_clip": round(1e9 * fast / NUM_IN_CLIP, 2),
            "ns_a_labelled_point": round(1e9 * fast / seen, 2),
        }
    sys.stderr.write(f"\nload {os.getloadavg()[0]:.1f} {json.dumps(figures, indent=1)}\n")
    assert figures["without occlusion"]["ratio"] >= 30
    assert figures["with occlusion"]["ratio"] >= 10
    assert figures["without occlusion"]["ns_a_point_in_the_clip"] <= 2.5
