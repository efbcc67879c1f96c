"""Looking labels up in an image, and the cells that a camera may see."""

from __future__ import annotations

import numpy as np

from hdmap_tools.geometry.camera import PinholeCamera, Projection
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat


def labels_at(label_image: NDArrayByte, uv: NDArrayFloat) -> NDArrayByte:
    """Labels (N,) of the pixels nearest to positions uv (N, 2), which lie in the image."""
    pixels = np.rint(uv).astype(np.int64)
    return np.asarray(label_image[pixels[:, 1], pixels[:, 0]])


def speaks_of_ground(labels: NDArrayByte, label_set: LabelSet) -> NDArrayBool:
    """(N,) bool: labels that say something about the ground seen there.

    A moving object's label is evidence about the object, not about what it hides.
    """
    return np.asarray((labels != IGNORE_ID) & ~np.isin(labels, label_set.moving_ids))


def camera_position(camera: PinholeCamera, city_SE3_ego: SE3) -> NDArrayFloat:
    """City position (3,) of a camera at an ego pose, metres."""
    return np.asarray(city_SE3_ego.transform_from(camera.ego_SE3_cam.translation[None])[0])


def cell_centres_around(
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    resolution_m: float,
    reach_m: float,
    min_range_m: float = 0.0,
) -> NDArrayFloat:
    """City positions (N, 2) of the lattice's cell centres that a camera may see.

    Centres of the map's own cells, so that a frame asks each cell exactly once.
    Those within reach and, seen from above, within the camera's view and a margin;
    which of them the image really holds, the projection says.
    """
    from hdmap_tools.association.lookup_kernels import centres_in_view

    centre = camera_position(camera, city_SE3_ego)[:2]
    axis, widest = _view(camera, city_SE3_ego)
    found: NDArrayFloat = centres_in_view(centre, resolution_m, reach_m, min_range_m, axis, widest)
    return found


def _view(camera: PinholeCamera, city_SE3_ego: SE3) -> tuple[NDArrayFloat, float]:
    """Axis (2,) and cosine of half the angle of the horizontal directions that may meet an image.

    Errs towards more; -2 where any direction may be seen.
    """
    u = np.linspace(0, camera.width_px - 1, 9)
    v = np.linspace(0, camera.height_px - 1, 9)
    border = np.concatenate(
        [np.column_stack([u, np.full(9, e)]) for e in (v[0], v[-1])]
        + [np.column_stack([np.full(9, e), v]) for e in (u[0], u[-1])]
    )
    rays = camera.rays_ego(border) @ city_SE3_ego.rotation.T
    axis = (city_SE3_ego.rotation @ camera.ego_SE3_cam.rotation)[:2, 2]
    flat = np.linalg.norm(rays[:, :2], axis=1)
    if not np.isfinite(rays).all() or np.linalg.norm(axis) < 0.5 or (flat < 0.2).any():
        return np.array([1.0, 0.0]), -2.0  # looks up or down
    axis = axis / np.linalg.norm(axis)
    return axis, float((rays[:, :2] @ axis / flat).min()) - 0.05


def project_city(points_city: NDArrayFloat, camera: PinholeCamera, city_SE3_ego: SE3) -> Projection:
    """Project city points (N, 3) into a camera at an ego pose."""
    return camera.project(city_SE3_ego.inverse().transform_from(points_city))
