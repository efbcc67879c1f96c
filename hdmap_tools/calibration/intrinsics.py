"""Intrinsics of a camera from pictures of a chessboard, and how far they can be trusted.

The error on the views that were fitted is too good: with five numbers of distortion it
falls although the lens is not known any better. So views are also left out in turn, and
the camera found without them has to predict half of their corners from the other half.

Source:
    Zhang, A Flexible New Technique for Camera Calibration, PAMI 2000; OpenCV's
    `calibrateCamera`. Its own standard deviations come from a pseudo-inverse: for boards all
    parallel to the picture they are small where nothing is known. So they are computed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hdmap_tools.calibration.chessboard import Board
from hdmap_tools.errors import CalibrationError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.types import NDArrayFloat

PARAMETERS: Final = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Order of the intrinsics and of their sigma."""

FEWEST_VIEWS: Final = 3
_ADVISED_VIEWS: Final = 10
_FOLDS: Final = 5
_MAX_SIGMA_SHARE: Final = 0.05
"""Of the focal length: beyond it the views do not determine the camera."""
_WEAK_SIGMA_SHARE: Final = 0.002
_MIN_TILT_DEG: Final = 5.0
_WEAK_TILT_DEG: Final = 20.0
_SMALLEST_EIGENVALUE: Final = 1e-14
"""Of the scaled information; good views have 1e-7 because the three radial terms are alike."""
_BAD_VIEW_PX: Final = 0.5
_BAD_VIEW_FACTOR: Final = 3.0
_MIN_COVERAGE: Final = 0.5
COVERAGE_CELLS: Final = (8, 6)
"""Columns and rows of the cells in which the coverage of the picture is counted."""


@dataclass(frozen=True, eq=False)
class View:
    """One picture in which the board was found.

    Attributes:
        name: Names the picture in messages and the report.
        uv: (N, 2) pixels, in the order of `Board.corners_board`.
    """

    name: str
    uv: NDArrayFloat


@dataclass(frozen=True)
class ViewError:
    """How well one view is predicted; distances in pixels.

    Attributes:
        name: Of the picture.
        rms_px, max_px: Of its corners, by the camera fitted to all views.
        held_out_rms_px: Of half its corners, by a camera fitted without this view and a pose
            fitted to the other half; None with too few views.
        tilt_deg: Angle between the board's normal and the optical axis, 0..90.
    """

    name: str
    rms_px: float
    max_px: float
    held_out_rms_px: float | None
    tilt_deg: float


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A camera found from its views.

    Attributes:
        camera: With the identity as mount: a chessboard does not tell where it sits.
        sigma: (9,) standard deviations in the order of `PARAMETERS`.
        rms_px: Root mean square distance of all corners.
        held_out_rms_px: The same over corners of views left out; None with too few views.
        coverage: Share of the picture's `COVERAGE_CELLS` that hold a corner.
        views: One entry a view, in the order given.
        warnings: What makes the result weaker than its figures look.
    """

    camera: PinholeCamera
    sigma: NDArrayFloat
    rms_px: float
    held_out_rms_px: float | None
    coverage: float
    views: tuple[ViewError, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Fit:
    matrix: NDArrayFloat
    distortion: NDArrayFloat
    rvecs: list[NDArrayFloat]
    tvecs: list[NDArrayFloat]


def estimate_intrinsics(
    views: Sequence[View], board: Board, size_px: tuple[int, int], name: str = "camera"
) -> Intrinsics:
    """The camera that took these views.

    Args:
        views: At least `FEWEST_VIEWS`, with the board at several tilts.
        board: The board in them.
        size_px: Width and height of the pictures.
        name: The camera's name.

    Raises:
        CalibrationError: With fewer views, or views that do not determine a camera (all of
            one tilt, or corners in a wrong order).
    """
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            f"{len(views)} views show the board; expected at least {FEWEST_VIEWS}, better "
            f"{_ADVISED_VIEWS} to 20, at tilts of 20 to 45 degrees all over the picture."
        )
    fit = _fit(views, board, size_px)
    _require_tilts(fit)
    residuals = [_distances(fit, k, view, board) for k, view in enumerate(views)]
    sigma = _sigma(fit, board, np.concatenate(residuals))
    _require_determined(fit, sigma, size_px)
    camera = _camera(fit, size_px, name)
    held_out = _held_out_distances(views, board, size_px)
    errors = tuple(
        ViewError(
            name=view.name,
            rms_px=_rms(residuals[k]),
            max_px=float(residuals[k].max()),
            held_out_rms_px=None if held_out is None else _rms(held_out[k]),
            tilt_deg=_tilt_deg(fit.rvecs[k]),
        )
        for k, view in enumerate(views)
    )
    covered = _coverage(views, size_px)
    return Intrinsics(
        camera=camera,
        sigma=sigma,
        rms_px=_rms(np.concatenate(residuals)),
        held_out_rms_px=None if held_out is None else _rms(np.concatenate(held_out)),
        coverage=covered,
        views=errors,
        warnings=tuple(_warnings(fit, sigma, errors, covered)),
    )


def _fit(views: Sequence[View], board: Board, size_px: tuple[int, int]) -> _Fit:
    import cv2

    corners = board.corners_board.astype(np.float32)
    seen = [view.uv.astype(np.float32).reshape(-1, 1, 2) for view in views]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
    # OpenCV reads these only with flags that are not set here.
    matrix: Any = np.eye(3)
    distortion: Any = np.zeros(5)
    threads = cv2.getNumThreads()
    try:
        # With several threads sums differ from run to run in their last digits.
        cv2.setNumThreads(1)
        found = cv2.calibrateCamera(
            [corners] * len(views), seen, size_px, matrix, distortion, criteria=stop
        )
    except cv2.error as error:
        raise CalibrationError(
            f"{len(views)} views of the board do not determine a camera ({error.err}); take more, "
            "at tilts of 20 to 45 degrees all over the picture."
        ) from error
    finally:
        cv2.setNumThreads(threads)
    _, matrix, distortion, rvecs, tvecs = found
    # Shapes differ between OpenCV 4 and 5.
    return _Fit(
        matrix=np.asarray(matrix, dtype=np.float64).reshape(3, 3),
        distortion=np.asarray(distortion, dtype=np.float64).reshape(-1)[:5],
        rvecs=[np.asarray(r, dtype=np.float64).reshape(3) for r in rvecs],
        tvecs=[np.asarray(t, dtype=np.float64).reshape(3) for t in tvecs],
    )


def _camera(fit: _Fit, size_px: tuple[int, int], name: str) -> PinholeCamera:
    k1, k2, p1, p2, k3 = (float(value) for value in fit.distortion)
    return PinholeCamera(
        name=name,
        width_px=size_px[0],
        height_px=size_px[1],
        fx=float(fit.matrix[0, 0]),
        fy=float(fit.matrix[1, 1]),
        cx=float(fit.matrix[0, 2]),
        cy=float(fit.matrix[1, 2]),
        ego_SE3_cam=SE3.identity(),
        distortion=(k1, k2, p1, p2, k3),
    )


def _require_tilts(fit: _Fit) -> None:
    """Refuse views of one orientation: each orientation tells two things of the four sought.

    Noise tilts the fitted boards a little, so that the equations alone do not show it.
    """
    widest = _widest_angle_deg(fit)
    if widest < _MIN_TILT_DEG:
        raise CalibrationError(
            f"All boards stand the same way: their normals differ by at most {widest:.1f} degrees, and so the "
            "views do not determine the focal length. Tilt the board by 20 to 45 degrees to several sides."
        )


def _widest_angle_deg(fit: _Fit) -> float:
    """Between the normals of any two boards."""
    from scipy.spatial.transform import Rotation

    normals = Rotation.from_rotvec(np.array(fit.rvecs)).as_matrix()[:, :, 2]
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))


def _sigma(fit: _Fit, board: Board, distances: NDArrayFloat) -> NDArrayFloat:
    """(9,) of `PARAMETERS`, the poses of the boards being unknown too; infinite if undetermined."""
    import cv2

    num = len(PARAMETERS)
    information = np.zeros((num, num))
    scale = np.zeros(num)
    for rvec, tvec in zip(fit.rvecs, fit.tvecs, strict=True):
        _, jacobian = cv2.projectPoints(board.corners_board, rvec, tvec, fit.matrix, fit.distortion)
        # Columns: turn, shift, focal lengths, principal point, distortion.
        jacobian = np.asarray(jacobian, dtype=np.float64)
        of_pose, of_camera = jacobian[:, :6], jacobian[:, 6 : 6 + num]
        basis, _ = np.linalg.qr(of_pose)
        # What a pose can take up of a change of the camera tells nothing about the camera.
        left = of_camera - basis @ (basis.T @ of_camera)
        information += left.T @ left
        scale += (of_camera**2).sum(axis=0)
    scale = np.sqrt(scale)
    scaled = information / np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < _SMALLEST_EIGENVALUE:
        return np.full(num, np.inf)
    free = 2 * len(distances) - num - 6 * len(fit.rvecs)
    variance = float((distances**2).sum()) / max(free, 1)
    return np.asarray(np.sqrt(variance * np.diag(np.linalg.inv(scaled))) / scale)


def _require_determined(fit: _Fit, sigma: NDArrayFloat, size_px: tuple[int, int]) -> None:
    focal = np.array([fit.matrix[0, 0], fit.matrix[1, 1]])
    share = sigma[:2] / focal
    if not np.isfinite(sigma).all() or (share > _MAX_SIGMA_SHARE).any():
        raise CalibrationError(
            f"The views do not determine the focal length: {focal[0]:.0f} and {focal[1]:.0f} px with "
            f"standard deviations of {100 * share[0]:.1f} and {100 * share[1]:.1f} %. Boards parallel to "
            "the picture, or all of one tilt, say nothing about it; tilt the board by 20 to 45 "
            "degrees to several sides."
        )
    centre = fit.matrix[:2, 2]
    if (centre < 0).any() or (centre > size_px).any():
        raise CalibrationError(
            f"The principal point came out at ({centre[0]:.0f}, {centre[1]:.0f}), outside the "
            f"{size_px[0]}x{size_px[1]} picture: cropped pictures, a wrong board size, or views of too "
            "little variety. Use pictures as the camera gives them, with the board tilted."
        )


def _distances(fit: _Fit, index: int, view: View, board: Board) -> NDArrayFloat:
    """(N,) pixels."""
    return _reprojected(fit, board.corners_board, fit.rvecs[index], fit.tvecs[index], view.uv)


def _reprojected(
    fit: _Fit, corners: NDArrayFloat, rvec: NDArrayFloat, tvec: NDArrayFloat, uv: NDArrayFloat
) -> NDArrayFloat:
    import cv2

    projected, _ = cv2.projectPoints(corners, rvec, tvec, fit.matrix, fit.distortion)
    difference = np.asarray(projected, dtype=np.float64).reshape(-1, 2) - uv
    return np.asarray(np.linalg.norm(difference, axis=1))


def _held_out_distances(
    views: Sequence[View], board: Board, size_px: tuple[int, int]
) -> list[NDArrayFloat] | None:
    """A list of (N / 2,) pixels, one a view; None where too few views would remain."""
    import cv2

    folds = min(_FOLDS, len(views))
    if len(views) - -(-len(views) // folds) < FEWEST_VIEWS:
        return None
    # A checker of corners: both halves span the whole board.
    rows, columns = np.indices((board.rows, board.columns))
    is_given = ((rows + columns) % 2 == 0).ravel()
    distances: list[NDArrayFloat] = [np.empty(0)] * len(views)
    for fold in range(folds):
        fit = _fit([v for k, v in enumerate(views) if k % folds != fold], board, size_px)
        for k in range(fold, len(views), folds):
            uv, corners = views[k].uv, board.corners_board
            done, rvec, tvec = cv2.solvePnP(
                corners[is_given], uv[is_given], fit.matrix, fit.distortion
            )
            if not done:
                raise CalibrationError(
                    f"The board in {views[k].name} fits no pose with the camera found from the other "
                    "views; look at this picture, and leave it out."
                )
            turn, shift = (np.asarray(v, dtype=np.float64).reshape(3) for v in (rvec, tvec))
            distances[k] = _reprojected(fit, corners[~is_given], turn, shift, uv[~is_given])
    return distances


def _coverage(views: Sequence[View], size_px: tuple[int, int]) -> float:
    counts = coverage_counts(views, size_px)
    return float((counts > 0).mean())


def coverage_counts(views: Sequence[View], size_px: tuple[int, int]) -> NDArrayFloat:
    """(rows, columns) of `COVERAGE_CELLS`: corners of all views in each cell of the picture."""
    columns, rows = COVERAGE_CELLS
    uv = np.concatenate([view.uv for view in views]) + 0.5
    counts, _, _ = np.histogram2d(
        uv[:, 1], uv[:, 0], bins=(rows, columns), range=((0, size_px[1]), (0, size_px[0]))
    )
    return np.asarray(counts)


def _tilt_deg(rvec: NDArrayFloat) -> float:
    from scipy.spatial.transform import Rotation

    cosine = abs(float(Rotation.from_rotvec(rvec).as_matrix()[2, 2]))
    return float(np.degrees(np.arccos(min(cosine, 1.0))))


def _rms(distances: NDArrayFloat) -> float:
    return float(np.sqrt(np.mean(np.square(distances))))


def _warnings(
    fit: _Fit, sigma: NDArrayFloat, errors: Sequence[ViewError], covered: float
) -> list[str]:
    said = []
    if len(errors) < _ADVISED_VIEWS:
        said.append(f"only {len(errors)} views; {_ADVISED_VIEWS} to 20 are advised")
    share = float((sigma[:2] / (fit.matrix[0, 0], fit.matrix[1, 1])).max())
    if share > _WEAK_SIGMA_SHARE:
        said.append(
            f"the focal length is known to {100 * share:.2f} % (one standard deviation); tilt the "
            "board more, and bring it nearer"
        )
    if (widest := _widest_angle_deg(fit)) < _WEAK_TILT_DEG:
        said.append(
            f"the boards' normals differ by at most {widest:.0f} degrees; tilt the board more, to "
            "several sides"
        )
    if covered < _MIN_COVERAGE:
        said.append(
            f"corners lie in {covered:.0%} of the picture's cells; where there are none, the "
            "distortion is a guess"
        )
    typical = float(np.median([view.rms_px for view in errors]))
    said += [
        f"{view.name}: {view.rms_px:.2f} px, the others {typical:.2f} px; look at it and leave it out"
        for view in errors
        if view.rms_px > max(_BAD_VIEW_FACTOR * typical, _BAD_VIEW_PX)
    ]
    return said
