"""Tiles of a map that can no longer be read, counted again from the drive that they were made of."""

from __future__ import annotations

import logging
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from hdmap_tools.building import settings_of
from hdmap_tools.config import AssociationConfig, Config
from hdmap_tools.errors import MapMismatchError
from hdmap_tools.frame_source import FrameCounts, FrameSource
from hdmap_tools.fusion.cell_counts import TILE_CELLS, CellCounts, Tile, TileIndex
from hdmap_tools.fusion.map_location import MapLocation
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.semantic_map import Drives, SemanticMap
from hdmap_tools.mapping import count_images, map_meta
from hdmap_tools.opening import open_for
from hdmap_tools.point_map.for_drive import with_points
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.cache import LabelCache, segment_drive
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.steps import Steps

_LOG = logging.getLogger(__name__)

_BESIDE_M: Final = 10.0
"""Between the ego origin and a camera, generously."""


def repair_map(
    drive_path: Path,
    location: MapLocation,
    config: Config,
    *,
    cache: LabelCache | None = None,
    steps: Steps | None = None,
) -> dict[str, Any]:
    """Count the tiles that are damaged again; all others stay as they are.

    Args:
        drive_path: The drive that the map was built from.
        location: The map.
        config: As it was built with; resolution and such are taken from the map.
        cache: Where label images are kept.
        steps: Told of progress.

    Returns:
        Tiles looked at, damaged ones with their layers, images counted again.

    Raises:
        StoreError: If more than single chunks are damaged.
        MapMismatchError: If the map holds other drives, or what is left of a tile is not what
            this drive gives with these settings; then nothing is changed.
    """
    steps = steps or Steps()
    semantic_map = SemanticMap.open(location)
    meta, drives = semantic_map.meta, semantic_map.drives
    with steps.timed("check"):
        damaged = semantic_map.damaged_tiles()
    report: dict[str, Any] = {
        "num_tiles": len(semantic_map.tile_indices()),
        "damaged": {f"{x},{y}": list(layers) for (x, y), layers in damaged.items()},
        "num_images": 0,
    }
    if not damaged:
        return report
    for (x, y), layers in damaged.items():
        _LOG.warning("Tile (%d, %d) is damaged: %s.", x, y, ", ".join(layers))
    with steps.timed("open"):
        config = settings_of(config, meta).without_comparison()
        drive = open_for(config, drive_path)
        _require_only(drive.id, drives)
        segmenter = open_segmenter(config.segmentation, drive)
        map_meta(config, drive, segmenter, meta.intensity_threshold).require_compatible(meta)
    beside = location.absolute().parent if isinstance(location, Path) else None
    with TemporaryDirectory(prefix=".repair.", dir=beside) as scratch:
        with steps.timed("points"):
            config, drive = with_points(config, drive, Path(scratch))
        with steps.timed("segment and fuse"):
            source = FrameSource(drive, config)
            images = source.usable_images(FrameCounts())
            near = tuple(
                i for i in images if _may_see(source, i, damaged, meta, config.association)
            )
            counts = CellCounts(meta)
            labelled = segment_drive(drive, segmenter, near, cache, steps.segmented)
            count_images(source, labelled, {source.methods[0]: counts}, FrameCounts())
    made = {
        index: counts.tiles.get(index) or Tile.zeros(len(meta.label_set), meta.num_bins)
        for index in damaged
    }
    for index, tile in made.items():
        for name, layer in semantic_map.sound_layers(index).items():
            if not np.array_equal(layer, tile.layers[name]):
                raise MapMismatchError(
                    f"Tile {index} cannot be repaired: its {name} is sound and is not what {drive.id} gives "
                    "with these settings; give the command that the map was built with."
                )
    semantic_map.replace(
        iter(sorted(made.items())),
        drives,
        f"Count {len(made)} damaged tiles again",
        {"repaired": [list(index) for index in sorted(made)]},
    )
    return report | {"num_images": len(near)}


def _require_only(drive_id: str, drives: Drives) -> None:
    if set(drives) != {drive_id}:
        raise MapMismatchError(
            f"The map holds {', '.join(sorted(drives)) or 'no drive'}; only the tiles of a map of one drive "
            f"({drive_id}) can be counted again. Repair the maps that were merged, and merge them anew."
        )


def _may_see(
    source: FrameSource,
    image: ImageRef,
    tiles: dict[TileIndex, tuple[str, ...]],
    meta: MapMeta,
    config: AssociationConfig,
) -> bool:
    """Whether an image's ground may reach into one of the tiles."""
    clip_m = float(np.hypot(config.clip_ahead_m, config.clip_across_m))
    reach_m = _BESIDE_M + max(clip_m, config.lookup_range_m, config.max_range_m)
    tile_m = TILE_CELLS * meta.resolution_m
    at = source.pose(image.timestamp_ns).translation[:2]
    for index in tiles:
        low = np.array(index) * tile_m
        outside = np.maximum(np.maximum(low - at, at - low - tile_m), 0.0)
        if np.hypot(*outside) <= reach_m:
            return True
    return False
