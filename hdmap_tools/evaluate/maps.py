"""Counts of one drive by several methods at once, so that each image is segmented and read once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.association.observations import Observations
from hdmap_tools.config import AssociationMethod, Config
from hdmap_tools.frame_source import (
    FrameCounts,
    FrameSource,
    GroundedSweeps,
    LabelledImages,
    frame_key,
)
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.fusion.voting import CountMode
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.mapping import intensity_threshold, map_meta
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.segmentation.cache import LabelCache, segment_drive
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.steps import Steps


@dataclass(frozen=True)
class MapVariant:
    """One way to count.

    Attributes:
        name: Of the map.
        method: How labels reach the ground.
        occlusion_test: Whether hidden ground is left out.
        count_mode: How a frame votes.
        ahead_m: Only what lies so far ahead of the ego origin is counted.
        range_edges_m: Bands of range whose votes are counted apart.
    """

    name: str
    method: AssociationMethod = "dense"
    occlusion_test: bool = True
    count_mode: CountMode = "share"
    ahead_m: tuple[float, float] = (0.0, 15.0)
    range_edges_m: tuple[float, ...] = ()


FAR_M: Final = 25.0
"""Reach of the comparison by range, beyond the paper's clip."""


def clipped(
    observations: Observations,
    city_SE3_ego: SE3,
    ahead_m: tuple[float, float],
    across_m: float,
) -> Observations:
    """What lies in a clip of the ego frame: so far ahead of its origin, so far to either side."""
    xy = city_SE3_ego.inverse().transform_from(observations.points_city)[:, :2]
    inside = (xy[:, 0] > ahead_m[0]) & (xy[:, 0] <= ahead_m[1]) & (np.abs(xy[:, 1]) <= across_m)
    return observations.chosen(inside)


def fuse_variants(
    drive: Drive,
    segmenter: Segmenter,
    config: Config,
    variants: Sequence[MapVariant],
    folder: Path,
    cache: LabelCache | None,
    steps: Steps,
) -> dict[str, SemanticMap]:
    """Make a semantic map for each variant.

    Args:
        drive: At the poses to be used.
        segmenter: Labels its images.
        config: Names a point map in `association.points`.
        variants: Ways to count; their names differ.
        folder: Where the maps are written, by name; exists.
        cache: Where label images are kept.
        steps: Told of images.

    Returns:
        Maps by name of their variant.
    """
    reach = max(variant.ahead_m[1] for variant in variants)
    sweeps = GroundedSweeps(drive, config)
    edges = next((v.range_edges_m for v in variants if v.range_edges_m), ())
    sources = {
        tested: FrameSource(drive, _configured(config, tested, reach, edges), sweeps)
        for tested in sorted({variant.occlusion_test for variant in variants})
    }
    first = next(iter(sources.values()))
    images = first.usable_images(FrameCounts())

    def labels_of(some: tuple[ImageRef, ...]) -> LabelledImages:
        return segment_drive(drive, segmenter, some, cache)

    threshold = intensity_threshold(config, first, images, labels_of, segmenter.label_set)
    base = map_meta(config, drive, segmenter, threshold)
    metas = {
        v.name: base.model_copy(
            update={"count_mode": v.count_mode, "range_edges_m": v.range_edges_m}
        )
        for v in variants
    }
    maps = {name: SemanticMap.create(folder / name, meta) for name, meta in metas.items()}
    segments = {name: CellCounts(meta) for name, meta in metas.items()}
    for number, (image, labels) in enumerate(
        segment_drive(drive, segmenter, images, cache, steps.segmented)
    ):
        _count_image(image, labels, base, sources, variants, segments, config)
        if (number + 1) % config.fusion.images_per_segment == 0 or number + 1 == len(images):
            for name, segment in segments.items():
                maps[name].add(segment, drive.id)
            segments = {name: CellCounts(meta) for name, meta in metas.items()}
    return maps


def _count_image(
    image: ImageRef,
    labels: np.ndarray,
    meta: MapMeta,
    sources: dict[bool, FrameSource],
    variants: Sequence[MapVariant],
    segments: dict[str, CellCounts],
    config: Config,
) -> None:
    seen: dict[tuple[str, bool], Observations] = {}
    for variant in variants:
        source = sources[variant.occlusion_test]
        if not source.allows(variant.method, image):
            continue
        key = variant.method, variant.occlusion_test
        if key not in seen:
            seen[key] = source.observe(
                variant.method, image, labels, meta.label_set, meta.resolution_m
            )
        inside = clipped(
            seen[key],
            source.pose(image.timestamp_ns),
            variant.ahead_m,
            config.association.clip_across_m,
        )
        segments[variant.name].add(inside, frame_key(image))


def _configured(
    config: Config, occlusion_test: bool, reach_m: float, range_edges_m: tuple[float, ...]
) -> Config:
    """All methods that lean on a sweep or a point map, as far as the furthest variant looks."""
    association = config.association.model_copy(
        update={
            "method": "dense",
            "also": ("sparse", "planar"),
            "occlusion_test": occlusion_test,
            "clip_ahead_m": max(reach_m, config.association.clip_ahead_m),
            "lookup_range_m": max(reach_m, config.association.lookup_range_m),
        }
    )
    fusion = config.fusion.model_copy(update={"range_edges_m": range_edges_m})
    return config.model_copy(update={"association": association, "fusion": fusion})
