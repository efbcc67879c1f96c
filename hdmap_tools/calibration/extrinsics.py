"""The mount of a camera from pairs of lidar points and pixels: found, refined, judged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdmap_tools.calibration.pairs import FEWEST_PAIRS, Pairs, require_usable
from hdmap_tools.calibration.pose_ransac import MIN_SHARE, find_pose
from hdmap_tools.calibration.pose_refine import RefinedPose, refine_pose
from hdmap_tools.calibration.spread import require_spread
from hdmap_tools.errors import CalibrationError, ConfigError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.types import NDArrayFloat

MAX_ERROR_PX: Final = 5.0
"""Ten times the noise of a careful click; wrong pairs are further off almost always."""

_WEAK_SHARE: Final = 0.6
_WEAK_DEG: Final = 0.1
_WEAK_M: Final = 0.02
_MIRROR: Final = np.array([1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """A camera with the mount that was found.

    Attributes:
        camera: With ``ego_SE3_cam`` as found.
        pose: The mount with its covariance, and which pairs were used.
        warnings: What makes the result weaker than its figures look.
    """

    camera: PinholeCamera
    pose: RefinedPose
    warnings: tuple[str, ...]

    @property
    def sigma_rotation_deg(self) -> NDArrayFloat:
        """(3,) standard deviations of a turn about the camera's x, y and z axes, degrees."""
        return np.degrees(np.sqrt(np.diag(self.pose.covariance)[:3]))

    @property
    def sigma_position_m(self) -> NDArrayFloat:
        """(3,) standard deviations of the camera's position along the ego axes, metres."""
        return np.sqrt(np.diag(self.pose.covariance)[3:])

    @property
    def interval_factor(self) -> float:
        """How many sigma hold the truth with 95 %: Student's t, because sigma is estimated too."""
        from scipy.stats import t

        return float(t.ppf(0.975, self.pose.degrees_of_freedom))


def estimate_extrinsics(
    pairs: Pairs, camera: PinholeCamera, *, max_error_px: float = MAX_ERROR_PX, seed: int = 0
) -> Extrinsics:
    """Where the camera sits, in the frame of the points.

    EPnP inside RANSAC finds the pose and the wrong pairs; least squares over the right ones
    refines it.

    Args:
        pairs: Points in the ego frame (or whatever frame the mount is wanted in), and pixels.
        camera: Its intrinsics and image size; its mount is not used.
        max_error_px: Pairs nearer than this agree, while the pose is looked for.
        seed: Of the random samples.

    Raises:
        CalibrationError: If the pairs are too few, collinear, coplanar, behind the camera, or
            do not agree with any pose.
        ConfigError: If max_error_px is not positive.
    """
    if not (np.isfinite(max_error_px) and max_error_px > 0):
        raise ConfigError(f"max_error_px is {max_error_px}; expected a positive number of pixels.")
    require_usable(pairs, camera)
    require_spread(pairs.points, f"The {len(pairs)} points")
    found = find_pose(pairs.points, pairs.uv, camera, max_error_px, np.random.default_rng(seed))
    fewest = max(FEWEST_PAIRS, int(np.ceil(MIN_SHARE * len(pairs))))
    if found is None or found[1].sum() < fewest:
        raise _no_agreement(
            pairs, camera, 0 if found is None else int(found[1].sum()), max_error_px, seed
        )
    pose = refine_pose(pairs.points, pairs.uv, camera, *found)
    num_used = int(pose.is_used.sum())
    if num_used < fewest:
        raise _no_agreement(pairs, camera, num_used, max_error_px, seed)
    # Wrong pairs are off the plane that all right ones may lie on.
    warnings = require_spread(
        pairs.points[pose.is_used],
        f"The {num_used} of {len(pairs)} points that agree with one pose",
    )
    result = Extrinsics(replace(camera, ego_SE3_cam=pose.ego_SE3_cam), pose, ())
    return replace(result, warnings=(*warnings, *_warnings(result)))


def _no_agreement(
    pairs: Pairs, camera: PinholeCamera, num_agreeing: int, max_error_px: float, seed: int
) -> CalibrationError:
    """Why no pose was found, as far as it can be told."""
    # A camera's picture of points mirrored through it is the same picture, so points in a
    # left-handed frame fit with all of them behind the camera. Any mirror image will do:
    # they differ by a turn.
    rng = np.random.default_rng(seed)
    mirrored = find_pose(pairs.points * _MIRROR, pairs.uv, camera, max_error_px, rng)
    if mirrored is not None and mirrored[1].sum() >= max(FEWEST_PAIRS, len(pairs) // 2):
        return CalibrationError(
            f"{int(mirrored[1].sum())} of {len(pairs)} pairs fit one pose only with all points behind the "
            "camera: their frame is left-handed. Change the sign of one axis (or swap two), or of u."
        )
    return CalibrationError(
        f"Only {num_agreeing} of {len(pairs)} pairs agree with one pose within {max_error_px:g} px; expected at "
        f"least {max(FEWEST_PAIRS, int(np.ceil(MIN_SHARE * len(pairs))))}, with the points in front of the camera. "
        "Check that each pixel shows its point, that the intrinsics are of this camera, and the frame of "
        "the points; for coarse pairs raise the allowed error (--max-error-px)."
    )


def _warnings(result: Extrinsics) -> list[str]:
    said = []
    used = result.pose.is_used
    if used.mean() < _WEAK_SHARE:
        said.append(f"only {int(used.sum())} of {len(used)} pairs agree; look at the others")
    turn, shift = result.sigma_rotation_deg.max(), result.sigma_position_m.max()
    if turn > _WEAK_DEG or shift > _WEAK_M:
        said.append(
            f"the mount is known to {turn:.2f} degrees and {100 * shift:.1f} cm (one standard deviation of "
            "the worst axis); add pairs all over the picture, near ones above all"
        )
    return said
