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

from hdmap_tools.association.lookup import speaks_of_ground
from hdmap_tools.association.observations import Observations
from hdmap_tools.association.visibility import CELL_PX, MARGIN_M, NEAREST_M, depth_shape, widened
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.point_map.values import MapPoints
from hdmap_tools.types import NDArrayByte, NDArrayFloat


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
    from hdmap_tools.association.dense_kernels import lay_depth, look_up, see_points

    cam_SE3_city = (city_SE3_ego @ camera.ego_SE3_cam).inverse()
    ego_SE3_city = city_SE3_ego.inverse()
    view = (cam_SE3_city.rotation, cam_SE3_city.translation, *camera.lens)
    seen = see_points(
        points.points_city,
        ego_SE3_city.rotation,
        ego_SE3_city.translation,
        (config.clip_ahead_m, config.clip_across_m, config.min_range_m),
        camera.ego_SE3_cam.translation,
        *view,
    )
    hides_from_m = np.zeros((0, 0))
    if config.occlusion_test:
        depth = np.full(depth_shape(camera), np.inf)
        lay_depth(depth, *seen, points.is_ground, CELL_PX, NEAREST_M)
        hides_from_m = widened(depth, camera, MAP_GAP_DEG, MAP_GAP_DEG) + MARGIN_M
        if standing_city is not None and len(standing_city):
            live = sweep_hides_from_m(standing_city, camera, city_SE3_ego, ring_gap_deg)
            hides_from_m = np.minimum(hides_from_m, live)
    speaks = speaks_of_ground(np.arange(256, dtype=np.uint8), label_set)
    at, labels = look_up(*seen, points.is_ground, hides_from_m, CELL_PX, label_image, speaks)
    return Observations(points.points_city[at], labels, points.intensity[at])


def sweep_hides_from_m(
    standing_city: NDArrayFloat, camera: PinholeCamera, city_SE3_ego: SE3, ring_gap_deg: float
) -> NDArrayFloat:
    """Depth from which on the returns of a live sweep hide ground, by cell of `CELL_PX`.

    Args:
        standing_city: (M, 3) returns that are not ground, city metres.
        camera: Calibrated camera.
        city_SE3_ego: Ego pose at the image's own time.
        ring_gap_deg: Angle between the sweep's rings, degrees.
    """
    from hdmap_tools.association.dense_kernels import lay_depth, see_points

    cam_SE3_city = (city_SE3_ego @ camera.ego_SE3_cam).inverse()
    ego_SE3_city = city_SE3_ego.inverse()
    live = see_points(
        standing_city,
        ego_SE3_city.rotation,
        ego_SE3_city.translation,
        (np.inf, np.inf, 0.0),
        camera.ego_SE3_cam.translation,
        cam_SE3_city.rotation,
        cam_SE3_city.translation,
        *camera.lens,
    )
    depth = np.full(depth_shape(camera), np.inf)
    lay_depth(depth, *live, np.zeros(len(standing_city), bool), CELL_PX, NEAREST_M)
    return widened(depth, camera, _SWEEP_GAP_DEG, ring_gap_deg) + MARGIN_M


MAP_GAP_DEG: Final = 0.4
"""Angle that a point of the map covers: 10 cm at 15 m."""
_SWEEP_GAP_DEG: Final = 0.4
"""Angle between a sweep's returns within a ring."""
