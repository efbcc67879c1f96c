"""A drive: cameras, lidar sweeps and ego poses over time, read lazily."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from hdmap_tools.errors import DriveError, ShapeError, SweepError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.readers.checks import MAX_RANGE_M
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayInt


@dataclass(frozen=True, eq=False)
class Sweep:
    """One turn of the lidar.

    Attributes:
        timestamp_ns: Time of the ego pose that the points refer to.
        points_ego: (N, 3) float64 metres, ego frame at timestamp_ns, finite, and
            ego-motion compensated where the data gives a time for each point.
        intensity: (N,) uint8, 0..255 as the sensor gives it.
        ring: (N,) uint8 laser number; zeros when unknown.
    """

    timestamp_ns: int
    points_ego: NDArrayFloat
    intensity: NDArrayByte
    ring: NDArrayByte

    def __post_init__(self) -> None:
        count = len(self.points_ego)
        if (
            self.points_ego.shape != (count, 3)
            or self.intensity.shape != (count,)
            or self.ring.shape != (count,)
        ):
            raise ShapeError(
                f"A sweep needs points (N, 3), intensity (N,) and ring (N,), found "
                f"{self.points_ego.shape}, {self.intensity.shape}, {self.ring.shape}."
            )


@dataclass(frozen=True)
class SweepRef:
    """Where a sweep lies; `Drive.read_sweep` reads it."""

    timestamp_ns: int
    path: Path
    sensor: str


@dataclass(frozen=True)
class ImageRef:
    """Where an image lies and when it was taken; `read_image` reads it."""

    camera: str
    timestamp_ns: int
    path: Path

    @property
    def key(self) -> str:
        """``<camera>/<timestamp_ns>``: names its label image in caches and label folders."""
        return f"{self.camera}/{self.timestamp_ns}"


@dataclass(frozen=True, eq=False)
class Drive:
    """One recorded or simulated drive.

    Attributes:
        name: Log or scene name; with `layout` it identifies the drive in a map's history.
        layout: Name of the reader, for example ``nuscenes`` or ``av2``.
        root: Folder it was read from.
        frame: The city frame of the poses.
        trajectory: ``city_SE3_ego`` over time.
        cameras: Calibrated cameras by name; only those that can be used.
        images: All images of those cameras, by time.
        sweeps: All lidar sweeps, by time.
        reference_maps: Existing maps of the place that lie in the drive's folder.
        warnings: What was left out while listing, one line each.
        read_sweep: Reads one sweep, ego-motion compensated.
    """

    name: str
    layout: str
    root: Path
    frame: MapFrame
    trajectory: Trajectory
    cameras: Mapping[str, PinholeCamera]
    images: tuple[ImageRef, ...]
    sweeps: tuple[SweepRef, ...]
    read_sweep: Callable[[SweepRef], Sweep] = field(repr=False)
    reference_maps: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        unknown = sorted({image.camera for image in self.images} - set(self.cameras))
        if unknown:
            raise DriveError(
                f"Drive {self.name}: images of uncalibrated cameras {', '.join(unknown)}."
            )
        object.__setattr__(
            self, "images", tuple(sorted(self.images, key=lambda i: (i.timestamp_ns, i.camera)))
        )
        object.__setattr__(self, "sweeps", tuple(sorted(self.sweeps, key=lambda s: s.timestamp_ns)))

    @property
    def id(self) -> str:
        """``<layout>:<name>``."""
        return f"{self.layout}:{self.name}"

    @cached_property
    def _sweep_times_ns(self) -> NDArrayInt:
        return np.array([s.timestamp_ns for s in self.sweeps], dtype=np.int64)

    def nearest_sweep(self, timestamp_ns: int, max_gap_s: float) -> SweepRef | None:
        """The sweep nearest in time, or None when all are further away than max_gap_s."""
        if not self.sweeps:
            return None
        times = self._sweep_times_ns
        after = int(np.searchsorted(times, timestamp_ns))
        near = range(max(after - 1, 0), min(after + 1, len(times)))
        index = min(near, key=lambda k: abs(int(times[k]) - timestamp_ns))
        return (
            self.sweeps[index] if abs(int(times[index]) - timestamp_ns) <= max_gap_s * 1e9 else None
        )


def keep_usable(values: NDArrayFloat) -> tuple[NDArrayFloat, int]:
    """Rows (M, C) of points (N, C), x y z first, metres, and how many were dropped.

    Dropped are rows with a value that is NaN or infinite, and points further from
    the sensor than `MAX_RANGE_M`.
    """
    usable = np.isfinite(values).all(axis=1) & is_usable(values[:, :3])
    return values[usable], int((~usable).sum())


def is_usable(points: NDArrayFloat) -> NDArrayBool:
    """Which points (N, 3), metres, are finite and no further from the sensor than `MAX_RANGE_M`."""
    # NaN compares as False, infinity as too far. Nearly always all are good: no test by row.
    if len(points) and points.max() <= MAX_RANGE_M and points.min() >= -MAX_RANGE_M:
        return np.ones(len(points), dtype=bool)
    return np.asarray((np.abs(points) <= MAX_RANGE_M).all(axis=1))


def to_bytes(values: NDArrayAny, name: str, path: Path) -> NDArrayByte:
    """Finite sensor values (N,) as uint8, rounded.

    Raises:
        SweepError: If a value lies outside 0..255: clipping or wrapping it would
            change what the intensity means without a word.
    """
    if values.dtype == np.uint8:
        return values
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    if low < 0 or high > 255:
        raise SweepError(f"Sweep {path}: {name} runs from {low:g} to {high:g}; expected 0..255.")
    return np.asarray(np.rint(values), dtype=np.uint8)
