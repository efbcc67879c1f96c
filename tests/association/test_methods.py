import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.lookup import (
    cell_centres_around,
    labels_at,
    project_city,
    speaks_of_ground,
)
from hdmap_tools.association.planar import associate_planar, ground_plane
from hdmap_tools.association.sparse import associate_sparse
from hdmap_tools.association.surface import associate_surface
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.grid import cells_of
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import Label, LabelSet, load_label_set
from hdmap_tools.testing.street import Street, camera, distance_to_edge, flat, slope, stripes

ADAS = load_label_set("adas-0001")
MARK = 3
CONFIG = AssociationConfig()
BOX = (12.0, -1.5, 16.0, 1.5, 1.4)


def observe(
    street,
    *,
    pose=None,
    sweep_pose=None,
    method="sparse",
    config=CONFIG,
    cam=None,
    label_set=ADAS,
    **lidar,
):
    pose = pose or SE3.identity()
    sweep_pose = sweep_pose or pose
    cam = cam or camera()
    labels = street.label_image(cam, pose)
    grounded = GroundedSweep.from_sweep(street.sweep(sweep_pose, **lidar), sweep_pose, 60.0, 0.1)
    if method == "sparse":
        return associate_sparse(labels, label_set, cam, pose, grounded, config)
    if method == "surface":
        return associate_surface(labels, label_set, cam, pose, grounded, 0.2, config)
    plane = ground_plane(grounded)
    return associate_planar(labels, label_set, cam, pose, plane, sweep_pose, 0.2, config)


def agreement(observations, margin_m=0.08):
    """Share of labels that are right, away from the edges of labels."""
    x, y = observations.points_city[:, 0], observations.points_city[:, 1]
    clear = distance_to_edge(y) > margin_m
    return (observations.labels == stripes(x, y))[clear].mean()


@pytest.mark.parametrize("method", ["sparse", "surface", "planar"])
def test_labels_land_where_they_are_on_flat_ground(method):
    seen = observe(Street(flat, stripes), method=method)
    near = seen.points_city[:, 0] < 20.0
    assert near.sum() > 500
    assert {1, 3} <= set(seen.labels[near].tolist())
    assert agreement(seen) > 0.97
    np.testing.assert_allclose(seen.points_city[near, 2], 0.0, atol=0.03)


@pytest.mark.parametrize("method", ["sparse", "surface"])
def test_labels_land_where_they_are_on_a_slope(method):
    seen = observe(Street(slope, stripes), method=method)
    assert agreement(seen, margin_m=0.15) > 0.97
    x, y, z = seen.points_city.T
    assert np.sqrt(np.mean((z - slope(x, y)) ** 2)) < 0.03


def test_the_planar_method_fails_on_a_slope_where_the_surface_does_not():
    # A stripe across the road every 4 m: a wrong height moves it along the view.
    across = Street(slope, lambda x, y: np.where(np.mod(x, 4.0) < 2.0, 3, 1))

    def right(method):
        seen = observe(across, method=method)
        x = seen.points_city[:, 0]
        use = (
            (x > 12.0) & (np.abs(seen.points_city[:, 1]) < 5) & (np.abs(np.mod(x, 2.0) - 1.0) < 0.8)
        )
        return (seen.labels == np.where(np.mod(x, 4.0) < 2.0, 3, 1))[use].mean()

    assert right("surface") > 0.9
    assert right("planar") < 0.75


@pytest.mark.parametrize("method", ["sparse", "surface", "planar"])
def test_the_pose_of_the_image_and_of_the_sweep_each_count(method):
    # 15 m/s and turning: 50 ms between sweep and image are 0.75 m and 3 degrees.
    image_pose = SE3.from_yaw(0.05, (0.75, 0.02, 0.0))
    seen = observe(Street(flat, stripes), pose=image_pose, sweep_pose=SE3.identity(), method=method)
    assert agreement(seen) > 0.97


@pytest.mark.parametrize("method", ["sparse", "surface"])
def test_nothing_is_labelled_behind_an_obstacle(method):
    # A lidar 2.6 m up looks over a box 1.4 m high and meets the ground 33 m ahead; to the
    # camera, 1.5 m up, that ground is hidden.
    def labelled_behind(occlusion_test):
        config = AssociationConfig(
            occlusion_test=occlusion_test, lookup_range_m=45.0, max_range_m=45.0
        )
        seen = observe(Street(flat, stripes, BOX), method=method, config=config, lidar_height_m=2.6)
        x, y = seen.points_city[:, 0], seen.points_city[:, 1]
        return ((x > 17.0) & (np.abs(y - 0.1) < 0.8 * x / 10.0)).sum()

    assert labelled_behind(occlusion_test=False) > 5
    assert labelled_behind(occlusion_test=True) == 0


def test_the_ground_beside_an_obstacle_stays():
    with_box = observe(Street(flat, stripes, BOX))
    without = observe(Street(flat, stripes))
    beside = [
        ((o.points_city[:, 0] > 10) & (o.points_city[:, 0] < 20) & (o.points_city[:, 1] > 4)).sum()
        for o in (with_box, without)
    ]
    assert beside[0] > 0.9 * beside[1] > 0


def test_a_camera_with_distortion_sees_the_same_street():
    cam = camera(distortion=(-0.3, 0.09, 0.001, -0.0005, -0.01))
    assert agreement(observe(Street(flat, stripes), cam=cam)) > 0.97


def test_the_range_is_kept():
    near = observe(Street(flat, stripes), config=AssociationConfig(max_range_m=10.0))
    assert np.linalg.norm(near.points_city[:, :2], axis=1).max() <= 10.0
    cells = observe(
        Street(flat, stripes), method="planar", config=AssociationConfig(lookup_range_m=12.0)
    )
    assert np.linalg.norm(cells.points_city[:, :2] - (1.7, 0.1), axis=1).max() <= 12.0


@pytest.mark.parametrize("method", ["surface", "planar"])
def test_each_cell_is_asked_once_at_its_centre(method):
    pose = SE3.from_yaw(2.4, (-31.07, 12.53, 0.0))
    seen = observe(Street(flat, stripes), pose=pose, method=method)
    cells = cells_of(seen.points_city, 0.2)
    assert len(np.unique(cells, axis=0)) == len(cells)
    np.testing.assert_allclose((cells + 0.5) * 0.2, seen.points_city[:, :2], atol=1e-9)


def test_moving_objects_and_ignored_pixels_say_nothing_of_the_ground():
    labels = LabelSet(
        name="t",
        labels=(
            Label(id=0, name="road", color=(0, 0, 0), map_class="road"),
            Label(id=1, name="car", color=(0, 0, 0), moves=True),
        ),
    )
    speaks = speaks_of_ground(np.array([0, 1, 255, 0], dtype=np.uint8), labels)
    assert speaks.tolist() == [True, False, False, True]


def test_planar_without_a_sweep_takes_the_ego_frames_ground():
    assert ground_plane(None) == (0.0, 0.0, 0.0)


def test_no_ground_points_give_no_observations():
    street = Street(lambda x, y: np.full(np.broadcast(x, y).shape, -40.0), stripes)
    seen = observe(street)
    assert len(seen) == 0
    assert len(observe(street, method="surface")) == 0


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.3, 0.09, 0.001, -0.0005, -0.01)])
def test_no_cell_in_the_image_is_left_out(yaw, distortion):
    cam, pose = camera(distortion=distortion), SE3.from_yaw(yaw, (7.0, -3.0, 0.2))
    centres = cell_centres_around(cam, pose, 0.5, 20.0)
    eye = pose.transform_from(cam.ego_SE3_cam.translation[None])[0, :2]
    lattice = np.stack(np.meshgrid(np.arange(-60, 80), np.arange(-80, 60)), -1).reshape(-1, 2)
    every = (lattice + 0.5) * 0.5
    every = every[np.linalg.norm(every - eye, axis=1) <= 20.0]
    for height in (-1.0, 0.2, 1.2):
        points = np.column_stack([every, np.full(len(every), height)])
        seen = every[project_city(points, cam, pose).is_valid]
        assert len(seen) > 200
        assert set(map(tuple, seen)) <= set(map(tuple, centres))
    # About the share of the circle that 70 degrees of view take.
    assert len(centres) < 0.5 * len(every)


def test_the_surface_carries_intensity_where_a_return_measured_it():
    seen = observe(Street(flat, stripes), method="surface")
    assert seen.has_intensity is not None
    share = seen.has_intensity.mean()
    assert 0.005 < share < 0.5  # rings, and nothing between them
    x, y = seen.points_city[:, 0], seen.points_city[:, 1]
    clear = seen.has_intensity & (distance_to_edge(y) > 0.15)
    expected = np.where(stripes(x, y) == 3, 90, 20)
    assert clear.sum() > 50
    assert (seen.intensity == expected)[clear].all()


@pytest.mark.parametrize("method", ["sparse", "surface", "planar"])
def test_ground_beside_the_vehicle_is_not_used(method):
    seen = observe(Street(flat, stripes), method=method, config=AssociationConfig(min_range_m=7.0))
    distance = np.linalg.norm(seen.points_city[:, :2] - (1.7, 0.1), axis=1)
    assert 7.0 <= distance.min() < 8.5


@pytest.mark.parametrize("method", ["sparse", "surface", "planar"])
def test_a_tilted_vehicle_sees_the_same_street(method):
    # Braking: 1.5 degrees of pitch and 1 of roll, and half a degree more 50 ms later.
    def tilted(pitch_deg, roll_deg, x):
        turn = Rotation.from_euler("yx", [pitch_deg, roll_deg], degrees=True).as_matrix()
        return SE3(turn, np.array([x, 0.0, 0.0]))

    seen = observe(
        Street(flat, stripes),
        pose=tilted(2.0, 1.0, 0.6),
        sweep_pose=tilted(1.5, 1.0, 0.0),
        method=method,
    )
    assert len(seen) > 400
    assert agreement(seen) > 0.97
    assert np.abs(np.median(seen.points_city[:, 2])) < 0.02
    assert np.sqrt(np.mean(seen.points_city[:, 2] ** 2)) < 0.04


@pytest.mark.parametrize("method", ["sparse", "surface", "planar"])
def test_moving_objects_leave_no_votes(method):
    # The street's marks become moving objects.
    labels = tuple(label.model_copy(update={"moves": label.id == MARK}) for label in ADAS.labels)
    moving = ADAS.model_copy(update={"labels": labels})
    seen = observe(Street(flat, stripes), method=method, label_set=moving)
    assert len(seen) > 300
    assert MARK not in seen.labels


def test_the_nearest_pixel_is_looked_up():
    image = np.zeros((3, 4), dtype=np.uint8)
    image[1, 2] = 7
    assert labels_at(image, np.array([[1.6, 0.6], [2.4, 1.4], [1.4, 1.0]])).tolist() == [7, 7, 0]


def test_something_close_behind_a_wall_is_hidden_and_something_before_it_is_not():
    # Ground from 1 m behind the wall's back on is hidden; before the wall all is seen.
    wall = (15.0, -6.0, 15.3, 6.0, 2.5)
    for rings in (16, 32, 64):
        street = Street(flat, stripes, wall)
        seen = observe(street, method="surface", rings=rings)
        x, y = seen.points_city[:, 0], seen.points_city[:, 1]
        central = np.abs(y) < 4.0
        assert ((x < 14.0) & central).sum() > 200
        assert not ((x > 16.5) & central & (np.abs(y) < 0.3 * x)).any(), rings
