"""Dense association: the prebuilt point map, clipped around the vehicle, put into the image.

The paper's method: points up to 15 m ahead of and 10 m to either side of the vehicle
at the image's own pose take the label of the pixel that they meet. Beyond the paper,
points that something nearer hides are left out: what stands in the map, and what
stood in the live sweep, for a vehicle that moves hides ground too and is not in the
map.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.association.lookup import (
    labels_at,
    project_city,
    speaks_of_ground,
)
from hdmap_tools.association.observations import Observations
from hdmap_tools.association.visibility import is_unoccluded
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.camera import PinholeCamera, Projection
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.point_map.values import MapPoints
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat


def clip_bounds_m(
    city_SE3_ego: SE3, config: AssociationConfig
) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1), city metres, of what lies in the clip at an ego pose."""
    ahead, across = config.clip_ahead_m, config.clip_across_m
    corners = np.array([[x, y, 0.0] for x in (0.0, ahead) for y in (-across, across)])
    corners = city_SE3_ego.transform_from(corners)[:, :2]
    low, high = corners.min(axis=0), corners.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def associate_dense(
    label_image: NDArrayByte,
    label_set: LabelSet,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    points: MapPoints,
    config: AssociationConfig,
    standing_city: NDArrayFloat | None = None,
    ring_gap_deg: float = 2.1,
) -> Observations:
    """Label the ground points of a point map that a camera sees.

    Args:
        label_image: (height, width) uint8 ids, the camera's size.
        label_set: What the ids mean.
        camera: Calibrated camera.
        city_SE3_ego: Ego pose at the image's own time.
        points: Points of the map, at least those within `clip_bounds_m`.
        config: Clip, `min_range_m` from the camera, occlusion test.
        standing_city: (M, 3) returns of the live sweep that are not ground, city
            metres; None without a sweep.
        ring_gap_deg: Angle between that sweep's rings, degrees.
    """
    ego_SE3_city = city_SE3_ego.inverse()
    points_ego = ego_SE3_city.transform_from(points.points_city)
    clip = (points_ego[:, 0] > 0.0) & (points_ego[:, 0] <= config.clip_ahead_m)
    clip &= np.abs(points_ego[:, 1]) <= config.clip_across_m
    from_camera = points_ego[:, :2] - camera.ego_SE3_cam.translation[:2]
    use = clip & points.is_ground
    use &= (from_camera**2).sum(axis=1) >= config.min_range_m**2
    at = np.flatnonzero(use)
    projection = camera.project(points_ego[at])
    seen = projection.is_valid
    if config.occlusion_test:
        in_map = camera.project(points_ego[clip & ~points.is_ground])
        seen = _unoccluded(projection, in_map, camera, _MAP_GAP_DEG, _MAP_GAP_DEG)
        if standing_city is not None and len(standing_city):
            live = project_city(standing_city, camera, city_SE3_ego)
            seen &= _unoccluded(projection, live, camera, 0.4, ring_gap_deg)
    labels = labels_at(label_image, projection.uv[seen])
    speaks = speaks_of_ground(labels, label_set)
    at = at[seen][speaks]
    return Observations(points.points_city[at], labels[speaks], points.intensity[at])


_MAP_GAP_DEG: Final = 0.4
"""Angle that a point of the map covers: 10 cm at 15 m."""


def _unoccluded(
    ground: Projection,
    occluders: Projection,
    camera: PinholeCamera,
    gap_h_deg: float,
    gap_v_deg: float,
) -> NDArrayBool:
    both = Projection(
        np.concatenate([ground.uv, occluders.uv]),
        np.concatenate([ground.depth_m, occluders.depth_m]),
        np.concatenate([ground.is_valid, occluders.is_valid]),
    )
    count = len(ground.depth_m)
    is_occluder = np.arange(len(both.depth_m)) >= count
    return is_unoccluded(both, is_occluder, camera, gap_h_deg=gap_h_deg, gap_v_deg=gap_v_deg)[
        :count
    ]
