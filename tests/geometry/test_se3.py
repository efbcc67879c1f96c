"""SE3: exact cases, group laws, and what it refuses."""

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.se3 import SE3

from .strategies import points, poses


def assert_close(a: SE3, b: SE3, tolerance: float = 1e-8) -> None:
    np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-12, rtol=0)
    np.testing.assert_allclose(a.translation, b.translation, atol=tolerance, rtol=0)


def test_quaternion_is_scalar_first() -> None:
    half = np.sqrt(0.5)
    turn = SE3.from_quaternion(half, 0.0, 0.0, half, np.zeros(3))
    np.testing.assert_allclose(
        turn.transform_from([[1.0, 0.0, 0.0]]), [[0.0, 1.0, 0.0]], atol=1e-15
    )
    assert turn.yaw_rad == pytest.approx(np.pi / 2, abs=1e-15)
    flip = SE3.from_quaternion(0.0, 1.0, 0.0, 0.0, np.zeros(3))
    np.testing.assert_allclose(flip.rotation, np.diag([1.0, -1.0, -1.0]), atol=1e-15)


def test_quaternion_is_normalized_and_its_sign_is_canonical() -> None:
    pose = SE3.from_quaternion(-2.0, 0.0, 0.0, -2.0, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(pose.quaternion_wxyz, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)


def test_dst_and_src_read_as_written() -> None:
    city_SE3_ego = SE3.from_yaw(np.pi / 2, (10.0, 20.0, 0.5))
    # One metre ahead of a car that looks north is one metre north of it.
    np.testing.assert_allclose(
        city_SE3_ego.transform_from([[1.0, 0.0, 0.0]]), [[10.0, 21.0, 0.5]], atol=1e-12
    )
    ego_SE3_cam = SE3(np.eye(3), np.array([2.0, 0.0, 1.5]))
    np.testing.assert_allclose((city_SE3_ego @ ego_SE3_cam).translation, [10.0, 22.0, 2.0])


def test_the_rotation_matrix_agrees_with_scipy() -> None:
    q = np.array([0.5, -0.1, 0.7, 0.2])
    expected = Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix()
    np.testing.assert_allclose(SE3.from_quaternion(*q, np.zeros(3)).rotation, expected, atol=1e-15)


@given(poses())
def test_inverse_undoes(pose: SE3) -> None:
    assert_close(pose @ pose.inverse(), SE3.identity(), 1e-9)
    assert_close(pose.inverse() @ pose, SE3.identity(), 1e-9)
    assert_close(pose.inverse().inverse(), pose)


@given(poses(), poses(), points())
def test_composing_is_applying_one_after_the_other(a_SE3_b: SE3, b_SE3_c: SE3, points_c) -> None:
    once = a_SE3_b.compose(b_SE3_c).transform_from(points_c)
    twice = a_SE3_b.transform_from(b_SE3_c.transform_from(points_c))
    np.testing.assert_allclose(once, twice, atol=1e-8, rtol=0)


@given(poses(), poses(), poses())
def test_composition_is_associative(a: SE3, b: SE3, c: SE3) -> None:
    assert_close((a @ b) @ c, a @ (b @ c))


@given(poses(), points())
def test_there_and_back(pose: SE3, points_src) -> None:
    back = pose.inverse().transform_from(pose.transform_from(points_src))
    assert back.shape == points_src.shape
    np.testing.assert_allclose(back, points_src, atol=1e-8, rtol=0)


@given(poses(), points())
def test_distances_are_kept(pose: SE3, points_src) -> None:
    moved = pose.transform_from(points_src)
    before = np.linalg.norm(points_src[:, None] - points_src[None], axis=2)
    after = np.linalg.norm(moved[:, None] - moved[None], axis=2)
    np.testing.assert_allclose(after, before, atol=1e-7, rtol=0)


@given(poses())
def test_matrix_and_quaternion_round_trips(pose: SE3) -> None:
    assert_close(SE3.from_matrix(pose.matrix), pose)
    assert_close(SE3.from_quaternion(*pose.quaternion_wxyz, pose.translation), pose)
    assert pose.quaternion_wxyz[0] >= 0.0
    assert np.linalg.norm(pose.quaternion_wxyz) == pytest.approx(1.0, abs=1e-12)


def test_a_loop_closes() -> None:
    """36 turns of ten degrees with one metre of driving each end where they began."""
    step = SE3.from_yaw(np.deg2rad(10.0), (1.0, 0.0, 0.0))
    pose = SE3.identity()
    for _ in range(36):
        pose = pose @ step
    assert_close(pose, SE3.identity(), 1e-12)


def test_a_long_chain_stays_orthonormal() -> None:
    step = SE3.from_quaternion(0.9, 0.1, -0.2, 0.3, np.array([0.1, 0.0, 0.0]))
    pose = SE3.identity()
    for _ in range(20_000):
        pose = pose @ step
    assert np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max() < 1e-14


def test_values_cannot_be_changed_and_are_copies() -> None:
    rotation, translation = np.eye(3), np.zeros(3)
    pose = SE3(rotation, translation)
    translation[0] = 7.0
    assert pose.translation[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        pose.rotation[0, 0] = 2.0


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.eye(4), np.zeros(3), r"\(4, 4\)"),
        (np.eye(3), np.zeros((3, 1)), r"\(3, 1\)"),
        (np.eye(3), [0.0, np.nan, 0.0], "NaN or infinite"),
        (np.full((3, 3), np.inf), np.zeros(3), "NaN or infinite"),
        (2 * np.eye(3), np.zeros(3), "orthonormal"),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "determinant"),
    ],
)
def test_unusable_transforms_are_refused(rotation, translation, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        SE3(rotation, translation)


@pytest.mark.parametrize("wxyz", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1)])
def test_a_quaternion_without_direction_is_refused(wxyz) -> None:
    with pytest.raises(ShapeError, match="has no direction"):
        SE3.from_quaternion(*wxyz, np.zeros(3))


def test_a_transposed_matrix_is_refused() -> None:
    matrix = SE3.from_yaw(0.3, (5.0, 6.0, 7.0)).matrix
    with pytest.raises(ShapeError, match="transposed"):
        SE3.from_matrix(matrix.T)
    with pytest.raises(ShapeError, match=r"\(3, 4\)"):
        SE3.from_matrix(matrix[:3])


@pytest.mark.parametrize("shape", [(3,), (4, 2), (2, 4), (1, 3, 1)])
def test_points_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"must be \(N, 3\)"):
        SE3.identity().transform_from(np.zeros(shape))
