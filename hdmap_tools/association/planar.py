"""Planar association: labels laid on a plane through the ground (no lidar needed).

The paper's second comparison. Wrong wherever the ground is not that plane: an
error of 2 cm in height moves a label by 19 cm at 15 m (height error times
distance over camera height).
"""

from __future__ import annotations

import logging

import numpy as np

from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.lookup import (
    cell_centres_around,
    labels_at,
    project_city,
    speaks_of_ground,
)
from hdmap_tools.association.observations import Observations
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.types import NDArrayByte, NDArrayFloat

_LOG = logging.getLogger(__name__)

GroundPlane = tuple[float, float, float]
"""(a, b, c) of ``z = a x + b y + c`` in the ego frame, metres."""


def ground_plane(grounded: GroundedSweep | None) -> GroundPlane:
    """The plane through the ground near the vehicle; z = 0 of the ego frame without a sweep."""
    plane = grounded.surface.plane() if grounded is not None else None
    if plane is None:
        _LOG.info("No lidar near an image: planar association takes z = 0 of the ego frame.")
        return 0.0, 0.0, 0.0
    return plane


def associate_planar(
    label_image: NDArrayByte,
    label_set: LabelSet,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    plane_ego: GroundPlane,
    city_SE3_plane: SE3,
    resolution_m: float,
    config: AssociationConfig,
) -> Observations:
    """Look up the label of each cell of a plane that a camera sees.

    Args:
        label_image: (height, width) uint8 ids, the camera's size.
        label_set: What the ids mean.
        camera: Calibrated camera.
        city_SE3_ego: Ego pose at the image's own time.
        plane_ego: The ground plane in an ego frame,
        city_SE3_plane: and the pose of that one: of the sweep that showed the plane, or
            of the image where there is none.
        resolution_m: Cell size; one look-up at the centre of each cell.
        config: `lookup_range_m` and `min_range_m` from the camera.
    """
    xy = cell_centres_around(
        camera, city_SE3_ego, resolution_m, config.lookup_range_m, config.min_range_m
    )
    points_city = _onto_plane(xy, city_SE3_plane, plane_ego)
    projection = project_city(points_city, camera, city_SE3_ego)
    points_city, uv = points_city[projection.is_valid], projection.uv[projection.is_valid]
    labels = labels_at(label_image, uv)
    speaks = speaks_of_ground(labels, label_set)
    return Observations(points_city[speaks], labels[speaks])


def _onto_plane(xy_city: NDArrayFloat, city_SE3_ego: SE3, plane_ego: GroundPlane) -> NDArrayFloat:
    """City points (N, 3) above city positions (N, 2) that lie on a plane given in the ego frame."""
    a, b, c = plane_ego
    normal_city = city_SE3_ego.rotation @ np.array([-a, -b, 1.0])
    on_plane = city_SE3_ego.transform_from(np.array([[0.0, 0.0, c]]))[0]
    offset = normal_city[:2] @ (xy_city - on_plane[:2]).T
    return np.column_stack([xy_city, on_plane[2] - offset / normal_city[2]])
