"""What was found, as documents for JSON: units in the names, frames in the names of poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from hdmap_tools.calibration.board_images import BoardImages
from hdmap_tools.calibration.chessboard import Board
from hdmap_tools.calibration.extrinsics import Extrinsics
from hdmap_tools.calibration.intrinsics import PARAMETERS, Intrinsics
from hdmap_tools.calibration.pairs import Pairs
from hdmap_tools.geometry.camera import PinholeCamera


def intrinsics_report(found: Intrinsics, images: BoardImages, board: Board) -> dict[str, Any]:
    """Of `hdmap calibrate intrinsics`."""
    return {
        "camera": camera_document(found.camera),
        "sigma": dict(zip(PARAMETERS, found.sigma.tolist(), strict=True)),
        "rms_px": found.rms_px,
        "held_out_rms_px": found.held_out_rms_px,
        "coverage": found.coverage,
        "board": {"columns": board.columns, "rows": board.rows, "square_m": board.square_m},
        "num_views": len(found.views),
        "views": [
            {
                "image": view.name,
                "rms_px": view.rms_px,
                "max_px": view.max_px,
                "held_out_rms_px": view.held_out_rms_px,
                "tilt_deg": view.tilt_deg,
            }
            for view in found.views
        ],
        "images_without_board": list(images.without_board),
        "repeated_images": list(images.repeated),
        "warnings": list(found.warnings),
    }


def extrinsics_report(found: Extrinsics, pairs: Pairs) -> dict[str, Any]:
    """Of `hdmap calibrate extrinsics`."""
    pose = found.pose
    mount = pose.ego_SE3_cam
    distances = pose.distances_px
    return {
        "camera": camera_document(found.camera),
        "ego_SE3_cam": {
            "quaternion_wxyz": mount.quaternion_wxyz.tolist(),
            "translation_m": mount.translation.tolist(),
            "matrix": mount.matrix.tolist(),
        },
        "sigma_rotation_deg": found.sigma_rotation_deg.tolist(),
        "sigma_position_m": found.sigma_position_m.tolist(),
        "interval_95_factor": found.interval_factor,
        "covariance": pose.covariance.tolist(),
        "covariance_order": (
            "turn about the camera's x, y, z axes in radians, position of the camera along the ego "
            "axes in metres"
        ),
        "sigma_px": pose.sigma_px,
        "rms_px": float(np.sqrt(np.mean(distances[pose.is_used] ** 2))),
        "num_pairs": len(pairs),
        "num_used": int(pose.is_used.sum()),
        "left_out": [
            {"line": int(line), "error_px": float(error) if np.isfinite(error) else None}
            for line, error, used in zip(pairs.lines, distances, pose.is_used, strict=True)
            if not used
        ],
        "assumes": (
            "exact intrinsics and independent errors of the pixels; the error of the intrinsics comes on top"
        ),
        "warnings": list(found.warnings),
    }


def camera_document(camera: PinholeCamera) -> dict[str, Any]:
    """Size, intrinsics in pixels, and distortion."""
    k1, k2, p1, p2, k3 = camera.distortion
    return {
        "name": camera.name,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "fx_px": camera.fx,
        "fy_px": camera.fy,
        "cx_px": camera.cx,
        "cy_px": camera.cy,
        "distortion": {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3},
    }
