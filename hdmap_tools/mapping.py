"""From a drive and its labels to counts: association and fusion, frame by frame."""

from __future__ import annotations

import hashlib
import json
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hdmap_tools.ahead import made_ahead, taken_ahead
from hdmap_tools.association.dense import associate_dense, clip_bounds_m
from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.live_returns import LiveReturns
from hdmap_tools.association.lookup import camera_position
from hdmap_tools.association.observations import Observations
from hdmap_tools.association.planar import associate_planar, ground_plane
from hdmap_tools.association.sparse import associate_sparse
from hdmap_tools.association.surface import associate_surface
from hdmap_tools.config import AssociationConfig, Config
from hdmap_tools.errors import ConfigError, DriveError, PointMapError, PoseError
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.dense_fusion import DenseFusion
from hdmap_tools.fusion.intensity import otsu_threshold
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.fusion.tiles_on_disk import TilesOnDisk
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, LabelSet
from hdmap_tools.memory_budget import MemoryBudget
from hdmap_tools.opening import require_images
from hdmap_tools.point_map.point_map import PointMap
from hdmap_tools.readers.drive import Drive, ImageRef, SweepRef
from hdmap_tools.segmentation.cache import LabelCache, SegmentProgress, segment_drive
from hdmap_tools.segmentation.known_confusion import confusion_of
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.steps import Steps
from hdmap_tools.types import NDArrayByte, NDArrayFloat

_LOG = logging.getLogger(__name__)

LabelledImages = Iterable[tuple[ImageRef, NDArrayByte]]

Standing = tuple[NDArrayFloat, float] | tuple[()]
"""Returns of a sweep that are not ground (M, 3), city metres, and the angle between its rings."""

Elsewhere = Callable[[SemanticMap, list[int], "FrameCounts", "SegmentProgress | None"], None]
"""Adds segments, by number, to a map; tells counts what went in, and progress of it."""

_THRESHOLD_WITHOUT_LIDAR = 128
_IMAGES_FOR_THRESHOLD = 24


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
        self._memory = memory
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
            return *pair, self.live_returns(pair[0])

        # One thread: it keeps the last sweeps, which several cameras share.
        return made_ahead(labelled, found)

    def live_returns(self, image: ImageRef) -> Standing:
        """What `count` wants to know of an image's sweep."""
        in_bands = bool(self._config.fusion.range_edges_m)  # `observe` then asks by itself
        return () if in_bands else self.standing(image)

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
            live: What `live_returns` gives.
        """
        meta, key = counts.meta, frame_key(image)
        if method != "dense" or meta.range_edges_m:
            seen = self.observe(method, image, labels, meta.label_set, meta.resolution_m)
            counts.add(seen, key)
            return len(seen)
        assert self._points is not None
        if self._engine is None or self._engine.meta != meta:
            limit = {} if self._memory is None else {"max_bytes": self._memory.points_bytes}
            self._engine = DenseFusion(self._points, meta, self._config.association, **limit)
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
    ) -> Observations:
        """What one image says about the ground, by one method of association."""
        seen = self._associate(method, image, labels, label_set, resolution_m)
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
    ) -> Observations:
        config: AssociationConfig = self._config.association
        camera, pose = self._drive.cameras[image.camera], self.pose(image.timestamp_ns)
        if method == "dense":
            assert self._points is not None
            points = self._points.points_in(clip_bounds_m(pose, config))
            live = self.standing(image)
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


def map_meta(config: Config, drive: Drive, segmenter: Segmenter, threshold: int) -> MapMeta:
    """What a map built from this drive with this configuration and network means."""
    confusion = confusion_of(segmenter)
    return MapMeta(
        resolution_m=config.fusion.resolution_m,
        label_set=segmenter.label_set,
        count_mode=config.fusion.count_mode,
        intensity_threshold=threshold,
        range_edges_m=config.fusion.range_edges_m,
        reference_height_m=config.fusion.reference_height_m,
        frame_document=drive.frame.to_json(),
        model=segmenter.name,
        confusion=None if confusion is None else json.loads(confusion.to_json()),
    )


def fuse(
    source: FrameSource,
    labelled: LabelledImages,
    meta: MapMeta,
    commits: Mapping[str, Callable[[CellCounts], object]],
    counts: FrameCounts,
    folder: Path,
    memory: MemoryBudget | None = None,
) -> None:
    """Associate and count the labelled images of a segment, by each method on its own.

    Args:
        source: Poses and sweeps; its `methods` are used.
        labelled: Images with their label images.
        meta: What the counts mean.
        commits: By method, what takes the counts of a segment.
        counts: Told how many images were used, and what they saw.
        folder: For tiles that memory has no room for.
        memory: What may be kept in memory; None: all.
    """
    with ExitStack() as stack:
        segments = {}
        for method in source.methods:
            tiles = None
            if memory is not None:
                aside = stack.enter_context(TemporaryDirectory(prefix=".tiles.", dir=folder))
                share = memory.tiles_bytes(meta) // len(source.methods)
                tiles = TilesOnDisk(Path(aside), share)
            segments[method] = CellCounts(meta, tiles)
        count_images(source, labelled, segments, counts)
        for method, segment in segments.items():
            if segment.num_frames:
                commits[method](segment)


def count_images(
    source: FrameSource,
    labelled: LabelledImages,
    segments: Mapping[str, CellCounts],
    counts: FrameCounts,
    *,
    ahead: bool = True,
) -> None:
    """Add labelled images to counts, by each method on its own.

    Args:
        source: Poses and sweeps.
        labelled: Images with their label images.
        segments: Counts by method, changed.
        counts: Told how many images were used, and what they saw.
        ahead: Read images and sweeps in other threads while these are counted; off where other
            processes have the other cores.
    """
    prepared = (
        source.with_live_returns(taken_ahead(labelled))
        if ahead
        else ((image, labels, source.live_returns(image)) for image, labels in labelled)
    )
    for image, labels, live in prepared:
        for method, segment in segments.items():
            if not source.allows(method, image):
                continue
            seen = source.count(method, image, labels, segment, live)
            if method == source.methods[0]:
                counts.observations[image.camera] += seen
        counts.used += 1


def frame_key(image: ImageRef) -> int:
    """A number that names a frame, the same in every run; breaks ties between labels."""
    return int.from_bytes(hashlib.sha256(image.key.encode()).digest()[:8], "little")


def intensity_threshold(
    config: Config,
    source: FrameSource,
    images: tuple[ImageRef, ...],
    labels_of: Callable[[tuple[ImageRef, ...]], LabelledImages],
    label_set: LabelSet,
) -> int:
    """The threshold k as configured, or by Otsu's method on returns that were labelled road or paint.

    Args:
        config: `fusion.intensity_threshold`.
        source: Poses and sweeps.
        images: Images of the drive; up to 24, spread evenly, are looked at.
        labels_of: Gives the label images of some images.
        label_set: What their ids mean.
    """
    given = config.fusion.intensity_threshold
    if given != "auto":
        return given
    # A point map's intensity is normalized, that of sweeps is not.
    method = "dense" if source.methods[0] == "dense" else "sparse"
    with_intensity = tuple(image for image in images if source.allows(method, image))
    if not with_intensity:
        return _THRESHOLD_WITHOUT_LIDAR
    step = -(-len(with_intensity) // _IMAGES_FOR_THRESHOLD)
    drivable = [label.id for label in label_set.labels if label.map_class in DRIVABLE_CLASSES]
    if not drivable:
        raise ConfigError(
            f"Label set {label_set.name!r} has no label for road or paint, so the intensity of paint "
            "cannot be estimated; set fusion.intensity_threshold."
        )
    seen = [
        observations.intensity[np.isin(observations.labels, drivable)]
        for image, labels in labels_of(with_intensity[::step])
        if (observations := source.observe(method, image, labels, label_set, 1.0)).intensity
        is not None
    ]
    threshold = otsu_threshold(np.concatenate(seen)) if seen else None
    if threshold is None:
        _LOG.warning("Lidar intensity on the road is uniform: it cannot tell paint (k = 255).")
        return 255
    _LOG.info("Intensity threshold k = %d, by Otsu on %d returns.", threshold, sum(map(len, seen)))
    return threshold


def build_map(
    drive: Drive,
    segmenter: Segmenter,
    path: Path,
    config: Config,
    cache: LabelCache | None,
    steps: Steps,
    also_in: Path | None = None,
    resume: bool = False,
    elsewhere: Elsewhere | None = None,
    memory: MemoryBudget | None = None,
) -> tuple[dict[str, SemanticMap], FrameCounts]:
    """Segment, associate and fuse a drive into new semantic maps, one for each method.

    Images are fused in segments, each of which is a commit. What a killed build committed
    is kept with `resume`, and the map in the end is the same.

    Args:
        drive: Where images, sweeps and poses come from.
        segmenter: Labels its images.
        path: The map of the configured method.
        config: Association, fusion and limits in time.
        cache: Where label images are kept between runs.
        steps: Told of progress.
        also_in: Folder for the maps of the methods in `association.also`, by name;
            None leaves them out.
        resume: Go on with the map at `path`, if there is one: made from the same drive,
            network and configuration.
        elsewhere: Counts the segments of the configured method in other processes; None:
            they are counted here.
        memory: What may be kept in memory; None: a segment's tiles, and 64 MiB of points.

    Returns:
        Maps by method, the configured one first; and what went in.

    Raises:
        DriveError: If no ground was seen at all.
    """
    if also_in is None:
        config = config.model_copy(
            update={"association": config.association.model_copy(update={"also": ()})}
        )
    counts = FrameCounts()
    source = FrameSource(drive, config, memory=memory)
    images = source.usable_images(counts)
    for reason, number in counts.dropped.items():
        if number:
            _LOG.warning("%d of %d images left out: %s.", number, len(drive.images), reason)
    looked_at: dict[ImageRef, NDArrayByte] = {}

    def labels_of(some: tuple[ImageRef, ...]) -> LabelledImages:
        for image, labels in segment_drive(drive, segmenter, some, cache):
            looked_at[image] = labels
            yield image, labels

    def labels_again(some: tuple[ImageRef, ...], before: int) -> LabelledImages:
        # Labels made for the threshold are not made again; the order of frames does not matter.
        rest = [image for image in some if image not in looked_at]
        for image in some:
            if image in looked_at:
                yield image, looked_at.pop(image)
        before += len(some) - len(rest)

        def told(done: int, total: int) -> None:
            if steps.segmented is not None:
                steps.segmented(before + done, len(images))

        yield from segment_drive(drive, segmenter, rest, cache, told)

    with steps.timed("segment and fuse"):
        maps: dict[str, SemanticMap] = {}
        if resume and path.exists():
            maps = {source.methods[0]: SemanticMap.open(path)}
            meta = maps[source.methods[0]].meta
        else:
            threshold = intensity_threshold(config, source, images, labels_of, segmenter.label_set)
            meta = map_meta(config, drive, segmenter, threshold)
            for number, method in enumerate(source.methods):
                made = path if number == 0 or also_in is None else also_in / method
                maps[method] = SemanticMap.create(made, meta)
        done = maps[source.methods[0]].segments_of(drive.id)
        if done:
            _LOG.info("Going on after %d segments that are in the map already.", len(done))
        size = config.fusion.images_per_segment
        pending = [n for n in range(-(-len(images) // size)) if n not in done]
        counts.used += sum(len(images[n * size : (n + 1) * size]) for n in done)
        if elsewhere is not None:
            elsewhere(maps[source.methods[0]], pending, counts, steps.segmented)
            pending = []
        for number in pending:
            some = images[number * size : (number + 1) * size]
            commits = {m: partial(_commit, made, drive.id, number) for m, made in maps.items()}
            labelled = labels_again(some, number * size)
            fuse(source, labelled, meta, commits, counts, path.parent, memory)
    silent = sorted({i.camera for i in images} - {c for c, n in counts.observations.items() if n})
    if not maps[source.methods[0]].tile_indices():
        raise DriveError(
            f"Drive {drive.name}: {counts.used} images were fused and no ground was seen in any of them. "
            f"Check the mounts of {', '.join(silent)} and of the lidar (`hdmap info`), and that sweeps hold "
            "the ground around the vehicle."
        )
    # What the segments of an earlier call saw is not known here.
    if silent and not done:
        why = "check their mounts"
        if source.methods[0] == "dense":
            why = "method dense labels only what lies ahead of the vehicle; else check their mounts"
        _LOG.warning("No ground was seen by %s: %s.", ", ".join(silent), why)
    return maps, counts


def _commit(semantic_map: SemanticMap, drive_id: str, segment: int, counts: CellCounts) -> None:
    semantic_map.add(counts, drive_id, f"Add {drive_id}, segment {segment}", segment=segment)
