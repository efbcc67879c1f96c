"""Sparse association: the lidar sweep nearest in time, put into the image."""

from __future__ import annotations

import numpy as np

from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.lookup import (
    camera_position,
    labels_at,
    project_city,
    speaks_of_ground,
)
from hdmap_tools.association.observations import Observations
from hdmap_tools.association.visibility import is_unoccluded
from hdmap_tools.config import AssociationConfig
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.types import NDArrayByte


def associate_sparse(
    label_image: NDArrayByte,
    label_set: LabelSet,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    grounded: GroundedSweep,
    config: AssociationConfig,
) -> Observations:
    """Label the ground points of a sweep that a camera sees.

    Args:
        label_image: (height, width) uint8 ids, the camera's size.
        label_set: What the ids mean.
        camera: Calibrated camera.
        city_SE3_ego: Ego pose at the image's own time.
        grounded: The sweep and its ground.
        config: Range, occlusion test.
    """
    projection = project_city(grounded.points_city, camera, city_SE3_ego)
    use = projection.is_valid & grounded.is_ground
    if config.occlusion_test:
        use &= is_unoccluded(
            projection, ~grounded.is_ground, camera, gap_v_deg=grounded.ring_gap_deg
        )
    from_camera = grounded.points_city[:, :2] - camera_position(camera, city_SE3_ego)[:2]
    use &= np.linalg.norm(from_camera, axis=1) >= config.min_range_m
    use &= np.linalg.norm(grounded.sweep.points_ego[:, :2], axis=1) <= config.max_range_m
    labels = labels_at(label_image, projection.uv[use])
    speaks = speaks_of_ground(labels, label_set)
    return Observations(
        grounded.points_city[use][speaks], labels[speaks], grounded.sweep.intensity[use][speaks]
    )
