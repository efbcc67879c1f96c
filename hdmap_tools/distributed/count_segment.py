"""One segment of a drive counted by itself: what is sent to workers, and what they do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from hdmap_tools.config import Config
from hdmap_tools.frame_source import FrameCounts, FrameSource
from hdmap_tools.fusion.cell_counts import CellCounts, Tile, TileIndex
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.mapping import count_images
from hdmap_tools.opening import open_for, with_absolute_paths
from hdmap_tools.point_map.for_drive import with_points
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.segmentation.cache import LabelCache, segment_drive
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.types import NDArrayAny, NDArrayInt


@dataclass(frozen=True)
class SegmentTask:
    """What a worker needs to count parts of a drive: small, and the same on each machine.

    Attributes:
        drive_path: Folder of the drive, where every worker finds it.
        config: Settled (a JSON document): paths hold from anywhere, the point map exists.
        meta: Of the map (a JSON document).
        cache_folder: Of label images; None: none are kept.
        num_images: Of the whole drive.
    """

    drive_path: Path
    config: str
    meta: str
    cache_folder: Path | None
    num_images: int

    @classmethod
    def of(
        cls,
        drive_path: Path,
        config: Config,
        meta: MapMeta,
        cache: LabelCache | None,
        num_images: int,
    ) -> SegmentTask:
        """The same as settings, with paths that hold from anywhere."""
        settled = with_absolute_paths(config.without_comparison())
        return cls(
            drive_path.absolute(),
            settled.model_dump_json(),
            meta.model_dump_json(),
            None if cache is None else cache.folder.absolute(),
            num_images,
        )


@dataclass(frozen=True)
class SeenCells:
    """The cells of a tile that hold evidence, which are a small part of it: what is sent of it.

    Attributes:
        cells: (K,) flat cells of the tile.
        layers: By name, (K,) or, of ``counts``, (label, bin, K).
    """

    cells: NDArrayInt
    layers: dict[str, NDArrayAny]

    @classmethod
    def of(cls, tile: Tile) -> SeenCells:
        """Of a tile; a height comes with every observation."""
        cells = np.flatnonzero(tile.layers["height_n"])
        flat = {name: layer.reshape(*layer.shape[:-2], -1) for name, layer in tile.layers.items()}
        return cls(cells, {name: layer[..., cells] for name, layer in flat.items()})

    def tile(self) -> Tile:
        """The tile."""
        num_labels, num_bins = self.layers["counts"].shape[:2]
        whole = Tile.zeros(num_labels, num_bins)
        for name, layer in whole.layers.items():
            layer.reshape(*layer.shape[:-2], -1)[..., self.cells] = self.layers[name]
        return whole


@dataclass(frozen=True)
class SegmentCounts:
    """What a segment adds to a map.

    Attributes:
        number: Of the segment.
        num_frames: Images that were fused.
        observations: Labelled ground points by camera.
        tiles: Without empty ones.
    """

    number: int
    num_frames: int
    observations: dict[str, int]
    tiles: dict[TileIndex, SeenCells]


def count_segment(
    task: SegmentTask, number: int, told: Callable[[], object] | None = None
) -> SegmentCounts:
    """Segment, associate and count the images of one segment.

    Args:
        task: The drive and how it is mapped.
        number: Of the segment.
        told: Called after each image.
    """
    drive, segmenter, source, images = _opened(task.drive_path, task.config)
    size = Config.model_validate_json(task.config).fusion.images_per_segment
    some = images[number * size : (number + 1) * size]
    counts, frames = CellCounts(MapMeta.model_validate_json(task.meta)), FrameCounts()
    cache = None if task.cache_folder is None else LabelCache(task.cache_folder)

    def progress(done: int, total: int) -> None:
        if told is not None and done:
            told()

    labelled = segment_drive(drive, segmenter, some, cache, progress)
    # A worker is given one core.
    count_images(source, labelled, {source.methods[0]: counts}, frames, ahead=False)
    tiles = {i: SeenCells.of(tile) for i, tile in counts.tiles.items() if not tile.is_empty}
    return SegmentCounts(number, counts.num_frames, dict(frames.observations), tiles)


@lru_cache(maxsize=1)
def _opened(
    drive_path: Path, document: str
) -> tuple[Drive, Segmenter, FrameSource, tuple[ImageRef, ...]]:
    """A drive, its segmenter and its images; kept, for a worker counts many segments of one drive."""
    config = Config.model_validate_json(document)
    drive = open_for(config, drive_path)
    segmenter = open_segmenter(config.segmentation, drive)
    config, drive = with_points(config, drive, Path())
    source = FrameSource(drive, config)
    return drive, segmenter, source, source.usable_images(FrameCounts())
