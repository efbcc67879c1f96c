"""The dense engine against plain numpy, bit for bit, and against association in float64."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.association.dense import associate_dense
from hdmap_tools.config import AssociationConfig
from hdmap_tools.errors import ConfigError
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.dense_fusion import DenseFusion
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.point_map.values import MapPoints
from tests.fusion.builders import ADAS, meta
from tests.fusion.dense_oracle import AllPoints, fuse_plainly

MODES = ["share", "majority", "frame", "point"]
LENSES = [(0.0,) * 5, (-0.3, 0.09, 0.001, -0.0005, -0.01)]
FAR_M = (50_000.0, -43_217.4)


def place(rng, number, centre, extent_m=20.0):
    """Ground on a slope with things standing on it, whole millimetres."""
    xy = rng.uniform(-extent_m, extent_m, (number, 2))
    is_ground = rng.random(number) < 0.85
    z = 0.03 * xy[:, 0] + np.where(
        is_ground, rng.normal(0, 0.03, number), rng.uniform(0.2, 2.5, number)
    )
    points = np.round(np.column_stack([xy + centre, z + 61.0]), 3)
    return MapPoints(points, rng.integers(0, 90, number).astype(np.uint8), is_ground)


def camera_of(distortion, rng):
    mount = SE3.from_quaternion(0.5, -0.5, 0.5, -0.5, rng.normal(0, 0.3, 3) + (1.2, 0.0, 1.6))
    return PinholeCamera("front", 161, 97, 120.0, 118.0, 79.3, 45.8, mount, distortion)


def patches(rng, camera):
    """Labels in patches, some of them 255."""
    small = rng.choice([0, 1, 2, 3, 255], (9, 13), p=[0.2, 0.4, 0.2, 0.15, 0.05]).astype(np.uint8)
    return np.kron(small, np.ones((11, 13), np.uint8))[: camera.height_px, : camera.width_px]


def pose_at(rng, centre):
    yaw = rng.uniform(-np.pi, np.pi)
    return SE3.from_yaw(yaw, (*(np.array(centre) + rng.uniform(-5, 5, 2)), 61.0))


@pytest.mark.parametrize("mode", MODES)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0, 1, 40, 6000]),
    st.sampled_from(LENSES),
    st.sampled_from([(0.0, 0.0), (-3.0, 25.6), FAR_M]),
    st.booleans(),
    st.sampled_from([0.1, 0.15, 0.2, 0.5]),
)
@settings(max_examples=25, deadline=None)
def test_counts_are_those_of_plain_numpy_bit_for_bit(
    mode, seed, number, distortion, centre, occlusion, resolution_m
):
    rng = np.random.default_rng(seed)
    points = place(rng, number, centre)
    config = AssociationConfig(occlusion_test=occlusion)
    of_meta = meta(count_mode=mode, resolution_m=resolution_m)
    engine = DenseFusion(AllPoints(points), of_meta, config)
    mine, plain = CellCounts(of_meta), CellCounts(of_meta)
    for key in range(2):
        camera, pose = camera_of(distortion, rng), pose_at(rng, centre)
        labels = patches(rng, camera)
        seen = engine.add(mine, labels, camera, pose, key)
        if number:
            assert seen == fuse_plainly(plain, points, labels, camera, pose, key, config)
        else:
            assert seen == 0
            plain.num_frames += 1
    assert mine.equals(plain)
    assert mine.num_frames == plain.num_frames
    assert not any(tile.is_empty for tile in mine.tiles.values())


@pytest.mark.parametrize("centre", [(0.0, 0.0), FAR_M])
def test_it_agrees_with_association_in_float64(centre):
    rng = np.random.default_rng(3)
    points = place(rng, 60_000, centre)
    of_meta, config = meta(), AssociationConfig()
    engine = DenseFusion(AllPoints(points), of_meta, config)
    mine, other = CellCounts(of_meta), CellCounts(of_meta)
    total = 0
    for key in range(10):
        camera, pose = camera_of(LENSES[key % 2], rng), pose_at(rng, centre)
        labels = patches(rng, camera)
        standing = place(rng, 30, pose.translation[:2]).points_city + (0.0, 0.0, 1.0)
        total += engine.add(mine, labels, camera, pose, key, standing, 1.0)
        seen = associate_dense(labels, ADAS, camera, pose, points, config, standing, 1.0)
        other.add(seen, key)
    assert total > 3000
    votes = sum(int(t.layers["counts"].sum()) for t in other.tiles.values())
    differing = sum(
        int(np.abs(t.layers["counts"].astype(int) - other.tiles[i].layers["counts"]).sum())
        for i, t in mine.tiles.items()
    )
    # A point in some ten thousand lies within a float32's rounding of a pixel's edge.
    assert differing < 1e-3 * votes


def test_threads_change_nothing():
    rng = np.random.default_rng(5)
    points = place(rng, 20_000, (0.0, 0.0))
    frames = [
        (camera := camera_of(LENSES[k % 2], rng), pose_at(rng, (0.0, 0.0)), patches(rng, camera), k)
        for k in range(12)
    ]

    def fused(some):
        counts = CellCounts(meta())
        engine = DenseFusion(AllPoints(points), counts.meta, AssociationConfig())
        for camera, pose, labels, key in some:
            engine.add(counts, labels, camera, pose, key)
        return counts

    whole = fused(frames)
    for threads in (2, 3):
        with ThreadPoolExecutor(threads) as pool:
            parts = list(pool.map(fused, [frames[k::threads] for k in range(threads)]))
        merged = parts[0]
        for part in parts[1:]:
            merged = merged.merge(part)
        assert merged.equals(whole)


def test_few_bytes_of_memory_give_the_same_counts():
    rng = np.random.default_rng(6)
    points = place(rng, 20_000, (0.0, 0.0))
    made = []
    for max_bytes in (1, 2**28):
        rng = np.random.default_rng(7)
        counts = CellCounts(meta(resolution_m=0.05))
        engine = DenseFusion(AllPoints(points), counts.meta, AssociationConfig(), max_bytes)
        for key in range(4):
            camera, pose = camera_of(LENSES[0], rng), pose_at(rng, (0.0, 0.0))
            engine.add(counts, patches(rng, camera), camera, pose, key)
        made.append(counts)
    assert made[0].tiles
    assert made[0].equals(made[1])


def test_bands_of_range_are_refused():
    with pytest.raises(ConfigError, match="range_edges_m"):
        DenseFusion(AllPoints(None), meta(range_edges_m=(10.0,)), AssociationConfig())
