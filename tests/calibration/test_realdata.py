"""Recorded points, and another projection as the judge."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmap_tools.calibration.extrinsics import estimate_extrinsics
from hdmap_tools.calibration.pairs import Pairs
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3

pytestmark = pytest.mark.realdata


def read_kitti(folder):
    """Points (N, 3) in the lidar's frame, and matrices by name as the file has them."""
    points = np.fromfile(folder / "000007.bin", dtype=np.float32).reshape(-1, 4)[:, :3]
    lines = (line.split(":") for line in (folder / "000007.txt").read_text().splitlines() if line)
    return points.astype(np.float64), {n: np.array(v.split(), float) for n, v in lines}


def test_the_mount_of_a_recorded_camera_is_found_again(data_root):
    """Pixels by KITTI's own product of matrices; points where its lidar measured them."""
    points, given = read_kitti(data_root / "kitti")
    projection = given["P2"].reshape(3, 4)
    rectified_SE3_cam0 = given["R0_rect"].reshape(3, 3)
    cam0_SE3_lidar = given["Tr_velo_to_cam"].reshape(3, 4)
    in_camera = (points @ cam0_SE3_lidar[:, :3].T + cam0_SE3_lidar[:, 3]) @ rectified_SE3_cam0.T
    uvw = in_camera @ projection[:, :3].T + projection[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = uvw[:, :2] / uvw[:, 2:]
    seen = (uvw[:, 2] > 3) & (uv > 5).all(axis=1) & (uv < (1237, 370)).all(axis=1)
    matrix = projection[:, :3]
    camera = PinholeCamera(
        "image_2", 1242, 375, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], SE3.identity()
    )
    # Where the lidar's origin lies in the camera's frame, from the same matrices.
    shift = np.linalg.solve(matrix, projection[:, 3])
    true_R = rectified_SE3_cam0 @ cam0_SE3_lidar[:, :3]
    true_t = rectified_SE3_cam0 @ cam0_SE3_lidar[:, 3] + shift
    for seed in range(5):
        rng = np.random.default_rng(seed)
        chosen = rng.choice(np.flatnonzero(seen), 60, replace=False)
        pixels = uv[chosen] + rng.normal(0, 0.5, (60, 2))
        pixels[:12] = rng.uniform((5, 5), (1237, 370), (12, 2))
        found = estimate_extrinsics(Pairs.of(points[chosen], pixels), camera)
        cam_SE3_lidar = found.camera.ego_SE3_cam.inverse()
        turn = Rotation.from_matrix(cam_SE3_lidar.rotation.T @ true_R).magnitude()
        eye = -true_R.T @ true_t
        assert np.degrees(turn) < 0.1
        assert np.linalg.norm(found.camera.ego_SE3_cam.translation - eye) < 0.02
        assert not found.pose.is_used[:12].any()
