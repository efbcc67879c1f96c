"""Rigid transforms in space, and the trajectory they make over time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hdmap_tools.errors import PoseError, ShapeError
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt


def _frozen(array: NDArrayFloat) -> NDArrayFloat:
    array = np.array(array, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class SE3:
    """A rigid transform ``dst_SE3_src``: takes points of frame src into frame dst.

    Attributes:
        rotation: (3, 3) orthonormal, determinant +1.
        translation: (3,) metres; the origin of src, seen in dst.
    """

    rotation: NDArrayFloat
    translation: NDArrayFloat

    def __post_init__(self) -> None:
        rotation, translation = _frozen(self.rotation), _frozen(self.translation)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ShapeError(
                f"SE3 needs a (3, 3) rotation and a (3,) translation, "
                f"found {rotation.shape} and {translation.shape}."
            )
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise ShapeError("SE3 holds NaN or infinite values; expected finite numbers.")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
            raise ShapeError(
                "SE3 rotation is not orthonormal with determinant +1 (tolerance 1e-6); "
                "normalize the quaternion or matrix first."
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls) -> SE3:
        """The transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(
        cls, qw: float, qx: float, qy: float, qz: float, xyz_m: NDArrayFloat
    ) -> SE3:
        """From a quaternion, scalar first (normalized here), and a translation in metres."""
        quaternion = np.array([qx, qy, qz, qw], dtype=np.float64)
        with np.errstate(over="ignore"):  # an overflow is reported below
            norm = float(np.linalg.norm(quaternion))
        if not np.isfinite(norm) or norm < 1e-9:
            raise ShapeError(f"Quaternion (w, x, y, z) = {(qw, qx, qy, qz)} has no direction.")
        return cls(Rotation.from_quat(quaternion).as_matrix(), np.asarray(xyz_m, dtype=np.float64))

    @classmethod
    def from_matrix(cls, matrix: NDArrayFloat) -> SE3:
        """From a (4, 4) homogeneous matrix with last row (0, 0, 0, 1)."""
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (4, 4):
            raise ShapeError(f"A homogeneous transform is (4, 4), found {matrix.shape}.")
        if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0, atol=1e-9):
            raise ShapeError(
                f"A homogeneous transform ends with the row (0, 0, 0, 1), found {matrix[3].tolist()}; "
                "is it transposed?"
            )
        return cls(matrix[:3, :3], matrix[:3, 3])

    @classmethod
    def from_yaw(cls, yaw_rad: float, xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SE3:
        """A turn about z (counter-clockwise positive) and a translation in metres."""
        return cls(Rotation.from_euler("z", yaw_rad).as_matrix(), np.array(xyz_m))

    @property
    def matrix(self) -> NDArrayFloat:
        """(4, 4) homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    @property
    def quaternion_wxyz(self) -> NDArrayFloat:
        """(4,) unit quaternion, scalar first and not negative."""
        x, y, z, w = Rotation.from_matrix(self.rotation).as_quat(canonical=True)
        return np.array([w, x, y, z])

    @property
    def yaw_rad(self) -> float:
        """Heading of src's x axis in dst's x-y plane, radians, counter-clockwise."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    def compose(self, other: SE3) -> SE3:
        """``a_SE3_b.compose(b_SE3_c)`` is ``a_SE3_c``; also written ``a @ b``."""
        rotation = self.rotation @ other.rotation
        # One Newton step back onto the rotations keeps long chains orthonormal.
        rotation = rotation @ (1.5 * np.eye(3) - 0.5 * rotation.T @ rotation)
        return SE3(rotation, self.rotation @ other.translation + self.translation)

    __matmul__ = compose

    def inverse(self) -> SE3:
        """``dst_SE3_src`` becomes ``src_SE3_dst``."""
        return SE3(self.rotation.T, -self.rotation.T @ self.translation)

    def transform_from(self, points_src: NDArrayFloat) -> NDArrayFloat:
        """Take points (N, 3) of frame src, metres, into frame dst."""
        points_src = np.asarray(points_src, dtype=np.float64)
        if points_src.ndim != 2 or points_src.shape[1] != 3:
            raise ShapeError(f"Points must be (N, 3), found {points_src.shape}.")
        return points_src @ self.rotation.T + self.translation


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Ego poses over time, ``city_SE3_ego`` at strictly increasing times.

    Attributes:
        timestamps_ns: (N,) int64, strictly increasing, N at least 1.
        rotations: (N, 3, 3).
        translations: (N, 3) metres, city frame.
    """

    timestamps_ns: NDArrayInt
    rotations: NDArrayFloat
    translations: NDArrayFloat

    def __post_init__(self) -> None:
        times = np.array(self.timestamps_ns, dtype=np.int64)
        rotations, translations = _frozen(self.rotations), _frozen(self.translations)
        if times.ndim != 1 or len(times) == 0:
            raise PoseError("A trajectory needs at least one pose, found none.")
        if rotations.shape != (len(times), 3, 3) or translations.shape != (len(times), 3):
            raise ShapeError(
                f"Trajectory of {len(times)} times has rotations {rotations.shape} "
                f"and translations {translations.shape}."
            )
        if not (np.isfinite(rotations).all() and np.isfinite(translations).all()):
            raise PoseError("The trajectory holds NaN or infinite poses; expected finite numbers.")
        off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        bad = np.flatnonzero((off > 1e-6) | (np.linalg.det(rotations) < 0))
        if len(bad):
            raise PoseError(
                f"The rotation of pose {bad[0]} is not orthonormal with determinant +1 (tolerance "
                f"1e-6); {len(bad)} of {len(times)} are not."
            )
        if np.any(times[1:] <= times[:-1]):
            raise PoseError("Pose times must strictly increase; sort them and drop duplicates.")
        times.setflags(write=False)
        object.__setattr__(self, "timestamps_ns", times)
        object.__setattr__(self, "rotations", rotations)
        object.__setattr__(self, "translations", translations)

    @classmethod
    def from_quaternions(
        cls, timestamps_ns: NDArrayInt, wxyz: NDArrayFloat, xyz_m: NDArrayFloat
    ) -> Trajectory:
        """From times (N,), quaternions (N, 4) scalar first, translations (N, 3).

        Rows are sorted by time; of several rows at one time the first is kept.
        """
        times = np.asarray(timestamps_ns, dtype=np.int64)
        wxyz, xyz_m = np.asarray(wxyz, dtype=np.float64), np.asarray(xyz_m, dtype=np.float64)
        if len(times) == 0:
            raise PoseError("A trajectory needs at least one pose, found none.")
        if wxyz.shape != (len(times), 4) or xyz_m.shape != (len(times), 3):
            raise ShapeError(
                f"{len(times)} pose times need quaternions ({len(times)}, 4) and translations "
                f"({len(times)}, 3), found {wxyz.shape} and {xyz_m.shape}."
            )
        with np.errstate(over="ignore"):  # an overflow is reported below
            norms = np.linalg.norm(wxyz, axis=1)
        if not np.isfinite(norms).all() or (norms < 1e-9).any():
            row = int(np.flatnonzero(~np.isfinite(norms) | (norms < 1e-9))[0])
            raise PoseError(f"Pose {row} has no usable quaternion: {wxyz[row].tolist()}.")
        times, first = np.unique(times, return_index=True)
        rotations = Rotation.from_quat(wxyz[first][:, [1, 2, 3, 0]]).as_matrix()
        return cls(times, rotations, xyz_m[first])

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def length_m(self) -> float:
        """Length of the driven path in the x-y plane, metres."""
        return float(np.linalg.norm(np.diff(self.translations[:, :2], axis=0), axis=1).sum())

    def pose(self, index: int) -> SE3:
        """The index-th given pose, ``city_SE3_ego``."""
        return SE3(self.rotations[index], self.translations[index])

    def covers(self, timestamps_ns: NDArrayInt, max_gap_s: float) -> NDArrayBool:
        """Which times have a pose: exactly there, or on both sides no more than max_gap_s apart."""
        times = np.atleast_1d(np.asarray(timestamps_ns, dtype=np.int64))
        right = np.searchsorted(self.timestamps_ns, times)
        exact = (right < len(self)) & (
            self.timestamps_ns[np.minimum(right, len(self) - 1)] == times
        )
        inside = (right > 0) & (right < len(self))
        after = np.clip(right, 1, max(len(self) - 1, 1))
        after = np.minimum(after, len(self) - 1)
        gap_ns = self.timestamps_ns[after] - self.timestamps_ns[np.maximum(after - 1, 0)]
        return np.asarray(exact | (inside & (gap_ns <= max_gap_s * 1e9)))

    def interpolate(self, timestamp_ns: int, max_gap_s: float = 0.5) -> SE3:
        """The ego pose ``city_SE3_ego`` at a time, by slerp and lerp.

        Raises:
            PoseError: If the time lies outside the trajectory, or in a gap
                longer than max_gap_s.
        """
        if not self.covers(np.array([timestamp_ns]), max_gap_s)[0]:
            first, last = int(self.timestamps_ns[0]), int(self.timestamps_ns[-1])
            raise PoseError(
                f"No ego pose at {timestamp_ns} ns: poses run from {first} to {last} ns and the "
                f"gap allowed is {max_gap_s} s (max_pose_gap_s)."
            )
        rotations, translations = self.interpolate_many(np.array([timestamp_ns]))
        return SE3(rotations[0], translations[0])

    @cached_property
    def _knots_s(self) -> NDArrayFloat:
        # Relative seconds: nanoseconds since 1970 do not fit a float64.
        return np.asarray((self.timestamps_ns - self.timestamps_ns[0]) / 1e9)

    @cached_property
    def _slerp(self) -> Slerp:
        return Slerp(self._knots_s, Rotation.from_matrix(self.rotations))

    def interpolate_many(self, timestamps_ns: NDArrayInt) -> tuple[NDArrayFloat, NDArrayFloat]:
        """Rotations (M, 3, 3) and translations (M, 3) at many times.

        Times outside the trajectory take the nearest end: check with `covers` first.
        """
        times = np.clip(
            np.asarray(timestamps_ns, dtype=np.int64), self.timestamps_ns[0], self.timestamps_ns[-1]
        )
        if len(self) == 1:
            count = len(times)
            return np.tile(self.rotations, (count, 1, 1)), np.tile(self.translations, (count, 1))
        # Only the poses around these times: a sweep spans a few of a drive's 100,000.
        first, last = 0, 1
        if len(times):
            first = int(np.searchsorted(self.timestamps_ns, times.min(), side="right")) - 1
            first = min(first, len(self) - 2)
            last = max(int(np.searchsorted(self.timestamps_ns, times.max())), first + 1)
        near = slice(first, last + 1)
        query = (times - self.timestamps_ns[0]) / 1e9
        rotations = self._slerp(query).as_matrix()
        translations = np.column_stack(
            [np.interp(query, self._knots_s[near], self.translations[near, k]) for k in range(3)]
        )
        exact = np.searchsorted(self.timestamps_ns, times)
        hit = self.timestamps_ns[exact] == times
        rotations[hit] = self.rotations[exact[hit]]
        translations[hit] = self.translations[exact[hit]]
        return rotations, translations
