"""Pieces of one line are told from lines that merely lie near one another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdmap_plugins.fragments import lengths_with_company


def line(*points: tuple[float, float]) -> np.ndarray:
    return np.array(points, dtype=np.float64)


FIRST = line((0, 0), (2, 0))


@pytest.mark.parametrize(
    ("other", "together"),
    [
        (line((3, 0), (5, 0.1)), True),
        (line((2, 0), (5, 0)), True),  # without a gap
        (line((3, 0.5), (5, 1.5)), True),  # a bend
        (line((4.5, 0), (6.5, 0)), False),  # the gap is longer than either
        (line((3.5, 0), (4.7, 0)), False),  # longer than the second
        (line((2.1, 0), (2.9, 0)), False),  # too short to point anywhere
        (line((5, 0), (3, 0)), False),  # the other way round: road on its other side
        (line((2.5, 0), (2.5, 3)), False),  # a corner
        (line((2, 1), (4, 1)), False),  # beside it
        (line((1, 0), (3, 0)), False),  # starts before the first one ends
    ],
)
def test_company_goes_on_in_the_same_direction(other, together):
    lengths = lengths_with_company([FIRST, other], 1.0)
    alone = np.array([2.0, np.hypot(*(other[1] - other[0]))])
    np.testing.assert_allclose(lengths, alone.sum() if together else alone)
    np.testing.assert_allclose(lengths_with_company([other, FIRST], 1.0), lengths[::-1])


def test_a_chain_counts_as_a_whole():
    pieces = [line((x, 0), (x + 1, 0)) for x in (6.0, 0.0, 1.5, 4.5, 3.0)]
    np.testing.assert_allclose(lengths_with_company(pieces, 1.0), 5.0)
    # Without the one in the middle two chains are left.
    np.testing.assert_allclose(lengths_with_company(pieces[:-1], 1.0), 2.0)


def test_none_and_one():
    assert lengths_with_company([], 1.0).shape == (0,)
    np.testing.assert_allclose(lengths_with_company([FIRST], 1.0), [2.0])


@given(st.integers(0, 10_000), st.floats(0, 2 * np.pi))
def test_turning_and_moving_the_lines_changes_nothing(seed, angle):
    rng = np.random.default_rng(seed)
    lines = [np.cumsum(rng.normal(0, 1, (4, 2)) + [1, 0], axis=0) for _ in range(6)]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = [x @ turn.T + [3.0, -2.0] for x in lines]
    np.testing.assert_allclose(
        lengths_with_company(moved, 1.0), lengths_with_company(lines, 1.0), rtol=1e-9
    )
