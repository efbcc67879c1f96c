import numpy as np
import pytest
from shapely.geometry import LineString, Polygon, box

from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.map_model.elements import Crosswalk, LaneMark, MarkStyle, RoadBoundary
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.testing.scenes import window_from_posterior, window_from_shapes
from hdmap_tools.view.image_overlay import NEAR_PLANE_M, project_line, project_window_into_image
from hdmap_tools.view.palette import CLASS_COLORS, stroke_of

# Looks ahead along the ego x axis, 1.5 m above the ground.
AHEAD = SE3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.0, 0.0, 1.5]))
CAMERA = PinholeCamera("front", 320, 200, 200.0, 200.0, 159.5, 79.5, AHEAD)
LENS = PinholeCamera(
    "lens", 320, 200, 200.0, 200.0, 159.5, 79.5, AHEAD, (-0.3, 0.1, 0.001, -0.001, 0.0)
)
GRAY = np.full((200, 320, 3), 90, dtype=np.uint8)
GRID = BevGrid.from_bounds((0.0, -15.0, 40.0, 15.0), 0.25)
# Road left, pavement right, a crosswalk 10 to 12 m ahead of the camera.
SHAPES = {
    "road": box(0, 0, 40, 15),
    "sidewalk": box(0, -15, 40, 0),
    "crosswalk": box(11, -15, 13, 15),
}


def class_at(picture: np.ndarray, uv: np.ndarray) -> str:
    colors = {name: np.array(color, dtype=float) for name, color in CLASS_COLORS.items()}
    pixel = picture[round(uv[1]), round(uv[0])].astype(float)
    return min(colors, key=lambda name: np.abs(colors[name] - pixel).max())


def shifted(window: MapWindow, height_m: float) -> MapWindow:
    posterior = window.dataset["posterior"].values
    return window_from_posterior(
        posterior, window.grid, height=np.full(window.grid.shape, height_m)
    )


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("ground_m", [0.0, 0.4])
@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_cells_are_painted_where_the_camera_sees_them(
    camera: PinholeCamera, ground_m: float, yaw: float
) -> None:
    window = shifted(window_from_shapes(SHAPES, GRID, accuracy=0.99), ground_m)
    pose = SE3.from_yaw(yaw, (2.0, 0.5, 0.2))
    picture = project_window_into_image(window, None, camera, pose, GRAY, opacity=1.0)
    points = np.array(
        [(8.0, 2.0), (8.0, -1.0), (12.0, 2.0), (12.0, -1.0), (16.0, 3.0), (10.7, 1.0), (13.4, 1.0)]
    )
    names = ["road", "sidewalk", "crosswalk", "crosswalk", "road", "road", "road"]
    at_ground = np.column_stack([points, np.full(len(points), ground_m)])
    projection = camera.project(pose.inverse().transform_from(at_ground))
    seen = projection.is_valid.nonzero()[0]
    assert len(seen) >= 5
    assert [class_at(picture, projection.uv[k]) for k in seen] == [names[k] for k in seen]


def test_only_known_ground_within_range_is_painted() -> None:
    window = window_from_shapes(SHAPES, GRID, unknown=box(0, 0, 40, 15))
    picture = project_window_into_image(
        window, None, CAMERA, SE3.identity(), GRAY, max_range_m=15.0
    )
    changed = (picture != GRAY).any(axis=2)
    assert not changed[:81].any()  # the horizon is at row 79.5
    assert not changed[:, :159].any()  # the left side is unknown
    # 15 m from the camera and 1.5 m below it: 20 rows below the horizon.
    assert not changed[:99].any()
    assert changed[101, 161:225].all()
    assert (GRAY == 90).all()


def test_ground_above_the_camera_and_an_unknown_map_change_nothing() -> None:
    hidden = window_from_shapes({}, GRID, unknown=box(-1, -20, 50, 20))
    above = shifted(window_from_shapes(SHAPES, GRID), 3.0)
    for window in (hidden, above):
        picture = project_window_into_image(window, None, CAMERA, SE3.identity(), GRAY)
        np.testing.assert_array_equal(picture, GRAY)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_lines_pass_through_the_projection_of_their_points(camera: PinholeCamera) -> None:
    mark = LaneMark(geometry=LineString([(5, 1, 0.1), (30, 2, 0.1)]), style=MarkStyle.SOLID)
    vector_map = VectorMap(GRID.frame, with_stable_ids([mark]))
    pose = SE3.from_yaw(0.05, (-1.0, 0.0, 0.0))
    picture = project_window_into_image(
        None, vector_map, camera, pose, GRAY, line_width_px=1.0
    ).astype(float)
    share = np.abs(picture - 90).sum(axis=2)
    for x in (7.0, 10.0, 14.0):
        point = np.array([[x, 1 + (x - 5) / 25, 0.1]])
        u, v = camera.project(pose.inverse().transform_from(point)).uv[0]
        row = round(v)
        near = np.arange(int(u) - 6, int(u) + 8)
        weights = share[row, near]
        slope = camera.project(pose.inverse().transform_from(point + [[0.5, 0.02, 0]])).uv[0]
        expected = u + (row - v) * (slope[0] - u) / (slope[1] - v)
        assert weights.max() > 100
        assert (weights * near).sum() / weights.sum() == pytest.approx(expected, abs=0.3)
    assert stroke_of(mark).name == "lane mark, solid"


def test_lines_are_cut_at_the_near_plane_not_folded_over() -> None:
    # Passes under the camera, from far behind to far ahead, one metre to the left.
    ahead = project_line(np.array([(-30.0, 1.0, 0.0), (30.0, 1.0, 0.0)]), CAMERA)
    assert len(ahead) == 1
    uv = ahead[0]
    depth = 200.0 * 1.5 / (uv[:, 1] - 80.0)  # from v - cy = f * height / depth
    assert depth.min() == pytest.approx(NEAR_PLANE_M, rel=1e-3)
    assert (np.diff(depth) > 0).all()
    np.testing.assert_allclose(uv[:, 0] - 160.0, -200.0 / depth, rtol=1e-6)
    # There and back again: two pieces ahead, none behind.
    loop = np.array([(10.0, 1.0, 0.0), (-10.0, 1.0, 0.0), (-10.0, 3.0, 0.0), (10.0, 3.0, 0.0)])
    assert len(project_line(loop, CAMERA)) == 2
    assert project_line(np.array([(-30.0, 1.0, 0.0), (-3.0, 1.0, 0.0)]), CAMERA) == []
    assert project_line(np.array([(10.0, 1.0, 0.0)]), CAMERA) == []
    assert project_line(np.array([(50.0, 1.0, 0.0), (60.0, 1.0, 0.0)]), CAMERA) == []


def test_corners_of_lines_stay_corners() -> None:
    corner = np.array([(8.0, 0.0, 0.0), (10.13, 0.0, 0.0), (10.13, 2.0, 0.0)])
    (uv,) = project_line(corner, CAMERA)
    expected = CAMERA.project(corner).uv + 0.5
    for point in expected:
        assert np.abs(uv - point).max(axis=1).min() < 1e-9


def test_lines_outside_the_lens_model_are_left_out() -> None:
    # With this lens the image folds back beyond about 47 degrees.
    fisheye = PinholeCamera(
        "lens", 320, 200, 200.0, 200.0, 159.5, 79.5, AHEAD, (-0.3, 0.0, 0.0, 0.0, 0.0)
    )
    for piece in project_line(np.array([(2.0, -20.0, 0.0), (2.0, 20.0, 0.0)]), fisheye):
        back = fisheye.rays_ego(piece - 0.5)
        assert (np.abs(back[:, 1] / back[:, 0]) < 1.1).all()


def test_polygons_and_boundaries_are_drawn_too() -> None:
    elements = [
        Crosswalk(geometry=Polygon([(8, -2, 0), (10, -2, 0), (10, 2, 0), (8, 2, 0)])),
        RoadBoundary(geometry=LineString([(4, 3, 0), (30, 3, 0)])),
    ]
    vector_map = VectorMap(GRID.frame, with_stable_ids(elements))
    picture = project_window_into_image(None, vector_map, CAMERA, SE3.identity(), GRAY)
    u, v = np.round(CAMERA.project(np.array([[8.0, 0.0, 0.0]])).uv[0]).astype(int)
    assert (picture[v, u] != 90).any()


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"camera\.scaled"):
        project_window_into_image(
            None, None, CAMERA, SE3.identity(), np.zeros((100, 160, 3), dtype=np.uint8)
        )
