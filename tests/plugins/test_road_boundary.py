"""Road boundaries of scenes whose truth is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy import ndimage
from shapely import affinity
from shapely.geometry import Point, Polygon, box

from hdmap_plugins.lane_mark_skeleton import LaneMarkSkeleton
from hdmap_plugins.road_boundary import RoadBoundaryOptions, RoadBoundaryOutline
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import BoundaryKind, MapWindow, RoadBoundary, VectorMap
from hdmap_tools.testing.scenes import street_scene, window_from_posterior, window_from_shapes

EVERYWHERE = box(-100, -100, 200, 200)
RESOLUTIONS = [0.1, 0.2]


def boundaries(window: MapWindow, **options: object) -> list[RoadBoundary]:
    found = RoadBoundaryOutline().vectorize(
        window,
        VectorMap(window.frame),
        RoadBoundaryOptions(**options),
        rng=np.random.default_rng(0),
    )
    assert all(isinstance(b, RoadBoundary) for b in found)
    bounds = box(*window.grid.bounds_m).buffer(1e-6)
    assert all(bounds.contains(b.geometry) for b in found)
    return found


def scene(road: shapely.Geometry, bounds, resolution_m: float, **extra: object) -> MapWindow:
    grid = BevGrid.from_bounds(bounds, resolution_m)
    return window_from_shapes({"sidewalk": EVERYWHERE, "road": road}, grid, **extra)


def stations(boundary: RoadBoundary) -> np.ndarray:
    return shapely.get_coordinates(boundary.geometry.segmentize(0.1))


def rms_to(boundary: RoadBoundary, truth: shapely.Geometry) -> float:
    distance = shapely.distance(shapely.points(stations(boundary)), truth)
    return float(np.sqrt(np.mean(distance**2)))


def share_on_the_right(boundary: RoadBoundary, road: shapely.Geometry) -> tuple[float, float]:
    """Share of the line with road 0.4 m to its right, and to its left."""
    xy = stations(boundary)
    middle, step = (xy[1:] + xy[:-1]) / 2, np.diff(xy, axis=0)
    right = np.column_stack([step[:, 1], -step[:, 0]])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return (
        float(shapely.contains_xy(road, *(middle + 0.4 * right).T).mean()),
        float(shapely.contains_xy(road, *(middle - 0.4 * right).T).mean()),
    )


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
@pytest.mark.parametrize("angle_deg", [0, 17, 45, 90])
def test_straight_road_has_two_edges_on_its_sides(resolution_m, angle_deg):
    quarter = resolution_m / 4
    road = affinity.rotate(box(-40, 8 + quarter, 60, 15 + 3 * quarter), angle_deg, origin=(12, 12))
    found = boundaries(scene(road, (0, 0, 24, 24), resolution_m))
    assert len(found) == 2
    for boundary in found:
        assert rms_to(boundary, road.exterior) <= 0.25 * resolution_m
        right, left = share_on_the_right(boundary, road)
        assert right == 1.0
        assert left == 0.0
        assert not boundary.is_island
        assert boundary.kind == BoundaryKind.EDGE
        assert boundary.confidence > 0.85
        assert 0.39 * resolution_m <= boundary.sigma_m <= resolution_m
        assert boundary.num_observations == 10


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_an_l_with_an_island_is_neither_mirrored_nor_moved(resolution_m):
    corner = Polygon(
        [(2.05, 2.1), (27.9, 2.1), (27.9, 9.1), (10.2, 9.1), (10.2, 24.3), (2.05, 24.3)]
    )
    hole = box(14.1, 4.2, 18.3, 5.6)
    road = corner.difference(hole)
    found = boundaries(scene(road, (0, 0, 30, 27), resolution_m))
    (island,) = [b for b in found if b.is_island]
    (outline,) = [b for b in found if not b.is_island]
    for boundary, truth in ((island, hole.exterior), (outline, corner.exterior)):
        assert boundary.geometry.is_ring
        assert rms_to(boundary, truth) <= 0.25 * resolution_m
        assert shapely.hausdorff_distance(shapely.force_2d(boundary.geometry), truth) <= (
            RoadBoundaryOptions().tolerance_m + 0.5 * resolution_m
        )
        assert share_on_the_right(boundary, road) == (1.0, 0.0)
        centre = Polygon(stations(boundary)).centroid
        assert centre.distance(Polygon(truth).centroid) <= 0.15 * resolution_m


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_curves_stay_on_their_radius_in_noise(resolution_m):
    ring = Point(0, 0).buffer(20, quad_segs=180).difference(Point(0, 0).buffer(12, quad_segs=180))
    window = scene(ring, (0, 0, 23, 23), resolution_m, noise=0.7, rng=np.random.default_rng(3))
    found = boundaries(window)
    assert len(found) == 2
    for boundary in found:
        assert rms_to(boundary, ring.boundary) <= 0.25 * resolution_m


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_no_boundary_where_the_road_meets_the_unknown(resolution_m):
    road = box(-5, 4.05, 40, 11.05)
    unknown = box(20, 0, 40, 20).union(box(8, 9, 12, 20))
    found = boundaries(scene(road, (0, 0, 30, 15), resolution_m, unknown=unknown))
    # South edge up to x = 20, north edge in two pieces around the unseen corner.
    assert sorted(round(b.geometry.length) for b in found) == [8, 8, 20]
    for boundary in found:
        assert rms_to(boundary, road.exterior) <= 0.25 * resolution_m
        assert boundary.geometry.intersection(unknown.buffer(-resolution_m)).is_empty
        assert share_on_the_right(boundary, road)[0] == 1.0


def test_road_all_around_the_unknown_has_no_boundary():
    assert boundaries(scene(EVERYWHERE, (0, 0, 20, 20), 0.2, unknown=box(8, 8, 12, 12))) == []


def test_rings_of_a_lidar_are_filled_up_to_the_option():
    road = box(-5, 4.05, 40, 11.05)
    rings = shapely.union_all([box(x, 0, x + 0.4, 20) for x in np.arange(0.4, 30, 1.6)])
    window = scene(road, (0, 0, 30, 15), 0.1, unknown=rings)
    filled = boundaries(window, fill_gap_m=0.5)
    assert len(filled) == 2
    for boundary in filled:
        assert boundary.geometry.length > 29
        assert rms_to(boundary, road.exterior) <= 0.025
    assert len(boundaries(window, fill_gap_m=0.2)) > 10


def test_specks_are_dropped():
    islands = shapely.union_all([box(x, 7, x + 0.2, 7.2) for x in (4, 8, 12)])
    patches = shapely.union_all([Point(x, 14).buffer(0.6) for x in (4, 8, 12)])
    road = box(-5, 4, 40, 11).difference(islands).union(patches)
    found = boundaries(scene(road, (0, 0, 20, 17), 0.2))
    assert len(found) == 2
    assert all(b.geometry.length == pytest.approx(19.8, abs=0.1) for b in found)


def test_a_short_piece_needs_company():
    road = box(-5, 4.05, 40, 11.05)
    # Of the north edge a short piece is seen by itself, and 7 m in six short pieces.
    seen = [(2.0, 3.4), *((10 + 1.8 * k, 11.2 + 1.8 * k) for k in range(6))]
    unknown = box(0, 9, 30, 15).difference(shapely.union_all([box(a, 9, b, 15) for a, b in seen]))
    window = scene(road, (0, 0, 30, 15), 0.1, unknown=unknown)

    def north_edge(**options):
        ends = [
            b.geometry.bounds for b in boundaries(window, **options) if b.geometry.bounds[1] > 9
        ]
        return sorted((x0, x1) for x0, _, x1, _ in ends)

    np.testing.assert_allclose(north_edge(), seen[1:], atol=0.11)
    np.testing.assert_allclose(north_edge(min_length_m=1.0), seen, atol=0.11)
    assert north_edge(min_length_m=8.0) == []
    assert len(boundaries(window, min_length_m=8.0)) == 1


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_a_doubtful_boundary_is_dropped(resolution_m):
    """Road that the map holds for 0.55 beside 0.45: the threshold runs through noise there."""
    window = scene(box(-5, 4, 40, 11), (0, 0, 30, 15), resolution_m)
    posterior = window.dataset["posterior"].values.copy()
    x, y = np.meshgrid(window.grid.x_centres_m, window.grid.y_centres_m)
    doubtful = (np.abs(x - 15) < 4) & (np.abs(y - 7.5) < 2)
    posterior[:, doubtful] = np.array([0.45, 0, 0, 0, 0.55])[:, None]
    around = (np.abs(x - 15) < 5) & (np.abs(y - 7.5) < 3) & ~doubtful
    posterior[:, around] = np.array([0.55, 0, 0, 0, 0.45])[:, None]
    window = window_from_posterior(posterior, window.grid)
    assert [b.is_island for b in boundaries(window)] == [False] * 2
    everything = boundaries(window, min_confidence=0.0)
    (island,) = [b for b in everything if b.is_island]
    assert len(everything) == 3
    assert island.confidence == pytest.approx(0.55 * 0.55, abs=0.02)


def test_confidence_is_of_the_sides_and_sigma_of_the_place():
    """That an edge is blurred makes its place less sure, not that there is one."""
    window = scene(box(-5, 4.05, 40, 11.05), (0, 0, 30, 8), 0.1)
    (sharp,) = boundaries(window)
    for blur_m in (0.1, 0.2):
        posterior = ndimage.gaussian_filter(
            window.dataset["posterior"].values, (0, blur_m / 0.1, blur_m / 0.1), mode="nearest"
        )
        (found,) = boundaries(window_from_posterior(posterior.astype(np.float32), window.grid))
        assert found.confidence == pytest.approx(sharp.confidence, abs=0.05)
        assert found.sigma_m == pytest.approx(np.hypot(blur_m, sharp.sigma_m), rel=0.1)


@pytest.mark.parametrize("seen_cells", [1, 2, 4])
def test_what_is_unknown_says_nothing_about_the_edge(seen_cells):
    """Neither that the road ends there, nor that it does not."""
    window = scene(box(-5, 4.0, 40, 11.0), (0, 0, 30, 8), 0.1)
    posterior = window.dataset["posterior"].values.copy()
    row = 40
    posterior[:, :row] = np.array([0.3, 0, 0, 0, 0.7])[:, None, None]
    (sure,) = boundaries(window_from_posterior(posterior, window.grid))
    assert sure.confidence == pytest.approx(0.95 * 0.7, abs=0.03)
    posterior[:, : row - seen_cells] = np.nan
    (hidden,) = boundaries(window_from_posterior(posterior, window.grid))
    assert hidden.confidence == pytest.approx(sure.confidence, abs=0.03)
    assert hidden.geometry.length == pytest.approx(sure.geometry.length)


def kerb_scene(step_m: float, hide: str = "") -> MapWindow:
    window = scene(box(-5, 4.05, 40, 11.05), (0, 0, 20, 8), 0.1)
    x, y = np.meshgrid(window.grid.x_centres_m, window.grid.y_centres_m)
    # A grade of 4 % along and a crown of 2.5 % across must not look like a kerb.
    height = 5.0 + 0.04 * x + 0.025 * y + np.where(y < 4.05, step_m, 0.0)
    if hide == "far":
        height[y < 4.05] = np.nan
    return window_from_posterior(
        window.dataset["posterior"].values, window.grid, height=height.astype(np.float32)
    )


@pytest.mark.parametrize(
    ("step_m", "kind"),
    [
        (0.0, BoundaryKind.EDGE),
        (0.09, BoundaryKind.KERB_LOW),
        (0.18, BoundaryKind.KERB_HIGH),
        (0.8, BoundaryKind.UNKNOWN),
    ],
)
def test_kind_follows_the_step_in_the_ground(step_m, kind):
    (found,) = boundaries(kerb_scene(step_m))
    assert found.kind == kind
    xyz = shapely.get_coordinates(found.geometry, include_z=True)
    # The line lies on the road, at the foot of the kerb.
    np.testing.assert_allclose(xyz[:, 2], 5.0 + 0.04 * xyz[:, 0] + 0.025 * 4.35, atol=0.06)


def test_kind_is_unknown_without_heights():
    assert boundaries(kerb_scene(0.18, hide="far"))[0].kind == BoundaryKind.UNKNOWN
    window = scene(box(-5, 4, 40, 11), (0, 0, 20, 15), 0.2)
    nothing = np.full(window.grid.shape, np.nan, dtype=np.float32)
    flat = window_from_posterior(window.dataset["posterior"].values, window.grid, height=nothing)
    for boundary in boundaries(flat):
        assert boundary.kind == BoundaryKind.UNKNOWN
        assert set(shapely.get_coordinates(boundary.geometry, include_z=True)[:, 2]) == {0.0}


def test_paint_and_crosswalks_are_road():
    grid = BevGrid.from_bounds((0, 0, 20, 15), 0.2)
    window = window_from_shapes(
        {
            "sidewalk": EVERYWHERE,
            "road": box(-5, 4, 40, 11),
            "crosswalk": box(8, 4, 11, 11),
            "lane_mark": box(-5, 4, 40, 4.2),
        },
        grid,
    )
    found = boundaries(window)
    assert len(found) == 2
    for boundary in found:
        assert rms_to(boundary, box(-5, 4, 40, 11).exterior) <= 0.05


def test_nothing_comes_of_nothing():
    assert boundaries(scene(Polygon(), (0, 0, 10, 10), 0.2)) == []
    assert boundaries(scene(EVERYWHERE, (0, 0, 10, 10), 0.2)) == []
    assert boundaries(scene(EVERYWHERE, (0, 0, 10, 10), 0.2, unknown=EVERYWHERE)) == []


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (1, 1), (1, 7), (2, 3), (3, 1)])
def test_tiny_grids(shape):
    rows, cols = shape
    rng = np.random.default_rng(5)
    for _ in range(20):
        posterior = rng.dirichlet(np.full(5, 0.3), shape).transpose(2, 0, 1).astype(np.float32)
        posterior[:, rng.random(shape) < 0.2] = np.nan
        window = window_from_posterior(posterior, BevGrid(0.2, 3, 4, 3 + cols, 4 + rows))
        none_dropped = dict.fromkeys(
            ("min_road_area_m2", "min_island_area_m2", "min_length_m", "min_confidence"), 0.0
        )
        for boundary in boundaries(window, **none_dropped):
            assert boundary.geometry.length > 0


def test_same_input_same_bytes_and_whole_cells_move_exactly():
    road = box(-5, 4, 40, 11).difference(Point(9, 7).buffer(1.5))
    window = scene(road, (0, 0, 20, 15), 0.2, noise=0.7, rng=np.random.default_rng(7))
    first, again = boundaries(window), boundaries(window)
    assert len(first) == 3
    assert [b.model_dump() for b in first] == [b.model_dump() for b in again]
    assert [b.geometry.wkb for b in first] == [b.geometry.wkb for b in again]

    g = window.grid
    moved_grid = BevGrid(0.2, g.x_min + 50, g.y_min - 35, g.x_max + 50, g.y_max - 35)
    moved = boundaries(window_from_posterior(window.dataset["posterior"].values, moved_grid))
    for a, b in zip(first, moved, strict=True):
        np.testing.assert_allclose(
            shapely.get_coordinates(b.geometry) - [10.0, -7.0],
            shapely.get_coordinates(a.geometry),
            atol=1e-9,
        )
        assert (a.confidence, a.sigma_m, a.kind) == (b.confidence, b.sigma_m, b.kind)


def test_no_two_vertices_are_nearer_than_lanelet2_likes():
    window = street_scene(resolution_m=0.1, noise=1.5, rng=np.random.default_rng(3))
    elements = [
        element
        for plugin in (RoadBoundaryOutline(), LaneMarkSkeleton())
        for element in plugin.vectorize(
            window, VectorMap(window.frame), plugin.Options(), rng=np.random.default_rng(0)
        )
    ]
    assert len(elements) > 8
    for element in elements:
        steps = np.linalg.norm(np.diff(np.array(element.geometry.coords)[:, :2], axis=0), axis=1)
        assert steps.min() > 0.05
