"""The pinhole camera with lens distortion, and projection into its image."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from hdmap_tools.errors import CalibrationError, ShapeError
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.types import NDArrayBool, NDArrayFloat

MIN_DEPTH_M: Final = 0.1
"""Nearer points are not projected: the pixel position is dominated by mounting error."""

_MAX_PX: Final = 100_000
_MAX_NUMBER: Final = 1e6
"""Far beyond any lens; larger numbers only overflow on the way."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Where points land in an image; rows match the points given.

    Attributes:
        uv: (N, 2) pixels, u right, v down; the centre of the first pixel is (0, 0).
            NaN where the camera model gives none: behind the camera, or at an
            angle beyond the one for which the distortion model holds.
        depth_m: (N,) along the optical axis, metres.
        is_valid: (N,) bool: in front of the camera, inside the image, and within
            the angle for which the distortion model holds.
    """

    uv: NDArrayFloat
    depth_m: NDArrayFloat
    is_valid: NDArrayBool


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A calibrated camera on the vehicle.

    Attributes:
        name: Sensor name, for example ``CAM_FRONT``.
        width_px, height_px: Image size.
        fx, fy, cx, cy: Intrinsics in pixels; the centre of the first pixel is (0, 0).
        ego_SE3_cam: Mount; camera axes are x right, y down, z along the view.
        distortion: (k1, k2, p1, p2, k3), OpenCV's order; zeros for a rectified image.

    Source:
        Hartley and Zisserman, Multiple View Geometry, 2nd ed., sections 6.1 and 7.4;
        OpenCV's `calib3d` for the order of the coefficients.
    """

    name: str
    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    ego_SE3_cam: SE3
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    _max_radius: float = field(init=False, repr=False, default=np.inf)

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if len(self.distortion) != 5 or not np.isfinite(numbers).all():
            raise CalibrationError(
                f"Camera {self.name}: intrinsics {numbers[:4]} and distortion {self.distortion} must "
                "be finite, with five distortion coefficients (k1, k2, p1, p2, k3)."
            )
        if self.fx <= 0 or self.fy <= 0 or self.width_px <= 0 or self.height_px <= 0:
            raise CalibrationError(
                f"Camera {self.name}: focal lengths ({self.fx}, {self.fy}) and image size "
                f"({self.width_px}, {self.height_px}) must be positive."
            )
        if max(self.width_px, self.height_px) > _MAX_PX or np.abs(numbers).max() > _MAX_NUMBER:
            raise CalibrationError(
                f"Camera {self.name}: image size ({self.width_px}, {self.height_px}), intrinsics "
                f"{numbers[:4]} and distortion {self.distortion} are those of no camera; expected "
                f"at most {_MAX_PX} pixels and numbers of at most {_MAX_NUMBER:g}."
            )
        object.__setattr__(self, "_max_radius", _monotone_radius(self.distortion))

    @property
    def matrix(self) -> NDArrayFloat:
        """(3, 3) intrinsic matrix, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether the lens model has any distortion."""
        return any(k != 0.0 for k in self.distortion)

    @property
    def lens(self) -> tuple[tuple[float, ...], tuple[int, int], float]:
        """What compiled projections need.

        Intrinsics and distortion (fx, fy, cx, cy, k1, k2, p1, p2, k3); width and height; and
        the largest distance from the axis, at depth one, for which the distortion holds.
        """
        intrinsics = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        return intrinsics, (self.width_px, self.height_px), self._max_radius

    def project(self, points_ego: NDArrayFloat) -> Projection:
        """Project ego-frame points (N, 3), metres, into the image.

        Points behind the camera or outside the image stay in the result and are
        marked invalid, so rows keep matching the input.
        """
        # Infinite and NaN points are let through as invalid rows, without warnings.
        with np.errstate(invalid="ignore", over="ignore"):
            return self._project(self.ego_SE3_cam.inverse().transform_from(points_ego))

    def _project(self, points_cam: NDArrayFloat) -> Projection:
        depth_m = points_cam[:, 2]
        in_front = np.isfinite(points_cam).all(axis=1) & (depth_m > MIN_DEPTH_M)
        safe_depth = np.where(in_front, depth_m, 1.0)
        xy = points_cam[:, :2] / safe_depth[:, None]
        # Beyond this radius the polynomial turns back and would fold points
        # from far outside the view into the image.
        in_model = (xy**2).sum(axis=1) <= self._max_radius**2
        xy = np.where((in_front & in_model)[:, None], xy, 0.0)
        if self.is_distorted:
            xy = _distort(xy, self.distortion)
        uv = xy * (self.fx, self.fy) + (self.cx, self.cy)
        uv = np.where((in_front & in_model)[:, None], uv, np.nan)
        is_valid = in_front & in_model
        is_valid &= (uv[:, 0] >= -0.5) & (uv[:, 0] < self.width_px - 0.5)
        is_valid &= (uv[:, 1] >= -0.5) & (uv[:, 1] < self.height_px - 0.5)
        return Projection(uv, depth_m, is_valid)

    def rays_ego(self, uv: NDArrayFloat) -> NDArrayFloat:
        """Viewing directions (N, 3) in the ego frame of pixels uv (N, 2).

        Directions have length one along the optical axis, not unit length: the
        point at depth d is ``ego_SE3_cam.translation + d * ray``. NaN for pixels
        that the lens model reaches from nowhere (far outside a wide-angle image).
        """
        uv = np.asarray(uv, dtype=np.float64)
        if uv.ndim != 2 or uv.shape[1] != 2:
            raise ShapeError(f"Pixels must be (N, 2), found {uv.shape}.")
        xy = (uv - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.is_distorted:
            xy = _undistort(xy, self.distortion, self._max_radius)
        rays_cam = np.column_stack([xy, np.ones(len(xy))])
        return rays_cam @ self.ego_SE3_cam.rotation.T

    def scaled(self, width_px: int, height_px: int) -> PinholeCamera:
        """The same camera with its image resampled to another size."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return PinholeCamera(
            name=self.name,
            width_px=width_px,
            height_px=height_px,
            fx=self.fx * sx,
            fy=self.fy * sy,
            # Pixel centres are at whole numbers, so the image's edge is at -0.5.
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            ego_SE3_cam=self.ego_SE3_cam,
            distortion=self.distortion,
        )


def _distort(xy: NDArrayFloat, distortion: tuple[float, ...]) -> NDArrayFloat:
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.column_stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ]
    )


def _undistort(
    xy_distorted: NDArrayFloat, distortion: tuple[float, ...], max_radius: float
) -> NDArrayFloat:
    """Invert `_distort` by Newton's method with a numerical Jacobian; NaN where it has no inverse."""
    xy = xy_distorted.copy()
    step = 1e-6
    for _ in range(50):
        error = _distort(xy, distortion) - xy_distorted
        if np.abs(error).max(initial=0.0) < 1e-12:
            break
        dx = (_distort(xy + (step, 0.0), distortion) - _distort(xy - (step, 0.0), distortion)) / (
            2 * step
        )
        dy = (_distort(xy + (0.0, step), distortion) - _distort(xy - (0.0, step), distortion)) / (
            2 * step
        )
        det = dx[:, 0] * dy[:, 1] - dy[:, 0] * dx[:, 1]
        det = np.where(np.abs(det) < 1e-9, 1e-9, det)
        xy = xy - np.column_stack(
            [
                (dy[:, 1] * error[:, 0] - dy[:, 0] * error[:, 1]) / det,
                (dx[:, 0] * error[:, 1] - dx[:, 1] * error[:, 0]) / det,
            ]
        )
    reached = np.abs(_distort(xy, distortion) - xy_distorted).max(axis=1, initial=0.0) < 1e-9
    reached &= (xy**2).sum(axis=1) <= max_radius**2 * (1 + 1e-9)
    return np.where(reached[:, None], xy, np.nan)


def _monotone_radius(distortion: tuple[float, ...]) -> float:
    """Largest undistorted radius up to which the radial polynomial still grows."""
    k1, k2, _, _, k3 = distortion
    if k1 == k2 == k3 == 0.0:
        return float("inf")
    # d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) = 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3, s = r^2.
    coefficients = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])
    # Of no effect below 89.9 degrees from the axis, and poison for the root finder.
    coefficients[np.abs(coefficients) < 1e-18] = 0.0
    roots = np.roots(coefficients)
    real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else float("inf")
