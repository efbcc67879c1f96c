"""A camera's pose by non-linear least squares, with its covariance.

Six unknowns: a small turn about the camera's axes and a shift in the ego frame,
``ego_SE3_cam(w, t) = (R exp(w), position + t)``. The sum of squared pixel distances is
minimized; the covariance is ``s² (JᵀJ)⁻¹`` with the variance s² of a pixel coordinate
taken from the residuals themselves, because nobody knows how well a person clicks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hdmap_tools.calibration.pose_ransac import as_lens, distances_px
from hdmap_tools.errors import CalibrationError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.types import NDArrayBool, NDArrayFloat

NUM_UNKNOWNS: Final = 6
_GATE_PROBABILITY: Final = 0.001
"""Share of right pairs that the gate loses."""
_GATE_SIGMAS: Final = float(np.sqrt(-2 * np.log(_GATE_PROBABILITY)))
"""3.72: a distance in the plane beyond this many sigma has that probability (Rayleigh)."""
_MEDIAN_SIGMAS: Final = float(np.sqrt(2 * np.log(2)))
"""1.177: the median distance in the plane, in sigma of a coordinate (Rayleigh)."""
_TAIL_SHARE: Final = 1 - _GATE_PROBABILITY * np.log(1 / _GATE_PROBABILITY) / (1 - _GATE_PROBABILITY)
"""0.993: the variance of what passes the gate, of that of all."""
_SMALLEST_GATE_PX: Final = 0.01
_ROUNDS: Final = 20
_NOT_SEEN_PX: Final = 1e6
_STEPS: Final = np.array([1e-6] * 3 + [1e-5] * 3)
_MAX_CONDITION: Final = 1e12


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A mount and how well it is known.

    Attributes:
        ego_SE3_cam: The mount.
        covariance: (6, 6) of a turn about the camera's x, y and z axes, radians, and of the
            camera's position along the ego axes, metres.
        sigma_px: Standard deviation of a pixel coordinate, from the residuals.
        is_used: (N,) pairs that the pose was fitted to.
        distances_px: (N,) of all pairs; infinite where the camera cannot see the point.
    """

    ego_SE3_cam: SE3
    covariance: NDArrayFloat
    sigma_px: float
    is_used: NDArrayBool
    distances_px: NDArrayFloat

    @property
    def degrees_of_freedom(self) -> int:
        """Of the residuals, from which `sigma_px` is taken."""
        return 2 * int(self.is_used.sum()) - NUM_UNKNOWNS


def refine_pose(
    points: NDArrayFloat,
    uv: NDArrayFloat,
    camera: PinholeCamera,
    start: SE3,
    is_used: NDArrayBool,
) -> RefinedPose:
    """Fit the pose to the pairs that agree, deciding again which do from their own scatter.

    Args:
        points: (N, 3) metres, ego frame.
        uv: (N, 2) pixels.
        camera: Its intrinsics; its mount is not used.
        start: ``ego_SE3_cam`` to start from.
        is_used: (N,) pairs that agree with it.

    Raises:
        CalibrationError: If fewer than four pairs remain, or they leave a direction open.
    """
    lens = as_lens(camera)
    mount, seen_sets = start, set()
    for _ in range(_ROUNDS):
        _require_enough(is_used)
        seen_sets.add(is_used.tobytes())
        mount = _fitted(points[is_used], uv[is_used], lens, mount)
        distances = distances_px(points, uv, lens, mount)
        gate = max(_GATE_SIGMAS * _robust_sigma(distances[is_used]), _SMALLEST_GATE_PX)
        now = distances <= gate
        if now.tobytes() in seen_sets:  # settled, or turning in a circle
            break
        is_used = now
    _require_enough(is_used)
    residuals = _residuals(np.zeros(NUM_UNKNOWNS), points[is_used], uv[is_used], lens, mount)
    free = 2 * int(is_used.sum()) - NUM_UNKNOWNS
    variance = float(residuals @ residuals) / free / _TAIL_SHARE
    return RefinedPose(
        ego_SE3_cam=mount,
        covariance=_covariance(points[is_used], uv[is_used], lens, mount, variance),
        sigma_px=float(np.sqrt(variance)),
        is_used=is_used,
        distances_px=distances_px(points, uv, lens, mount),
    )


def _require_enough(is_used: NDArrayBool) -> None:
    if is_used.sum() < 4:
        raise CalibrationError(
            f"Only {int(is_used.sum())} of {len(is_used)} pairs agree with one pose; expected at least 4. "
            "Check the pairs, the camera, and the frame of the points."
        )


def _moved(mount: SE3, step: NDArrayFloat) -> SE3:
    from scipy.spatial.transform import Rotation

    turned = mount @ SE3(Rotation.from_rotvec(step[:3]).as_matrix(), np.zeros(3))
    return SE3(turned.rotation, turned.translation + step[3:])


def _residuals(
    step: NDArrayFloat, points: NDArrayFloat, uv: NDArrayFloat, lens: PinholeCamera, mount: SE3
) -> NDArrayFloat:
    """(2 N,) pixels; large where a step would put a point out of sight, so that it is not taken."""
    seen = lens.project(_moved(mount, step).inverse().transform_from(points))
    return np.asarray(np.nan_to_num(seen.uv - uv, nan=_NOT_SEEN_PX)).ravel()


def _fitted(points: NDArrayFloat, uv: NDArrayFloat, lens: PinholeCamera, mount: SE3) -> SE3:
    from scipy.optimize import least_squares

    found: Any = least_squares(
        _residuals,
        np.zeros(NUM_UNKNOWNS),
        jac=_jacobian,
        method="lm",
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
        args=(points, uv, lens, mount),
    )
    return _moved(mount, found.x)


def _jacobian(
    step: NDArrayFloat, points: NDArrayFloat, uv: NDArrayFloat, lens: PinholeCamera, mount: SE3
) -> NDArrayFloat:
    """(2 N, 6), by central differences."""
    columns = []
    for k in range(NUM_UNKNOWNS):  # six unknowns, each over all points at once
        change = np.zeros(NUM_UNKNOWNS)
        change[k] = _STEPS[k]
        after = _residuals(step + change, points, uv, lens, mount)
        before = _residuals(step - change, points, uv, lens, mount)
        columns.append((after - before) / (2 * _STEPS[k]))
    return np.column_stack(columns)


def _covariance(
    points: NDArrayFloat, uv: NDArrayFloat, lens: PinholeCamera, mount: SE3, variance: float
) -> NDArrayFloat:
    jacobian = _jacobian(np.zeros(NUM_UNKNOWNS), points, uv, lens, mount)
    information = jacobian.T @ jacobian
    # Radians and metres differ in scale; the condition must not come from that.
    scale = np.sqrt(np.diag(information))
    if (scale == 0).any() or np.linalg.cond(information / np.outer(scale, scale)) > _MAX_CONDITION:
        raise CalibrationError(
            f"The {len(points)} pairs that agree leave a direction of the pose open; add pairs elsewhere in "
            "the picture and at other distances."
        )
    inverse = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(variance * (inverse + inverse.T) / 2)


def _robust_sigma(distances: NDArrayFloat) -> float:
    """Of one coordinate, from the median distance, widened for the unknowns that were fitted."""
    count = len(distances)
    widened = np.sqrt(2 * count / max(2 * count - NUM_UNKNOWNS, 1))
    return float(np.median(distances) / _MEDIAN_SIGMAS * widened)
