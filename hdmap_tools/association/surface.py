"""Surface association: labels laid on the ground that the sweep found.

Between the rings of a lidar lie metres without a return, but the ground there
is known all the same: it runs on from ring to ring. So every cell of the map
that the camera sees is put at the height of the ground surface and looked up,
which gives a dense map from a single frame and, unlike the planar method,
follows slope, crown and kerbs. Cells further than 4 m from ground that was
seen stay unknown.
"""

from __future__ import annotations

import numpy as np

from hdmap_tools.association.ground import GroundedSweep, GroundSurface
from hdmap_tools.association.lookup import (
    cell_centres_around,
    labels_at,
    project_city,
    speaks_of_ground,
)
from hdmap_tools.association.observations import Observations
from hdmap_tools.association.visibility import is_unoccluded
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.camera import PinholeCamera, Projection
from hdmap_tools.geometry.grid import cells_of
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat


def associate_surface(
    label_image: NDArrayByte,
    label_set: LabelSet,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    grounded: GroundedSweep,
    resolution_m: float,
    config: AssociationConfig,
) -> Observations:
    """Look up the label of each ground cell that a camera sees.

    Args:
        label_image: (height, width) uint8 ids, the camera's size.
        label_set: What the ids mean.
        camera: Calibrated camera.
        city_SE3_ego: Ego pose at the image's own time.
        grounded: The sweep, which gives the ground and what stands on it.
        resolution_m: Cell size; one look-up at the centre of each cell.
        config: `lookup_range_m` and `min_range_m` from the camera.
    """
    xy_city = cell_centres_around(
        camera, city_SE3_ego, resolution_m, config.lookup_range_m, config.min_range_m
    )
    points_city = _onto_surface(xy_city, grounded.city_SE3_ego, grounded.surface)
    projection = project_city(points_city, camera, city_SE3_ego)
    use = projection.is_valid
    if config.occlusion_test:
        standing = grounded.points_city[~grounded.is_ground]
        occluders = project_city(standing, camera, city_SE3_ego)
        both = Projection(
            np.concatenate([projection.uv, occluders.uv]),
            np.concatenate([projection.depth_m, occluders.depth_m]),
            np.concatenate([projection.is_valid, occluders.is_valid]),
        )
        is_occluder = np.arange(len(both.depth_m)) >= len(use)
        use = is_unoccluded(both, is_occluder, camera, gap_v_deg=grounded.ring_gap_deg)[: len(use)]
    labels = labels_at(label_image, projection.uv[use])
    speaks = speaks_of_ground(labels, label_set)
    points_city = points_city[use][speaks]
    intensity, has_intensity = _intensity_in_cells(points_city, grounded, resolution_m)
    return Observations(points_city, labels[speaks], intensity, has_intensity)


def _intensity_in_cells(
    points_city: NDArrayFloat, grounded: GroundedSweep, resolution_m: float
) -> tuple[NDArrayByte, NDArrayBool]:
    """Mean intensity of the sweep's ground returns in each point's cell, and where there is one."""
    returns = cells_of(grounded.points_city[grounded.is_ground], resolution_m)
    values = grounded.sweep.intensity[grounded.is_ground].astype(np.float64)
    cells, of_return = np.unique(returns, axis=0, return_inverse=True)
    if len(cells) == 0:
        return np.zeros(len(points_city), np.uint8), np.zeros(len(points_city), bool)
    number = np.bincount(of_return.reshape(-1))
    mean = np.rint(np.bincount(of_return.reshape(-1), weights=values) / number).astype(np.uint8)
    # Rows of cells as single numbers, in the same order as np.unique sorted them.
    low, span = cells.min(axis=0), np.ptp(cells, axis=0) + 1
    asked = cells_of(points_city, resolution_m) - low
    inside = ((asked >= 0) & (asked < span)).all(axis=1)
    keys = (cells - low) @ np.array([span[1], 1])
    key = np.where(inside, asked @ np.array([span[1], 1]), -1)
    at = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
    found = keys[at] == key
    return np.where(found, mean[at], 0).astype(np.uint8), np.asarray(found)


def _onto_surface(xy_city: NDArrayFloat, city_SE3_ego: SE3, surface: GroundSurface) -> NDArrayFloat:
    """City points (N, 3) on a ground surface given in the ego frame; only where it is known.

    The ego frame is nearly upright: one correction of the position moves it by the
    tilt times the height found first, and leaves the square of that.
    """
    ego_SE3_city = city_SE3_ego.inverse()
    z_city = np.full(len(xy_city), city_SE3_ego.translation[2])
    for _ in range(2):
        points_ego = ego_SE3_city.transform_from(np.column_stack([xy_city, z_city]))
        height_ego = surface.height_at(points_ego[:, :2])
        z_city = z_city + (height_ego - points_ego[:, 2]) * city_SE3_ego.rotation[2, 2]
        known = np.isfinite(z_city)
        xy_city, z_city = xy_city[known], z_city[known]
    return np.column_stack([xy_city, z_city])
