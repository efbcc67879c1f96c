"""Clips of observations, and the ways to count."""

import itertools

import numpy as np

from hdmap_tools.association.observations import Observations
from hdmap_tools.compare.paper import PAPER_TABLE
from hdmap_tools.config import ObservationConfig
from hdmap_tools.evaluate.maps import FAR_M, clipped
from hdmap_tools.evaluate.methods import (
    ASSOCIATIONS,
    BANDS_M,
    BY_RANGE,
    CLIP,
    COUNT_MODES,
    MODE_METHODS,
    OUR_MAP,
    OUR_METHODS,
    PAPER_MAP,
    PAPER_METHODS,
    band_name,
)
from hdmap_tools.geometry.se3 import SE3

EGO = np.array(
    [
        [0.0, 0.0, 0.0],  # at the origin: behind the clip's open edge
        [0.01, 9.99, 0.5],
        [15.0, -10.0, -3.0],  # on the far corner: inside
        [15.01, 0.0, 0.0],
        [5.0, 10.01, 0.0],
        [9.0, -4.0, 2.0],  # inside, and not where x and y are swapped
        [-3.0, 1.0, 0.0],
    ]
)
INSIDE = [1, 2, 5]


def seen_from(pose: SE3) -> Observations:
    number = np.arange(len(EGO), dtype=np.uint8)
    return Observations(
        pose.transform_from(EGO),
        number,
        number + 100,
        number % 2 == 0,
        number.astype(np.float64) + 0.5,
    )


def test_the_clip_is_that_of_the_pose_and_keeps_rows_together():
    for pose in (
        SE3.identity(),
        SE3.from_yaw(np.pi / 2, (100.0, -50.0, 7.0)),
        SE3.from_yaw(2.3, (-8.0, 3.0, 1.0)),
    ):
        # The corner itself may fall either way once it has been turned.
        eased = 15.0 + 1e-9, 10.0 + 1e-9
        got = clipped(seen_from(pose), pose, (1e-9, eased[0]), eased[1])
        assert got.labels.tolist() == INSIDE
        np.testing.assert_array_equal(got.points_city, pose.transform_from(EGO)[INSIDE])
        assert got.intensity.tolist() == [100 + k for k in INSIDE]
        assert got.has_intensity.tolist() == [k % 2 == 0 for k in INSIDE]
        assert got.range_m.tolist() == [k + 0.5 for k in INSIDE]


def test_bands_next_to_each_other_share_no_point_and_lose_none():
    pose = SE3.identity()
    points = np.zeros((200, 3))
    points[:, 0] = np.arange(200) / 8.0  # 10 and 15 m are among them
    seen = Observations(points, np.zeros(200, np.uint8))
    parts = [clipped(seen, pose, band, 10.0) for band in BANDS_M]
    together = np.concatenate([part.points_city[:, 0] for part in parts])
    np.testing.assert_array_equal(together, points[1:, 0])
    assert parts[0].points_city[-1, 0] == BANDS_M[0][1]


def test_nothing_in_the_clip_and_no_intensity():
    seen = Observations(np.array([[-5.0, 0.0, 0.0]]), np.zeros(1, np.uint8))
    got = clipped(seen, SE3.identity(), (0.0, 15.0), 10.0)
    assert len(got) == 0
    assert got.intensity is None


def test_every_method_reads_a_map_that_is_made_and_an_observation_model_that_is():
    variants = (*CLIP, *COUNT_MODES, *BY_RANGE)
    names = [variant.name for variant in variants]
    assert len(set(names)) == len(names)
    methods = (*PAPER_METHODS, *OUR_METHODS, *MODE_METHODS)
    assert len({method.name for method in methods}) == len(methods)
    for method in methods:
        assert method.map_name in names
        ObservationConfig.model_validate(method.observation)
    assert {m.name for m in PAPER_METHODS} == set(PAPER_TABLE)
    for method in PAPER_METHODS:
        config = ObservationConfig.model_validate(method.observation)
        assert config.intensity == ("gamma" if method.name.endswith("+I") else "off")
        assert config.model == ("confusion" if method.name.startswith("CFN") else "vanilla")
        assert not config.other


def test_the_clip_is_the_papers_and_the_bands_are_one_stretch():
    by_name = {variant.name: variant for variant in (*CLIP, *BY_RANGE)}
    assert by_name[PAPER_MAP].ahead_m == by_name[OUR_MAP].ahead_m == (0.0, 15.0)
    assert not by_name[PAPER_MAP].occlusion_test
    assert by_name[OUR_MAP].occlusion_test
    assert BANDS_M[0][0] == 0.0
    assert BANDS_M[-1][1] == FAR_M
    assert all(a[1] == b[0] for a, b in itertools.pairwise(BANDS_M))
    for method in ASSOCIATIONS:
        for band in BANDS_M:
            assert by_name[band_name(method, band)].method == method
            assert by_name[band_name(method, band)].ahead_m == band
