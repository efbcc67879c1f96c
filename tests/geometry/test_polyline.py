"""Polylines: length, resampling, repeats, normals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.polyline import arc_lengths, drop_repeats, normals, resample

lines = hnp.arrays(
    np.float64,
    st.tuples(st.integers(2, 12), st.sampled_from([2, 3])),
    elements=st.floats(-100.0, 100.0).map(lambda v: round(v, 3)),
)
CORNER = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 3.0], [3.0, 4.0, 3.0]])


def test_arc_lengths_lie_in_the_plane() -> None:
    np.testing.assert_array_equal(arc_lengths(CORNER), [0.0, 3.0, 7.0])
    np.testing.assert_array_equal(arc_lengths(CORNER[:1]), [0.0])


def test_resampling_a_corner() -> None:
    sampled = resample(CORNER, 1.0)
    assert len(sampled) == 8
    np.testing.assert_allclose(sampled[1], [1.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(sampled[3], CORNER[1], atol=1e-12)
    np.testing.assert_allclose(sampled[5], [3.0, 2.0, 3.0], atol=1e-12)


@given(lines, st.floats(0.5, 50.0))
def test_resampling_keeps_ends_and_stays_on_the_line(line, step_m: float) -> None:
    from shapely import LineString, Point

    sampled = resample(line, step_m)
    np.testing.assert_array_equal(sampled[0], line[0])
    np.testing.assert_array_equal(sampled[-1], line[-1])
    length = arc_lengths(line)[-1]
    assert len(sampled) == max(round(length / step_m), 1) + 1
    for vertex in sampled:
        assert LineString(line[:, :2]).distance(Point(vertex[:2])) < 1e-9
    # Chords cut corners, so a step is never longer than its share of the way.
    steps = np.linalg.norm(np.diff(sampled[:, :2], axis=0), axis=1)
    assert (steps <= length / (len(sampled) - 1) + 1e-9).all()


def test_a_line_shorter_than_the_step_keeps_its_ends() -> None:
    np.testing.assert_array_equal(resample(CORNER[:2], 100.0), CORNER[:2])


def test_repeats_are_dropped_and_both_ends_stay() -> None:
    line = np.array([[0, 0], [0, 0], [1, 0], [1, 1e-9], [2, 0], [2, 1e-9]], dtype=float)
    np.testing.assert_array_equal(drop_repeats(line), [[0, 0], [1, 0], [2, 1e-9]])
    ring = np.array([[0, 0], [1, 0], [1, 1], [0, 0]], dtype=float)
    np.testing.assert_array_equal(drop_repeats(ring), ring)
    np.testing.assert_array_equal(drop_repeats(np.zeros((4, 2))), [[0, 0]])


@given(lines, st.sampled_from([1e-6, 0.5, 30.0]))
def test_after_dropping_no_neighbours_are_near(line, min_step_m: float) -> None:
    kept = drop_repeats(line, min_step_m)
    np.testing.assert_array_equal(kept[0], line[0])
    if len(kept) > 1:
        np.testing.assert_array_equal(kept[-1], line[-1])
        assert (np.linalg.norm(np.diff(kept[:, :2], axis=0), axis=1) > min_step_m).all()
    again = drop_repeats(kept, min_step_m)
    np.testing.assert_array_equal(again, kept)


def test_normals_point_left() -> None:
    east = np.column_stack([np.arange(4.0), np.zeros(4)])
    np.testing.assert_allclose(normals(east), [[0.0, 1.0]] * 4)
    np.testing.assert_allclose(normals(east[::-1]), [[0.0, -1.0]] * 4)


def test_normals_of_a_circle_point_to_its_centre() -> None:
    angle = np.linspace(0, np.pi, 181)
    circle = 20.0 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    left = normals(circle)
    np.testing.assert_allclose(np.linalg.norm(left, axis=1), 1.0)
    np.testing.assert_allclose(left[1:-1], -circle[1:-1, :2] / 20.0, atol=1e-12)


@pytest.mark.parametrize("shape", [(0, 2), (3,), (3, 1), (3, 4)])
def test_what_is_no_polyline_is_refused(shape: tuple[int, ...]) -> None:
    for function in (arc_lengths, drop_repeats, normals, lambda p: resample(p, 1.0)):
        with pytest.raises(ShapeError, match="polyline"):
            function(np.zeros(shape))


@pytest.mark.parametrize("step_m", [0.0, -1.0, np.nan, np.inf])
def test_an_impossible_step_is_refused(step_m: float) -> None:
    with pytest.raises(ShapeError, match="positive metres"):
        resample(CORNER, step_m)


def test_one_vertex_has_no_normal() -> None:
    with pytest.raises(ShapeError, match="at least two"):
        normals(np.zeros((1, 2)))
