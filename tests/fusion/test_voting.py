import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.fusion.vote_kernels import tally
from hdmap_tools.fusion.voting import SHARE_QUANTA, Votes, cast_votes, tally_by_sorting


def votes_of(labels, mode, *, cells=None, bins=None, frame_key=0, num_bins=2):
    labels = np.asarray(labels)
    cells = np.zeros((len(labels), 2), dtype=np.int64) if cells is None else np.asarray(cells)
    bins = np.zeros(len(labels), dtype=np.int64) if bins is None else np.asarray(bins)
    votes = cast_votes(cells, labels, bins, num_bins=num_bins, mode=mode, frame_key=frame_key)
    return {
        (*map(int, cell), int(channel) // num_bins, int(channel) % num_bins): int(q)
        for cell, channel, q in zip(votes.cells, votes.channels, votes.quanta, strict=True)
    }


def test_point_counts_every_point():
    assert votes_of([1, 1, 3], "point") == {(0, 0, 1, 0): 2, (0, 0, 3, 0): 1}


def test_frame_counts_each_label_once():
    assert votes_of([1, 1, 3], "frame") == {(0, 0, 1, 0): 1, (0, 0, 3, 0): 1}


def test_majority_gives_one_vote_to_the_most_frequent_label():
    assert votes_of([1, 3, 3], "majority") == {(0, 0, 3, 0): 1}


def test_majority_label_outweighs_a_single_larger_bin():
    # Label 1 has 4 points in two bins, label 3 has 3 in one bin: label 1 wins.
    labels, bins = [1, 1, 1, 1, 3, 3, 3], [0, 0, 1, 1, 0, 0, 0]
    votes = votes_of(labels, "majority", bins=bins)
    assert list(votes.values()) == [1]
    assert {key[2] for key in votes} == {1}


def test_share_apportions_by_largest_remainder():
    # 16 quanta over 5 : 1 points: 13.33 and 2.67, so 13 and 3.
    assert votes_of([1] * 5 + [3], "share") == {(0, 0, 1, 0): 13, (0, 0, 3, 0): 3}


def test_a_tied_cell_goes_to_no_label_in_general():
    cells = np.stack(np.meshgrid(np.arange(60), np.arange(60)), axis=-1).reshape(-1, 2)
    both = np.repeat(cells, 2, axis=0)
    labels = np.tile([1, 3], len(cells))
    votes = votes_of(labels, "majority", cells=both)
    share_of_first = sum(key[2] == 1 for key in votes) / len(votes)
    assert len(votes) == len(cells)
    # Binomial with 3600 trials: four standard deviations are 0.033.
    assert abs(share_of_first - 0.5) < 0.034


def test_ties_fall_differently_in_other_frames():
    winners = {next(iter(votes_of([1, 3], "majority", frame_key=k)))[2] for k in range(40)}
    assert winners == {1, 3}


points = st.lists(
    st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(0, 5), st.integers(0, 1)),
    max_size=60,
)


@given(points, st.sampled_from(["majority", "share", "frame", "point"]), st.randoms())
@settings(max_examples=150, deadline=None)
def test_votes_do_not_depend_on_the_order_of_points(rows, mode, random):
    def of(listed):
        array = np.array(listed, dtype=np.int64).reshape(-1, 4)
        return votes_of(array[:, 2], mode, cells=array[:, :2], bins=array[:, 3])

    shuffled = list(rows)
    random.shuffle(shuffled)
    assert of(rows) == of(shuffled)


@given(points)
@settings(max_examples=150, deadline=None)
def test_each_frame_has_the_same_weight_in_every_cell(rows):
    array = np.array(rows, dtype=np.int64).reshape(-1, 4)
    seen = {(x, y) for x, y, _, _ in rows}
    for mode, weight in (("majority", 1), ("share", SHARE_QUANTA)):
        votes = votes_of(array[:, 2], mode, cells=array[:, :2], bins=array[:, 3])
        totals: dict[tuple[int, int], int] = {}
        for (x, y, _, _), quanta in votes.items():
            totals[x, y] = totals.get((x, y), 0) + quanta
        assert totals == dict.fromkeys(seen, weight)


@pytest.mark.parametrize("mode", ["majority", "share", "frame", "point"])
def test_no_points_no_votes(mode):
    votes = cast_votes(
        np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0), num_bins=2, mode=mode, frame_key=0
    )
    assert isinstance(votes, Votes)
    assert len(votes.cells) == len(votes.channels) == len(votes.quanta) == 0


@given(points, st.integers(-(10**6), 10**6))
@settings(max_examples=150, deadline=None)
def test_counting_in_a_box_equals_sorting(rows, shift):
    array = np.array(rows, dtype=np.int64).reshape(-1, 4)
    if len(array) == 0:
        return
    cells, channels = array[:, :2] + shift, array[:, 2] * 2 + array[:, 3]
    compiled = tally(cells, channels)
    assert compiled is not None
    for mine, plain in zip(compiled, tally_by_sorting(cells, channels), strict=True):
        assert mine.dtype == plain.dtype
        assert np.array_equal(mine, plain)


def test_points_far_apart_are_sorted():
    cells = np.array([[0, 0], [10**5, 10**5], [0, 0]], dtype=np.int64)
    channels = np.array([1, 0, 1], dtype=np.int64)
    assert tally(cells, channels) is None
    votes = cast_votes(
        cells, np.array([1, 0, 1]), np.zeros(3, int), num_bins=1, mode="point", frame_key=0
    )
    assert votes.cells.tolist() == [[0, 0], [10**5, 10**5]]
    assert votes.quanta.tolist() == [2, 1]
