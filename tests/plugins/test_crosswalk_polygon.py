"""Crosswalks of scenes whose truth is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import Point, Polygon, box

from hdmap_plugins.crosswalk_polygon import CrosswalkPolygon, CrosswalkPolygonOptions
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import Crosswalk, MapWindow, VectorMap
from hdmap_tools.testing.scenes import window_from_posterior, window_from_shapes

GROUND = box(-100, -100, 200, 200)
RESOLUTIONS = [0.1, 0.2]


def crosswalks(window: MapWindow, **options: object) -> list[Crosswalk]:
    found = CrosswalkPolygon().vectorize(
        window,
        VectorMap(window.frame),
        CrosswalkPolygonOptions(**options),
        rng=np.random.default_rng(0),
    )
    assert all(isinstance(c, Crosswalk) for c in found)
    bounds = box(*window.grid.bounds_m).buffer(1e-6)
    assert all(bounds.contains(c.geometry) for c in found)
    return found


def scene(bounds, resolution_m: float, areas: dict[str, shapely.Geometry], **extra: object):
    grid = BevGrid.from_bounds(bounds, resolution_m)
    return window_from_shapes({"road": GROUND, **areas}, grid, **extra)


def iou(found: Crosswalk, truth: Polygon) -> float:
    flat = shapely.force_2d(found.geometry)
    return flat.intersection(truth).area / flat.union(truth).area


def vertex_error(found: Crosswalk, truth: Polygon) -> float:
    """Largest distance between corresponding corners, both ways, metres."""
    return float(
        shapely.hausdorff_distance(
            shapely.MultiPoint(shapely.get_coordinates(found.geometry)),
            shapely.MultiPoint(shapely.get_coordinates(truth)),
        )
    )


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
@pytest.mark.parametrize("angle_deg", [0, 23, 45, 90, 160])
def test_solid_area_is_its_rectangle(resolution_m, angle_deg):
    truth = affinity.rotate(box(6.03, 8.02, 14.06, 11.05), angle_deg, origin=(10, 10))
    (found,) = crosswalks(scene((0, 0, 20, 20), resolution_m, {"crosswalk": truth}))
    assert len(found.geometry.exterior.coords) == 5
    assert found.geometry.exterior.is_ccw
    assert vertex_error(found, truth) <= 0.35 * resolution_m
    assert iou(found, truth) >= 0.97
    assert found.confidence == pytest.approx(0.93, abs=0.04)
    # A sharp edge is known to 0.4 cells at best, and blurred by the cells to somewhat more.
    assert 0.39 * resolution_m <= found.sigma_m <= 1.0 * resolution_m
    assert found.num_observations == 10


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
@pytest.mark.parametrize("angle_deg", [0, 23, 45, 90])
@pytest.mark.parametrize("between", ["road", "lane_mark"])
def test_stripes_are_one_crosswalk(resolution_m, angle_deg, between):
    truth = affinity.rotate(box(4.03, 5.02, 11.53, 8.52), angle_deg, origin=(8, 7))
    stripes = affinity.rotate(
        shapely.union_all([box(4.03 + k, 5.02, 4.53 + k, 8.52) for k in range(8)]),
        angle_deg,
        origin=(8, 7),
    )
    areas = {between: truth, "crosswalk": stripes}
    (found,) = crosswalks(scene((0, 0, 16, 14), resolution_m, {**areas}))
    assert len(found.geometry.exterior.coords) == 5
    assert vertex_error(found, truth) <= resolution_m
    assert iou(found, truth) >= 0.9


@pytest.mark.parametrize("resolution_m", RESOLUTIONS)
def test_two_crosswalks_stay_two(resolution_m):
    truth = [box(2, 2, 8, 5), box(10, 4, 13, 11)]
    found = crosswalks(scene((0, 0, 15, 13), resolution_m, {"crosswalk": shapely.union_all(truth)}))
    assert len(found) == 2
    for area in truth:
        assert max(iou(c, area) for c in found) >= 0.97


def test_other_shapes_keep_their_outline_the_right_way_round():
    """An L must come out neither mirrored nor moved by half a cell."""
    truth = Polygon(
        [(2.05, 2.05), (12.05, 2.05), (12.05, 5.05), (5.05, 5.05), (5.05, 10.05), (2.05, 10.05)]
    )
    # Closing gaps would round the inner corner.
    (found,) = crosswalks(scene((0, 0, 16, 12), 0.1, {"crosswalk": truth}), gap_m=0.0)
    assert len(found.geometry.exterior.coords) > 5
    assert iou(found, truth) >= 0.97
    centre, true = found.geometry.centroid, truth.centroid
    assert abs(centre.x - true.x) <= 0.02
    assert abs(centre.y - true.y) <= 0.02
    assert (
        shapely.hausdorff_distance(shapely.force_2d(found.geometry).exterior, truth.exterior) <= 0.1
    )


def test_specks_and_noise():
    truth = box(4, 4, 12, 7)
    specks = shapely.union_all([Point(x, 12).buffer(0.4) for x in (2, 6, 10)])
    for seed in range(3):
        window = scene(
            (0, 0, 16, 14),
            0.2,
            {"crosswalk": truth.union(specks)},
            noise=0.7,
            rng=np.random.default_rng(seed),
        )
        (found,) = crosswalks(window)
        assert iou(found, truth) >= 0.95


def test_what_is_unknown_is_not_drawn():
    truth = box(4, 4, 12, 7)
    (found,) = crosswalks(
        scene((0, 0, 16, 12), 0.1, {"crosswalk": truth}, unknown=box(9, 0, 16, 12))
    )
    assert iou(found, box(4, 4, 9, 7)) >= 0.97
    # Rings of a lidar leave stripes that are not known.
    rings = shapely.union_all([box(x, 0, x + 0.2, 12) for x in np.arange(0, 16, 0.8)])
    (striped,) = crosswalks(scene((0, 0, 16, 12), 0.1, {"crosswalk": truth}, unknown=rings))
    assert iou(striped, truth) >= 0.95


def test_height_is_the_plane_of_the_ground():
    window = scene((0, 0, 16, 12), 0.1, {"crosswalk": box(4, 4, 12, 7)})
    x, y = np.meshgrid(window.grid.x_centres_m, window.grid.y_centres_m)
    height = 3.0 + 0.05 * x - 0.02 * y
    height[::3] = np.nan
    height[50:53, 60:66] += 4.0  # a vehicle that was not taken out
    posterior = window.dataset["posterior"].values
    (found,) = crosswalks(
        window_from_posterior(posterior, window.grid, height=height.astype(np.float32))
    )
    xyz = shapely.get_coordinates(found.geometry, include_z=True)
    np.testing.assert_allclose(xyz[:, 2], 3.0 + 0.05 * xyz[:, 0] - 0.02 * xyz[:, 1], atol=0.02)

    nothing = np.full(window.grid.shape, np.nan, dtype=np.float32)
    (flat,) = crosswalks(window_from_posterior(posterior, window.grid, height=nothing))
    assert set(shapely.get_coordinates(flat.geometry, include_z=True)[:, 2]) == {0.0}


def test_nothing_comes_of_nothing():
    assert crosswalks(scene((0, 0, 10, 10), 0.2, {})) == []
    assert crosswalks(scene((0, 0, 10, 10), 0.2, {"crosswalk": GROUND}, unknown=GROUND)) == []


def test_a_window_of_one_class_is_its_own_outline():
    (found,) = crosswalks(scene((0, 0, 10, 6), 0.2, {"crosswalk": GROUND}))
    assert iou(found, box(0, 0, 10, 6)) >= 0.99


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (1, 1), (1, 7), (2, 3), (3, 1)])
@pytest.mark.parametrize("value", [1.0, 0.5, np.nan])
def test_tiny_grids(shape, value):
    rows, cols = shape
    posterior = np.full((5, rows, cols), (1.0 - value) / 4.0, dtype=np.float32)
    posterior[1] = value
    window = window_from_posterior(posterior, BevGrid(0.2, 3, 4, 3 + cols, 4 + rows))
    for found in crosswalks(window, min_area_m2=0.0):
        assert found.geometry.area > 0


def test_same_input_same_bytes_and_whole_cells_move_exactly():
    areas = {"crosswalk": box(2, 2, 8, 5).union(Point(11, 8).buffer(2))}
    window = scene((0, 0, 16, 12), 0.2, areas, noise=0.5, rng=np.random.default_rng(7))
    first, again = crosswalks(window), crosswalks(window)
    assert len(first) == 2
    assert [c.model_dump() for c in first] == [c.model_dump() for c in again]
    assert [c.geometry.wkb for c in first] == [c.geometry.wkb for c in again]

    g = window.grid
    moved_grid = BevGrid(0.2, g.x_min + 50, g.y_min - 35, g.x_max + 50, g.y_max - 35)
    moved = crosswalks(window_from_posterior(window.dataset["posterior"].values, moved_grid))
    for a, b in zip(first, moved, strict=True):
        np.testing.assert_allclose(
            shapely.get_coordinates(b.geometry) - [10.0, -7.0],
            shapely.get_coordinates(a.geometry),
            atol=1e-9,
        )
        assert (a.confidence, a.sigma_m) == (b.confidence, b.sigma_m)


def test_blurred_edges_are_less_certain():
    sharp = scene((0, 0, 16, 12), 0.1, {"crosswalk": box(4, 4, 12, 8)})
    from scipy import ndimage

    blurred = ndimage.gaussian_filter(sharp.dataset["posterior"].values, (0, 5, 5))
    (a,) = crosswalks(sharp)
    (b,) = crosswalks(window_from_posterior(blurred, sharp.grid))
    # Blurred by 0.5 m: that is what the slope of the edge should say.
    assert b.sigma_m == pytest.approx(0.5, rel=0.15)
    assert a.sigma_m < 0.1
