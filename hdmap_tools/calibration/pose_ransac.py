"""A camera's pose from pairs of which some are wrong: EPnP on random samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from hdmap_tools.calibration.spread import principal_extents
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_SAMPLE: Final = 6
"""One more than the least that fixes a pose and EPnP's four unknown weights: steadier with noise."""
_CONFIDENCE: Final = 0.9999
MIN_SHARE: Final = 0.4
"""Of pairs that must agree: fewer may agree by chance, and take ten times as long to find."""
_POLISHING_ROUNDS: Final = 5
_FLAT: Final = 1e-3
"""Samples flatter than this share of their size are not tried: EPnP fails on planes."""


def distances_px(
    points: NDArrayFloat, uv: NDArrayFloat, lens: PinholeCamera, mount: SE3
) -> NDArrayFloat:
    """(N,) pixels between where points are seen and where they should be.

    Infinite for points that the camera cannot see: behind it, or beyond its lens.

    Args:
        points: (N, 3) metres, ego frame.
        uv: (N, 2) pixels.
        lens: The camera with the identity for a mount (`as_lens`).
        mount: ``ego_SE3_cam``.
    """
    seen = lens.project(mount.inverse().transform_from(points))
    return np.asarray(np.nan_to_num(np.linalg.norm(seen.uv - uv, axis=1), nan=np.inf))


def as_lens(camera: PinholeCamera) -> PinholeCamera:
    """The camera in its own frame: made once, because a camera checks its distortion when made."""
    return replace(camera, ego_SE3_cam=SE3.identity())


def find_pose(
    points: NDArrayFloat,
    uv: NDArrayFloat,
    camera: PinholeCamera,
    max_error_px: float,
    rng: np.random.Generator,
) -> tuple[SE3, NDArrayBool] | None:
    """The mount that most pairs agree with.

    Args:
        points: (N, 3) metres, ego frame (the frame that the mount is wanted in).
        uv: (N, 2) pixels.
        camera: Its intrinsics; its mount is not used.
        max_error_px: Pairs nearer than this agree.
        rng: Draws the samples.

    Returns:
        ``ego_SE3_cam`` and which pairs (N,) agree with it; None if no sample gave a pose.

    Source:
        Lepetit et al., EPnP, IJCV 2009; Fischler and Bolles, RANSAC, 1981; Chum, Matas and
        Kittler, Locally Optimized RANSAC, 2003.
    """
    lens = as_lens(camera)
    best: tuple[SE3, NDArrayBool] | None = None
    most, trials, needed = 0, 0, _trials_needed(MIN_SHARE)
    while trials < needed:
        trials += 1
        sample = rng.choice(len(points), size=min(_SAMPLE, len(points)), replace=False)
        mount = _epnp(points[sample], uv[sample], lens)
        if mount is None:
            continue
        agrees = distances_px(points, uv, lens, mount) <= max_error_px
        if agrees.sum() <= most:
            continue
        mount, agrees = _polished(points, uv, lens, mount, agrees, max_error_px)
        best, most = (mount, agrees), int(agrees.sum())
        needed = min(needed, _trials_needed(most / len(points)))
    return best


def _polished(
    points: NDArrayFloat,
    uv: NDArrayFloat,
    lens: PinholeCamera,
    mount: SE3,
    agrees: NDArrayBool,
    max_error_px: float,
) -> tuple[SE3, NDArrayBool]:
    """EPnP on all that agree, again as long as more of them do."""
    for _ in range(_POLISHING_ROUNDS):
        if agrees.sum() < _SAMPLE:
            break
        again = _epnp(points[agrees], uv[agrees], lens)
        if again is None:
            break
        now = distances_px(points, uv, lens, again) <= max_error_px
        if now.sum() <= agrees.sum():
            break
        mount, agrees = again, now
    return mount, agrees


def _epnp(points: NDArrayFloat, uv: NDArrayFloat, lens: PinholeCamera) -> SE3 | None:
    import cv2

    extents = principal_extents(points)
    if extents[2] <= _FLAT * extents[0]:
        return None
    # Centred: distances within the sample count, not its distance from the vehicle's origin.
    middle = points.mean(axis=0)
    try:
        done, rvec, tvec = cv2.solvePnP(
            np.ascontiguousarray(points - middle),
            np.ascontiguousarray(uv),
            lens.matrix,
            np.array(lens.distortion),
            flags=cv2.SOLVEPNP_EPNP,
        )
    except cv2.error:
        return None
    # Shapes differ between OpenCV 4 and 5.
    rvec, tvec = (np.asarray(v, dtype=np.float64).reshape(-1) for v in (rvec, tvec))
    if not done or rvec.shape != (3,) or not (np.isfinite(rvec).all() and np.isfinite(tvec).all()):
        return None
    rotation, _ = cv2.Rodrigues(rvec)
    cam_SE3_middle = SE3(np.asarray(rotation, dtype=np.float64), tvec)
    return (cam_SE3_middle @ SE3(np.eye(3), -middle)).inverse()


def _trials_needed(share: float) -> int:
    """Samples until one is without a wrong pair, almost surely."""
    clean = share**_SAMPLE
    if clean >= 1.0 - 1e-12:
        return 1
    return int(np.ceil(np.log(1 - _CONFIDENCE) / np.log1p(-clean)))
