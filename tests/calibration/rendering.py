"""Photos of a chessboard through a known camera: antialiased, blurred, noisy."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hdmap_tools.calibration.chessboard import Board
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3

BOARD = Board(9, 6, 0.1)
TRUE_CAMERA = PinholeCamera(
    "CAM",
    960,
    600,
    fx=812.3,
    fy=808.9,
    cx=487.6,
    cy=291.2,
    ego_SE3_cam=SE3.identity(),
    distortion=(-0.21, 0.08, 0.0006, -0.0009, -0.012),
)
_SAMPLES = 4


class Renderer:
    """Renders boards seen by one camera; its rays are computed once."""

    def __init__(self, camera: PinholeCamera) -> None:
        self.camera = camera
        v, u = np.indices((camera.height_px + 2, camera.width_px + 2), dtype=np.float64) - 1.0
        rays = camera.rays_ego(np.column_stack([u.ravel(), v.ravel()]))
        rays = rays.reshape(*u.shape, 3)[..., :2]
        self._rays = rays[1:-1, 1:-1]
        # Rays bend so little within a pixel that their slope serves for its parts.
        self._along_u = (rays[1:-1, 2:] - rays[1:-1, :-2]) / 2
        self._along_v = (rays[2:, 1:-1] - rays[:-2, 1:-1]) / 2

    def image(self, board, cam_SE3_board, rng, blur_px=0.8, noise=2.0):
        """(h, w) uint8: the board on a grey wall, with white paper of one square around it."""
        offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
        light = np.full(self._rays.shape[:2], 120.0)
        part = self._part_with(board, cam_SE3_board)
        light[part] = 0.0
        for du in offsets:
            for dv in offsets:
                rays = self._rays[part] + du * self._along_u[part] + dv * self._along_v[part]
                light[part] += self._shade(board, cam_SE3_board, rays) / _SAMPLES**2
        light = cv2.GaussianBlur(light, (0, 0), blur_px)
        light += rng.normal(0.0, noise, light.shape)
        return np.clip(np.round(light), 0, 255).astype(np.uint8)

    def _part_with(self, board, cam_SE3_board):
        """The pixels around the paper: the wall needs no samples."""
        columns, rows = np.meshgrid(
            np.linspace(-2, board.columns + 1, 20), np.linspace(-2, board.rows + 1, 20)
        )
        paper = np.column_stack([columns.ravel(), rows.ravel(), np.zeros(400)]) * board.square_m
        uv = self.camera.project(cam_SE3_board.transform_from(paper)).uv
        u0, v0 = np.maximum(np.floor(np.nanmin(uv, axis=0)).astype(int) - 6, 0)
        u1, v1 = np.ceil(np.nanmax(uv, axis=0)).astype(int) + 7
        return slice(v0, v1), slice(u0, u1)

    @staticmethod
    def _shade(board, cam_SE3_board, rays):
        normal, origin = cam_SE3_board.rotation[:, 2], cam_SE3_board.translation
        directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
        depth = (normal @ origin) / (directions @ normal)
        on_board = (directions * depth[..., None] - origin) @ cam_SE3_board.rotation
        column, row = (np.floor(on_board[..., k] / board.square_m) for k in (0, 1))
        in_squares = (column >= -1) & (column < board.columns)
        in_squares &= (row >= -1) & (row < board.rows)
        in_paper = (column >= -2) & (column <= board.columns)
        in_paper &= (row >= -2) & (row <= board.rows)
        in_paper &= depth > 0
        is_dark = in_squares & ((column + row) % 2 == 0)
        return np.where(in_paper, np.where(is_dark, 40.0, 205.0), 120.0)


def views(board, camera, count, rng):
    """Poses ``cam_SE3_board`` of boards wholly in the picture, tilted and spread over it."""
    middle = board.corners_board.mean(axis=0)
    paper = np.array([(-2, -2), (board.columns + 1, -2), (-2, board.rows + 1)])
    paper = np.vstack([paper, [(board.columns + 1, board.rows + 1)]]) * board.square_m
    paper = np.column_stack([paper, np.zeros(4)])
    found = []
    while len(found) < count:
        tilt = Rotation.from_euler(
            "xyz", rng.uniform([-40, -40, -20], [40, 40, 20]), degrees=True
        ).as_matrix()
        uv = rng.uniform([0.15, 0.15], [0.85, 0.85]) * (camera.width_px, camera.height_px)
        depth = rng.uniform(1.1, 2.2)
        at = camera.rays_ego(uv[None])[0] * depth
        pose = SE3(tilt, at - tilt @ middle)
        if camera.project(pose.transform_from(paper)).is_valid.all():
            found.append(pose)
    return found
