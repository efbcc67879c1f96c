import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.association.observations import Observations
from hdmap_tools.errors import CRSMismatchError, LabelError, MapMismatchError, ShapeError
from hdmap_tools.fusion.cell_counts import TILE_CELLS, CellCounts
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame

from .builders import ADAS, counts_of, frames_of, meta

MODES = ["majority", "share", "frame", "point"]


def one_point(x, y, z=0.0, label=1, intensity=10) -> Observations:
    return Observations(
        np.array([[x, y, z]]), np.array([label], np.uint8), np.array([intensity], np.uint8)
    )


def test_a_point_is_counted_in_its_own_cell_only():
    counts = counts_of([(0, one_point(-0.05, 0.25, z=1.234, label=3, intensity=40))])
    # Floor: -0.05 m lies in cell -1, not in cell 0.
    assert list(counts.tiles) == [(-1, 0)]
    layers = counts.tiles[(-1, 0)].layers
    assert layers["counts"][3, 1, 1, TILE_CELLS - 1] == 16
    assert layers["counts"].sum() == 16
    assert layers["height_sum"][1, TILE_CELLS - 1] == 1234
    assert layers["height_sum_sq"][1, TILE_CELLS - 1] == 1234**2
    assert layers["intensity_sum"][1, TILE_CELLS - 1] == 40


@pytest.mark.parametrize(("intensity", "expected_bin"), [(39, 0), (40, 1), (41, 1)])
def test_intensity_at_the_threshold_is_in_the_high_bin(intensity, expected_bin):
    counts = counts_of([(0, one_point(1.0, 1.0, intensity=intensity))])
    assert counts.tiles[(0, 0)].layers["counts"][1, expected_bin].sum() == 16


def test_without_lidar_votes_fall_in_the_low_bin_and_intensity_stays_empty():
    counts = counts_of([(0, Observations(np.zeros((1, 3)), np.array([1], np.uint8)))])
    layers = counts.tiles[(0, 0)].layers
    assert layers["counts"][1, 0].sum() == 16
    assert layers["intensity_n"].sum() == 0
    assert layers["height_n"].sum() == 1


@given(st.integers(0, 10_000), st.sampled_from(MODES), st.randoms())
@settings(max_examples=25, deadline=None)
def test_the_order_of_frames_does_not_matter(seed, mode, random):
    frames = frames_of(seed, 5)
    shuffled = list(frames)
    random.shuffle(shuffled)
    of = meta(count_mode=mode)
    assert counts_of(frames, of).equals(counts_of(shuffled, of))


@given(st.integers(0, 10_000), st.sampled_from(MODES), st.integers(0, 6))
@settings(max_examples=25, deadline=None)
def test_merging_parts_equals_building_the_whole(seed, mode, split):
    frames, of = frames_of(seed, 6), meta(count_mode=mode)
    merged = counts_of(frames[:split], of).merge(counts_of(frames[split:], of))
    whole = counts_of(frames, of)
    assert merged.equals(whole)
    assert merged.num_frames == whole.num_frames == 6


@given(st.integers(0, 10_000), st.sampled_from(MODES), st.integers(0, 6))
@settings(max_examples=25, deadline=None)
def test_subtracting_undoes_merging(seed, mode, split):
    frames, of = frames_of(seed, 6), meta(count_mode=mode)
    first, second = counts_of(frames[:split], of), counts_of(frames[split:], of)
    assert first.merge(second).subtract(second).equals(first)
    assert first.merge(second).subtract(first).equals(second)


@given(st.integers(0, 1000), st.integers(-20, 20))
@settings(max_examples=25, deadline=None)
def test_maps_with_other_reference_heights_merge_exactly(seed, reference_m):
    frames = frames_of(seed, 4)
    low = counts_of(frames[:2], meta(reference_height_m=0.0))
    high = counts_of(frames[2:], meta(reference_height_m=float(reference_m)))
    whole = counts_of(frames, meta(reference_height_m=0.0))
    assert low.merge(high).equals(whole)


def test_equality_sees_one_count():
    frames = frames_of(1, 2)
    changed = counts_of(frames)
    next(iter(changed.tiles.values())).layers["counts"][0, 0, 0, 0] += 1
    assert not changed.equals(counts_of(frames))


def test_subtracting_what_was_never_added_is_refused_and_changes_nothing():
    held, foreign = counts_of(frames_of(1, 2)), counts_of(frames_of(2, 2))
    with pytest.raises(MapMismatchError, match=r"would fall below zero.*not part of this map"):
        held.subtract(foreign)
    assert held.equals(counts_of(frames_of(1, 2)))


def test_overflow_is_refused():
    counts = counts_of([(0, one_point(0.1, 0.1))])
    counts.tiles[(0, 0)].layers["counts"][1, 0, 0, 0] = np.iinfo(np.uint32).max
    with pytest.raises(MapMismatchError, match="overflows"):
        counts.merge(counts_of([(1, one_point(0.1, 0.1))]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"resolution_m": 0.1}, "resolution_m 0.2 and 0.1"),
        ({"count_mode": "point"}, "count_mode 'share' and 'point'"),
        ({"intensity_threshold": 50}, "intensity_threshold 40 and 50"),
        ({"model": "another"}, "model"),
    ],
)
def test_maps_of_another_kind_refuse_to_merge(changes, message):
    with pytest.raises(MapMismatchError, match=message):
        CellCounts(meta()).merge(CellCounts(meta(**changes)))


def test_maps_in_other_frames_refuse_to_merge():
    elsewhere = MapFrame.from_origin(49.0, 8.4).to_json()
    with pytest.raises(CRSMismatchError, match="Two frames were mixed"):
        CellCounts(meta()).merge(CellCounts(meta(frame_document=elsewhere)))


def test_a_label_outside_the_set_is_refused():
    with pytest.raises(LabelError, match=r"label id 4.*ids 0\.\.3"):
        CellCounts(meta()).add(one_point(0, 0, label=len(ADAS)), 0)


def test_a_height_far_from_the_reference_is_refused():
    with pytest.raises(ShapeError, match="reference_height_m"):
        CellCounts(meta()).add(one_point(0, 0, z=4000.0), 0)


def test_a_point_beyond_the_lattice_is_refused():
    with pytest.raises(ShapeError, match="km from the city origin"):
        CellCounts(meta()).add(one_point(3.0e5, 0.0), 0)


def test_a_window_cuts_across_tiles_without_a_shift():
    edge = TILE_CELLS * 0.2
    counts = counts_of(
        [
            (k, one_point(edge + dx, edge + dy, label=k % 4))
            for k, (dx, dy) in enumerate([(-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1), (0.1, 0.1)])
        ]
    )
    window = counts.window(
        BevGrid(0.2, TILE_CELLS - 1, TILE_CELLS - 1, TILE_CELLS + 1, TILE_CELLS + 1)
    )
    best = window.layers["counts"].sum(axis=1).argmax(axis=0)
    # Rows go north, columns go east.
    assert best.tolist() == [[0, 1], [2, 3]]


def test_a_window_outside_all_tiles_is_empty():
    window = counts_of(frames_of(0, 1)).window(BevGrid(0.2, 9000, 9000, 9010, 9020))
    assert window.layers["counts"].shape == (4, 2, 20, 10)
    assert window.is_empty


def test_a_point_without_intensity_is_no_sign_of_paint():
    observations = Observations(
        np.array([[0.1, 0.1, 0.0], [0.3, 0.1, 0.0]]),
        np.array([1, 1], np.uint8),
        np.array([200, 200], np.uint8),
        np.array([True, False]),
    )
    layers = counts_of([(0, observations)]).tiles[(0, 0)].layers
    assert layers["counts"][1, :, 0, :2].tolist() == [[0, 16], [16, 0]]
    assert layers["intensity_n"][0, :2].tolist() == [1, 0]
    assert layers["intensity_sum"][0, :2].tolist() == [200, 0]


def test_bands_of_range_are_counted_apart():
    plain = meta(intensity_threshold=100)
    banded = plain.model_copy(update={"range_edges_m": (6.0, 10.0)})
    points = np.zeros((4, 3)) + (0.05, 0.05, 0.0)
    seen = Observations(
        points,
        np.array([1, 1, 1, 1], np.uint8),
        np.array([0, 200, 200, 0], np.uint8),
        range_m=np.array([5.9, 6.0, 9.9, 10.0]),
    )
    counts = CellCounts(banded.model_copy(update={"count_mode": "point"}))
    counts.add(seen, 1)
    assert counts.tiles[0, 0].layers["counts"][1, :, 0, 0].tolist() == [1, 0, 0, 2, 1, 0]
    with pytest.raises(ShapeError, match="say no range"):
        counts.add(Observations(points, seen.labels, seen.intensity), 2)
    with pytest.raises(MapMismatchError, match="range_edges_m"):
        CellCounts(plain).merge(CellCounts(banded))
