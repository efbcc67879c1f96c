"""Cells that a camera may see against all cells around it."""

import numpy as np
import pytest

from hdmap_tools.association.lookup import camera_position, cell_centres_around, project_city
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize("turn", [AHEAD, DOWN])
@pytest.mark.parametrize("resolution_m", [0.1, 0.25])
def test_every_cell_of_the_ring_that_is_in_the_image_is_given_once(turn, resolution_m):
    camera = PinholeCamera(
        "c", 640, 400, 400.0, 400.0, 320.0, 200.0, SE3(turn, np.array([1.0, 0.2, 1.5]))
    )
    pose = SE3.from_yaw(2.1, (-312.34, 87.65, 3.0))
    xy = cell_centres_around(camera, pose, resolution_m, 25.0, 2.0)
    centre = camera_position(camera, pose)[:2]
    k = np.arange(np.floor(-26 / resolution_m), np.ceil(26 / resolution_m))
    x, y = ((np.floor(c / resolution_m) + k + 0.5) * resolution_m for c in centre)
    around = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(around - centre, axis=1)
    around = around[(distance <= 25.0) & (distance >= 2.0)]
    seen = project_city(np.column_stack([around, np.full(len(around), 3.0)]), camera, pose).is_valid
    given = {tuple(p) for p in xy.tolist()}
    assert len(given) == len(xy)
    assert {tuple(p) for p in around[seen].tolist()} <= given <= set(map(tuple, around.tolist()))
    assert (len(xy) < 0.6 * len(around)) == (turn is AHEAD)
    # Row by row from the south, so that what is made of them is always the same.
    assert (np.lexsort((xy[:, 0], xy[:, 1])) == np.arange(len(xy))).all()
