"""What fusion asks of a drive frame by frame: poses, sweeps, the ground, and what an image says of it."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from hdmap_tools.ahead import made_ahead
from hdmap_tools.association.dense import associate_dense, clip_bounds_m
from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.live_returns import LiveReturns
from hdmap_tools.association.lookup import camera_position
from hdmap_tools.association.observations import Observations
from hdmap_tools.association.planar import associate_planar, ground_plane
from hdmap_tools.association.sparse import associate_sparse
from hdmap_tools.association.surface import associate_surface
from hdmap_tools.config import AssociationConfig, Config
from hdmap_tools.errors import DriveError, PointMapError, PoseError
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.dense_fusion import DenseFusion
from hdmap_tools.fusion.point_blocks import POINTS_BYTES
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.memory_budget import MemoryBudget
from hdmap_tools.opening import require_images
from hdmap_tools.point_map.point_map import PointMap
from hdmap_tools.readers.drive import Drive, ImageRef, SweepRef
from hdmap_tools.types import NDArrayByte, NDArrayFloat

LabelledImages = Iterable[tuple[ImageRef, NDArrayByte]]

Standing = tuple[NDArrayFloat, float] | tuple[()]
"""Returns of a sweep that are not ground (M, 3), city metres, and the angle between its rings."""


@dataclass
class FrameCounts:
    """How many images were used, and why others were not.

    Attributes:
        used: Images that were fused.
        dropped: Number of images by reason.
        observations: Labelled ground points by camera, of the main method.
    """

    used: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    observations: Counter[str] = field(default_factory=Counter)


class GroundedSweeps:
    """The sweeps near a drive's images, each with its ground; keeps the last, which several cameras share."""

    def __init__(self, drive: Drive, config: Config) -> None:
        self._drive = drive
        self._config = config
        self._last: tuple[int, GroundedSweep] | None = None

    def ref(self, image: ImageRef) -> SweepRef | None:
        """The sweep nearest to an image in time, if it is near enough and has a pose."""
        config = self._config.drive
        ref = self._drive.nearest_sweep(image.timestamp_ns, config.max_sweep_gap_s)
        if ref is None:
            return None
        time = np.array([ref.timestamp_ns], dtype=np.int64)
        has_pose = self._drive.trajectory.covers(time, config.max_pose_gap_s)[0]
        return ref if has_pose else None

    def near(self, image: ImageRef) -> GroundedSweep | None:
        """The sweep nearest to an image, with its ground."""
        ref = self.ref(image)
        if ref is None:
            return None
        if self._last is None or self._last[0] != ref.timestamp_ns:
            sweep = self._drive.read_sweep(ref)
            association = self._config.association
            grounded = GroundedSweep.from_sweep(
                sweep,
                self._drive.trajectory.interpolate(
                    sweep.timestamp_ns, self._config.drive.max_pose_gap_s
                ),
                association.max_range_m,
                association.ground_tolerance_m,
            )
            self._last = (ref.timestamp_ns, grounded)
        return self._last[1]


class FrameSource:
    """Poses and sweeps of a drive's images, and the point map around them.

    Args:
        drive: The drive, at the poses to be used.
        config: How its images are associated.
        sweeps: Sweeps of the same drive, shared with another source.
        memory: What may be kept of the point map.

    Raises:
        PointMapError: If a method needs a point map and there is none to open.
    """

    def __init__(
        self,
        drive: Drive,
        config: Config,
        sweeps: GroundedSweeps | None = None,
        memory: MemoryBudget | None = None,
    ) -> None:
        self._drive = drive
        self._config = config
        self.sweeps = sweeps or GroundedSweeps(drive, config)
        self._pose = lru_cache(maxsize=64)(drive.trajectory.interpolate)
        self._points: PointMap | None = None
        self._live: LiveReturns | None = None
        self._engine: DenseFusion | None = None
        self._points_bytes = POINTS_BYTES if memory is None else memory.points_bytes
        if config.association.needs_points:
            if config.association.points is None:
                raise PointMapError(
                    "Method 'dense' needs a point map: make one with `hdmap points` and give it with --points."
                )
            self._points = PointMap.open(config.association.points)
            gap_s = config.drive.max_pose_gap_s
            self._live = LiveReturns(drive, self._points, config.association, gap_s)

    @property
    def methods(self) -> tuple[str, ...]:
        """The configured method of association, then those to compare with."""
        association = self._config.association
        also = [m for m in association.also if m != association.method]
        return (association.method, *dict.fromkeys(also))

    def allows(self, method: str, image: ImageRef) -> bool:
        """Whether a method has what it needs at an image: ``surface`` and ``sparse`` need a sweep."""
        return method in ("planar", "dense") or self.sweep_ref(image) is not None

    def usable_images(self, counts: FrameCounts) -> tuple[ImageRef, ...]:
        """Images with a pose (and a sweep, where the method needs one); the rest is counted.

        Raises:
            DriveError: If the drive has no image at all.
            PoseError: If a camera has no image with a pose.
        """
        drive, config = self._drive, self._config
        require_images(drive)
        times = np.array([image.timestamp_ns for image in drive.images], dtype=np.int64)
        has_pose = drive.trajectory.covers(times, config.drive.max_pose_gap_s)
        with_pose = [i for i, ok in zip(drive.images, has_pose, strict=True) if ok]
        for camera in sorted({image.camera for image in drive.images}):
            if not any(image.camera == camera for image in with_pose):
                first, last = drive.trajectory.timestamps_ns[[0, -1]]
                raise PoseError(
                    f"Camera {camera}: no image has an ego pose. Poses run from {first} to {last} ns; "
                    f"the gap allowed is drive.max_pose_gap_s = {config.drive.max_pose_gap_s} s. Leave "
                    "the camera out with --camera, or repair the poses."
                )
        counts.dropped["no ego pose"] = len(drive.images) - len(with_pose)
        usable = [image for image in with_pose if self.allows(config.association.method, image)]
        if not usable:
            raise DriveError(
                f"Drive {drive.name}: no image has a lidar sweep within drive.max_sweep_gap_s = "
                f"{config.drive.max_sweep_gap_s} s ({len(drive.sweeps)} sweeps). Use "
                "association.method: planar, which needs no lidar, or allow a longer gap."
            )
        counts.dropped["no lidar sweep near in time"] = len(with_pose) - len(usable)
        return tuple(usable)

    def pose(self, timestamp_ns: int) -> SE3:
        """``city_SE3_ego`` at a time."""
        return self._pose(timestamp_ns, self._config.drive.max_pose_gap_s)

    def sweep_ref(self, image: ImageRef) -> SweepRef | None:
        """The sweep nearest to an image in time, if it is near enough and has a pose."""
        return self.sweeps.ref(image)

    def grounded_sweep(self, image: ImageRef) -> GroundedSweep | None:
        """The sweep nearest to an image, with its ground."""
        return self.sweeps.near(image)

    def with_live_returns(
        self, labelled: LabelledImages
    ) -> Iterator[tuple[ImageRef, NDArrayByte, Standing]]:
        """Labelled images with what stood around the vehicle, read and found while others are fused."""

        def found(pair: tuple[ImageRef, NDArrayByte]) -> tuple[ImageRef, NDArrayByte, Standing]:
            return *pair, self.standing(pair[0])

        # One thread: it keeps the last sweeps, which several cameras share.
        return made_ahead(labelled, found)

    def count(
        self,
        method: str,
        image: ImageRef,
        labels: NDArrayByte,
        counts: CellCounts,
        live: Standing,
    ) -> int:
        """Add what one image says of the ground to counts; gives how many points it labelled.

        Args:
            method: Of association.
            image: Names camera and time.
            labels: (height, width) uint8 ids.
            counts: Changed.
            live: What `standing` gives.
        """
        meta, key = counts.meta, frame_key(image)
        if method != "dense" or meta.range_edges_m:
            seen = self.observe(method, image, labels, meta.label_set, meta.resolution_m, live)
            counts.add(seen, key)
            return len(seen)
        assert self._points is not None
        if self._engine is None or self._engine.meta != meta:
            self._engine = DenseFusion(
                self._points, meta, self._config.association, self._points_bytes
            )
        camera, pose = self._drive.cameras[image.camera], self.pose(image.timestamp_ns)
        return self._engine.add(counts, labels, camera, pose, key, *live)

    def standing(self, image: ImageRef) -> Standing:
        """What stood around the vehicle, for ``dense``; nothing where no sweep is near."""
        ref = self.sweep_ref(image)
        if ref is None or self._live is None or not self._config.association.occlusion_test:
            return ()
        camera, pose = self._drive.cameras[image.camera], self.pose(image.timestamp_ns)
        standing = self._live.standing_city(ref, camera, pose)
        return standing, self._live.ring_gap_deg(ref.sensor)

    def observe(
        self,
        method: str,
        image: ImageRef,
        labels: NDArrayByte,
        label_set: LabelSet,
        resolution_m: float,
        live: Standing | None = None,
    ) -> Observations:
        """What one image says about the ground, by one method of association.

        Args:
            method: Of association.
            image: Names camera and time.
            labels: (height, width) uint8 ids.
            label_set: What they mean.
            resolution_m: Of the cells that ``surface`` and ``planar`` look up.
            live: What `standing` gives, where it was asked already.
        """
        seen = self._associate(method, image, labels, label_set, resolution_m, live)
        if not self._config.fusion.range_edges_m:
            return seen
        camera = camera_position(self._drive.cameras[image.camera], self.pose(image.timestamp_ns))
        away = np.linalg.norm(seen.points_city[:, :2] - camera[:2], axis=1)
        return replace(seen, range_m=away)

    def _associate(
        self,
        method: str,
        image: ImageRef,
        labels: NDArrayByte,
        label_set: LabelSet,
        resolution_m: float,
        live: Standing | None,
    ) -> Observations:
        config: AssociationConfig = self._config.association
        camera, pose = self._drive.cameras[image.camera], self.pose(image.timestamp_ns)
        if method == "dense":
            assert self._points is not None
            points = self._points.points_in(clip_bounds_m(pose, config))
            live = self.standing(image) if live is None else live
            return associate_dense(labels, label_set, camera, pose, points, config, *live)
        grounded = self.grounded_sweep(image)
        if method == "planar":
            plane_pose = pose if grounded is None else grounded.city_SE3_ego
            return associate_planar(
                labels,
                label_set,
                camera,
                pose,
                ground_plane(grounded),
                plane_pose,
                resolution_m,
                config,
            )
        if grounded is None:
            raise DriveError(f"No lidar sweep near image {image.key}; method {method!r} needs one.")
        if method == "sparse":
            return associate_sparse(labels, label_set, camera, pose, grounded, config)
        return associate_surface(labels, label_set, camera, pose, grounded, resolution_m, config)


def frame_key(image: ImageRef) -> int:
    """A number that names a frame, the same in every run; breaks ties between labels."""
    return int.from_bytes(hashlib.sha256(image.key.encode()).digest()[:8], "little")
