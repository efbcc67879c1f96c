"""PinholeCamera, with OpenCV as the judge of the lens model."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.errors import CalibrationError, ShapeError
from hdmap_tools.geometry.camera import MIN_DEPTH_M, PinholeCamera
from hdmap_tools.geometry.se3 import SE3

# Camera axes (x right, y down, z ahead) in ego axes (x ahead, y left, z up).
EGO_R_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FORWARD = SE3(EGO_R_CAM, np.array([1.5, 0.2, 1.6]))
BARREL = (-0.31, 0.12, 0.001, -0.0007, -0.02)
FOLDING = (-0.3, 0.0, 0.0, 0.0, 0.0)
PINCUSHION = (0.2, 0.05, -0.001, 0.002, 0.01)


def camera(distortion=(0.0,) * 5, mount: SE3 = FORWARD) -> PinholeCamera:
    return PinholeCamera("CAM_FRONT", 1600, 900, 1266.4, 1260.1, 816.3, 491.5, mount, distortion)


def random_points_ego(count: int = 2000) -> np.ndarray:
    rng = np.random.default_rng(7)
    depth = rng.uniform(1.0, 60.0, count)
    return np.column_stack(
        [1.5 + depth, depth * rng.uniform(-0.7, 0.7, count), depth * rng.uniform(-0.4, 0.4, count)]
    )


def test_a_point_straight_ahead_lands_on_the_principal_point() -> None:
    projection = camera(BARREL).project(np.array([[11.5, 0.2, 1.6]]))
    np.testing.assert_allclose(projection.uv, [[816.3, 491.5]], atol=1e-9)
    assert projection.depth_m[0] == pytest.approx(10.0)
    assert projection.is_valid[0]


def test_left_is_left_and_up_is_up() -> None:
    uv = camera().project(np.array([[11.5, 1.2, 1.6], [11.5, 0.2, 2.6]])).uv
    np.testing.assert_allclose(uv, [[816.3 - 126.64, 491.5], [816.3, 491.5 - 126.01]], atol=1e-9)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL, PINCUSHION])
def test_projection_agrees_with_opencv(distortion) -> None:
    lens = camera(distortion)
    points_ego = random_points_ego()
    projection = lens.project(points_ego)
    cam_SE3_ego = lens.ego_SE3_cam.inverse()
    expected, _ = cv2.projectPoints(
        points_ego,
        cv2.Rodrigues(cam_SE3_ego.rotation)[0],
        cam_SE3_ego.translation,
        lens.matrix,
        np.array(distortion),
    )
    expected = expected.reshape(-1, 2)
    with_model = np.isfinite(projection.uv).all(axis=1)
    assert with_model.mean() > 0.95
    np.testing.assert_allclose(projection.uv[with_model], expected[with_model], atol=1e-6)
    u, v = expected[with_model].T
    inside = (u >= -0.5) & (u < 1599.5) & (v >= -0.5) & (v < 899.5)
    assert 0.2 < inside.mean() < 0.99
    np.testing.assert_array_equal(projection.is_valid[with_model], inside)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL, PINCUSHION])
def test_rays_lead_back_to_the_points(distortion) -> None:
    lens = camera(distortion)
    points_ego = random_points_ego()
    projection = lens.project(points_ego)
    seen = projection.is_valid
    assert seen.sum() > 500
    back = lens.ego_SE3_cam.translation + projection.depth_m[seen, None] * lens.rays_ego(
        projection.uv[seen]
    )
    np.testing.assert_allclose(back, points_ego[seen], atol=1e-7)


@given(
    st.floats(-0.35, 0.35),
    st.floats(-0.1, 0.15),
    st.floats(-0.002, 0.002),
    st.floats(-0.002, 0.002),
    st.floats(-0.03, 0.05),
    st.floats(-0.5, 1599.4),
    st.floats(-0.5, 899.4),
    st.floats(0.5, 80.0),
)
@settings(max_examples=300)
def test_a_ray_is_the_inverse_of_projection_or_says_that_there_is_none(
    k1, k2, p1, p2, k3, u, v, depth_m
) -> None:
    lens = camera((k1, k2, p1, p2, k3))
    ray = lens.rays_ego(np.array([[u, v]]))
    if np.isnan(ray).any():
        # Only beyond the image of the radius at which the model turns back.
        radius = np.hypot((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)
        r2 = lens._max_radius**2
        edge = lens._max_radius * (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))
        assert np.isfinite(edge)
        assert radius > 0.9 * edge
        return
    assert ray[0, 0] == pytest.approx(1.0)  # length one along the optical axis, ego x here
    projection = lens.project(lens.ego_SE3_cam.translation + depth_m * ray)
    np.testing.assert_allclose(projection.uv, [[u, v]], atol=1e-5)
    assert projection.depth_m[0] == pytest.approx(depth_m)


def test_behind_and_at_the_camera_there_is_no_pixel() -> None:
    ahead_m = np.array([-10.0, -0.01, 0.0, MIN_DEPTH_M - 1e-6, MIN_DEPTH_M + 1e-6, 5.0])
    points_ego = FORWARD.translation + ahead_m[:, None] * [1.0, 0.0, 0.0]
    projection = camera().project(points_ego)
    assert projection.is_valid.tolist() == [False, False, False, False, True, True]
    assert np.isnan(projection.uv[:4]).all()
    np.testing.assert_allclose(projection.depth_m, ahead_m, atol=1e-12)


def test_points_beyond_the_lens_model_do_not_fold_into_the_image() -> None:
    lens = camera(FOLDING)
    # r (1 - 0.3 r^2) grows up to r = 1 / sqrt(0.9); from there the polynomial comes back.
    edge = 1.0 / np.sqrt(0.9)
    tangent = np.array([0.99 * edge, 1.01 * edge, 1.6, 1.82])
    folded_px = lens.cx + lens.fx * tangent * (1 - 0.3 * tangent**2)
    assert 0 < folded_px[3] < 1600, "the case must be one that folds into the image"
    points_ego = np.column_stack(
        [np.full(4, 11.5), 0.2 - 10.0 * tangent, np.full(4, FORWARD.translation[2])]
    )
    projection = lens.project(points_ego)
    np.testing.assert_array_equal(np.isfinite(projection.uv[:, 0]), [True, False, False, False])
    assert not projection.is_valid[1:].any()
    assert np.isnan(lens.rays_ego(np.array([[lens.cx + 0.8 * lens.fx, lens.cy]]))).all()


def test_nan_and_infinite_points_are_invalid_rows() -> None:
    good = [11.5, 0.2, 1.6]
    points_ego = np.array(
        [good, [np.nan, 0, 0], [np.inf, 0, 0], [5, -np.inf, 0], [1e300, 1e300, 0]]
    )
    for lens in (camera(), camera(BARREL)):
        assert lens.project(points_ego).is_valid.tolist() == [True, False, False, False, False]


def test_no_points_and_no_pixels() -> None:
    projection = camera(BARREL).project(np.zeros((0, 3)))
    assert projection.uv.shape == (0, 2)
    assert projection.is_valid.shape == (0,)
    assert camera(BARREL).rays_ego(np.zeros((0, 2))).shape == (0, 3)


def test_the_image_ends_half_a_pixel_beyond_the_outer_centres() -> None:
    lens = PinholeCamera("c", 10, 6, 100.0, 100.0, 4.5, 2.5, SE3.identity())
    u = np.array([-0.51, -0.49, 9.49, 9.51])
    points_cam = np.column_stack([(u - 4.5) / 100, np.zeros(4), np.ones(4)])
    assert lens.project(points_cam).is_valid.tolist() == [False, True, True, False]


@given(st.integers(1, 4000), st.integers(1, 4000))
def test_scaling_moves_a_pixel_with_the_image(width: int, height: int) -> None:
    lens = camera(BARREL)
    small = lens.scaled(width, height)
    points_ego = random_points_ego(20)
    full, scaled = lens.project(points_ego).uv, small.project(points_ego).uv
    # Shares of the image, measured from its outer edge, stay the same.
    np.testing.assert_allclose((scaled + 0.5) / (width, height), (full + 0.5) / (1600, 900))
    assert (small.width_px, small.height_px) == (width, height)
    assert small.distortion == lens.distortion


def test_halving_an_image_averages_pixel_pairs() -> None:
    """The centre of the first half-size pixel lies between the first two full-size ones."""
    lens = PinholeCamera("c", 8, 8, 100.0, 100.0, 0.5, 0.5, SE3.identity())
    half = lens.scaled(4, 4)
    assert (half.cx, half.cy) == (0.0, 0.0)
    assert half.fx == 50.0


def test_matrix_is_opencvs() -> None:
    np.testing.assert_array_equal(
        camera().matrix, [[1266.4, 0, 816.3], [0, 1260.1, 491.5], [0, 0, 1]]
    )
    assert camera(BARREL).is_distorted
    assert not camera().is_distorted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0.0}, "must be positive"),
        ({"fy": -1.0}, "must be positive"),
        ({"width_px": 0}, "must be positive"),
        ({"cx": np.nan}, "must be finite"),
        ({"distortion": (0.1, 0.2, 0.0, 0.0)}, "five distortion coefficients"),
        ({"distortion": (0.1, 0.2, 0.0, 0.0, np.inf)}, "must be finite"),
        ({"distortion": (0.1, 0.2, 0.0, 0.0, 1e308)}, "those of no camera"),
        ({"distortion": (0.1, 0.2, 0.0, 0.0, -1e9)}, "those of no camera"),
        ({"fx": 1e300}, "those of no camera"),
        ({"cy": -1e7}, "those of no camera"),
        ({"height_px": 10**30}, "those of no camera"),
    ],
)
def test_an_unusable_calibration_is_refused_with_the_cameras_name(change, message: str) -> None:
    values = {
        "name": "CAM_BACK",
        "width_px": 1600,
        "height_px": 900,
        "fx": 800.0,
        "fy": 800.0,
        "cx": 800.0,
        "cy": 450.0,
        "ego_SE3_cam": FORWARD,
    }
    with pytest.raises(CalibrationError, match=f"CAM_BACK.*{message}"):
        PinholeCamera(**(values | change))


def test_pixels_and_points_of_another_shape_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"\(N, 2\), found \(4, 3\)"):
        camera().rays_ego(np.zeros((4, 3)))
    with pytest.raises(ShapeError, match=r"\(N, 3\), found \(4, 2\)"):
        camera().project(np.zeros((4, 2)))
