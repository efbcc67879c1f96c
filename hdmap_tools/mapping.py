"""From a drive and its labels to counts: association and fusion, frame by frame."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hdmap_tools.ahead import taken_ahead
from hdmap_tools.config import Config
from hdmap_tools.errors import ConfigError, DriveError
from hdmap_tools.frame_source import FrameCounts, FrameSource, LabelledImages
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.intensity import otsu_threshold
from hdmap_tools.fusion.map_location import MapLocation
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.map_repository import is_map_there
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.fusion.tiles_on_disk import TilesOnDisk
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, LabelSet
from hdmap_tools.memory_budget import MemoryBudget
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.segmentation.cache import LabelCache, SegmentProgress, segment_drive
from hdmap_tools.segmentation.known_confusion import confusion_of
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.steps import Steps
from hdmap_tools.types import NDArrayByte

_LOG = logging.getLogger(__name__)

Elsewhere = Callable[[SemanticMap, list[int], "FrameCounts", "SegmentProgress | None"], None]
"""Adds segments, by number, to a map; tells counts what went in, and progress of it."""

_THRESHOLD_WITHOUT_LIDAR = 128
_IMAGES_FOR_THRESHOLD = 24


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
    folder: Path | None,
    memory: MemoryBudget | None = None,
) -> None:
    """Associate and count the labelled images of a segment, by each method on its own.

    Args:
        source: Poses and sweeps; its `methods` are used.
        labelled: Images with their label images.
        meta: What the counts mean.
        commits: By method, what takes the counts of a segment.
        counts: Told how many images were used, and what they saw.
        folder: For tiles that memory has no room for; None: where the system keeps such.
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
        else ((image, labels, source.standing(image)) for image, labels in labelled)
    )
    for image, labels, live in prepared:
        for method, segment in segments.items():
            if not source.allows(method, image):
                continue
            seen = source.count(method, image, labels, segment, live)
            if method == source.methods[0]:
                counts.observations[image.camera] += seen
        counts.used += 1


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
    location: MapLocation,
    config: Config,
    cache: LabelCache | None,
    steps: Steps,
    also_in: Path | None = None,
    resume: bool = False,
    elsewhere: Elsewhere | None = None,
    memory: MemoryBudget | None = None,
    scratch: Path | None = None,
    note: dict[str, Any] | None = None,
) -> tuple[dict[str, SemanticMap], FrameCounts]:
    """Segment, associate and fuse a drive into new semantic maps, one for each method.

    Images are fused in segments, each of which is a commit. What a killed build committed
    is kept with `resume`, and the map in the end is the same.

    Args:
        drive: Where images, sweeps and poses come from.
        segmenter: Labels its images.
        location: Of the map of the configured method.
        config: Association, fusion and limits in time.
        cache: Where label images are kept between runs.
        steps: Told of progress.
        also_in: Folder for the maps of the methods in `association.also`, by name;
            None leaves them out.
        resume: Go on with the map at `location`, if there is one: made from the same drive,
            network and configuration.
        elsewhere: Counts the segments of the configured method in other processes; None:
            they are counted here.
        memory: What may be kept in memory; None: a segment's tiles, and 64 MiB of points.
        scratch: Folder for what is put aside; None: where the system keeps such.
        note: Metadata of the first version of the configured method's map.

    Returns:
        Maps by method, the configured one first; and what went in.

    Raises:
        DriveError: If no ground was seen at all.
    """
    if also_in is None:
        config = config.without_comparison()
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
        if resume and is_map_there(location):
            maps = {source.methods[0]: SemanticMap.open(location)}
            meta = maps[source.methods[0]].meta
        else:
            threshold = intensity_threshold(config, source, images, labels_of, segmenter.label_set)
            meta = map_meta(config, drive, segmenter, threshold)
            for number, method in enumerate(source.methods):
                if number == 0 or also_in is None:
                    maps[method] = SemanticMap.create(location, meta, note)
                else:
                    maps[method] = SemanticMap.create(also_in / method, meta)
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
            fuse(source, labelled, meta, commits, counts, scratch, memory)
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
