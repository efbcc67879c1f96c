import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.association.observations import Observations
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.voting import SHARE_QUANTA
from hdmap_tools.labels.label_set import Label, LabelSet
from tests.fusion.builders import meta
from tests.fusion.plain_voting import add_plainly, cast_votes


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


def label_set_of(size):
    return LabelSet(
        name=f"of-{size}",
        labels=tuple(Label(id=k, name=f"l{k}", color=(k, 0, 0)) for k in range(size)),
    )


@pytest.mark.parametrize("mode", ["majority", "share", "frame", "point"])
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 400),
    st.sampled_from([0.05, 0.2, 0.7]),
    st.sampled_from([2, 5, 255]),
    st.sampled_from(["none", "some", "all"]),
    st.sampled_from([3.0, 60.0, 50_000.0]),
)
@settings(max_examples=60, deadline=None)
def test_compiled_votes_are_the_plain_ones_bit_for_bit(
    mode, seed, number, extent_m, num_labels, measured, away_m
):
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [rng.uniform(-extent_m, extent_m, (number, 2)) + away_m, rng.normal(3.0, 2.0, number)]
    )
    if away_m > 1000 and number:
        points[0] = -points[0]  # tiles too far apart to count in a box
    seen = Observations(
        points,
        rng.integers(0, num_labels, number).astype(np.uint8),
        None if measured == "none" else rng.integers(0, 90, number).astype(np.uint8),
        rng.random(number) < 0.7 if measured == "some" else None,
    )
    of_meta = meta(count_mode=mode, label_set=label_set_of(num_labels))
    compiled, plain = CellCounts(of_meta), CellCounts(of_meta)
    for key in (seed, 7):
        compiled.add(seen, key)
        add_plainly(plain, seen, key)
    assert compiled.equals(plain)
    assert compiled.tile_indices() == plain.tile_indices()
    assert compiled.num_frames == plain.num_frames == 2


@pytest.mark.parametrize("mode", ["share", "majority", "frame", "point"])
@pytest.mark.parametrize("num_labels", [2, 3, 5])
def test_crowded_cells_are_shared_as_plain_numpy_shares_them(mode, num_labels):
    # 1 to 31 is a tie of remainders, 16 to 16 of points: each in 40 cells, so that luck shows.
    rng = np.random.default_rng(num_labels)
    shapes = [(1, 31), (16, 16), (3, 13), (5, 27), (40, 8)]
    if num_labels > 2:
        shapes = [tuple(rng.integers(0, 30, num_labels)) for _ in range(40)]
    cells = [(5 * k + c, k) for k in range(len(shapes)) for c in range(40)]
    centres = (np.array(cells) + 0.5) * 0.2
    labels = [
        rng.permutation(np.repeat(np.arange(num_labels), shape))
        for shape in shapes
        for _ in range(40)
    ]
    xy = np.repeat(centres, [len(some) for some in labels], axis=0)
    flat = np.concatenate(labels).astype(np.uint8)
    seen = Observations(np.column_stack([xy, rng.normal(0, 0.1, len(xy))]), flat, 30 * flat)
    of_meta = meta(count_mode=mode, label_set=label_set_of(num_labels))
    fast, plain = CellCounts(of_meta), CellCounts(of_meta)
    for key in range(3):
        fast.add(seen, key)
        add_plainly(plain, seen, key)
    assert fast.equals(plain)
