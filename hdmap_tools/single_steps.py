"""Steps of the pipeline on their own: build, vectorize, compare and merge."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import hdmap_tools
from hdmap_tools.compare.raster import RasterComparison, compare_raster
from hdmap_tools.compare.reference import load_reference
from hdmap_tools.config import Config
from hdmap_tools.distributed.build import add_segments
from hdmap_tools.distributed.cluster import Workers, connected
from hdmap_tools.distributed.count_segment import SegmentTask
from hdmap_tools.distributed.vectorize import over_workers
from hdmap_tools.errors import OutputExistsError
from hdmap_tools.formats.gpkg import write_gpkg
from hdmap_tools.frame_source import FrameCounts
from hdmap_tools.fusion.map_location import MapLocation
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.map_reading import model_for, whole_window
from hdmap_tools.mapping import build_map, map_meta
from hdmap_tools.memory_budget import MemoryBudget
from hdmap_tools.opening import open_configured, open_for
from hdmap_tools.point_map.for_drive import with_points
from hdmap_tools.readers.drive import Drive
from hdmap_tools.segmentation.cache import LabelCache, SegmentProgress
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.steps import Steps
from hdmap_tools.unfinished_map import map_when_done, require_free_for_map, resumable_map
from hdmap_tools.vectorization import VectorizationResult, choose
from hdmap_tools.view.agreement import agreement_picture
from hdmap_tools.windowed.vectorize_map import vectorize_map

_LOG = logging.getLogger(__name__)


def build_alone(
    drive_path: Path,
    out: MapLocation,
    config: Config,
    *,
    like: MapLocation | None = None,
    cache: LabelCache | None = None,
    overwrite: bool = False,
    resume: bool = True,
    workers: Workers | None = None,
    memory: MemoryBudget | None = None,
    steps: Steps | None = None,
) -> dict[str, Any]:
    """`build_map` into a place of its own: a new map that is whole or not there.

    A build that was killed or failed goes on after its last commit when it is asked for again.

    Args:
        drive_path: Folder of the drive.
        out: The map to make.
        config: Every step's settings.
        like: A map whose resolution, count mode, intensity threshold and reference
            height are taken over, so that both can be merged.
        cache: Where label images are kept between runs.
        overwrite: Replace an earlier map.
        resume: Go on with an unfinished build of the same; off, it is thrown away.
        workers: Processes to spread it over; None: all is done in this one.
        memory: What this process may keep in memory.
        steps: Told of progress.

    Returns:
        Drive, images used and dropped, tiles, seconds by step.
    """
    steps = steps or Steps()
    require_free_for_map(out, overwrite)
    with steps.timed("open"):
        drive = open_for(config, drive_path)
        segmenter = open_segmenter(config.segmentation, drive)
        if like is not None:
            model = SemanticMap.open(like).meta
            config = settings_of(config, model)
            threshold = model.intensity_threshold
            map_meta(config, drive, segmenter, threshold).require_compatible(model)
    if memory is not None:
        memory.tiles_bytes(map_meta(config, drive, segmenter, 1))  # says so if it is too little
    plan = _plan(drive, segmenter, config)
    with resumable_map(out, plan, overwrite=overwrite, resume=resume) as work:
        with steps.timed("points"):
            config, drive = with_points(config, drive, work.scratch / "scratch")
        with ExitStack() as stack:
            elsewhere = None
            if workers is not None:
                client = stack.enter_context(connected(workers))
                elsewhere = partial(_elsewhere, client, drive_path, drive, config, cache)
            maps, counts = build_map(
                drive,
                segmenter,
                work.location,
                config,
                cache,
                steps,
                resume=True,
                elsewhere=elsewhere,
                memory=memory,
                scratch=work.scratch,
                note=work.note,
            )
        made = maps[config.association.method]
        report = {
            "drive": drive.id,
            "model": segmenter.name,
            "intensity_threshold": made.meta.intensity_threshold,
            "num_images": counts.used,
            "num_images_dropped": dict(counts.dropped),
            "num_tiles": len(made.tile_indices()),
        }
    return report | {
        "seconds": {name: round(value, 3) for name, value in steps.seconds.items()},
    }


def _elsewhere(
    client: Any,
    drive_path: Path,
    drive: Drive,
    config: Config,
    cache: LabelCache | None,
    semantic_map: SemanticMap,
    numbers: list[int],
    counts: FrameCounts,
    segmented: SegmentProgress | None,
) -> None:
    task = SegmentTask.of(drive_path, config, semantic_map.meta, cache, len(drive.images))
    add_segments(client, task, drive.id, semantic_map, numbers, counts, segmented)


def _plan(drive: Drive, segmenter: Segmenter, config: Config) -> dict[str, Any]:
    """What a map follows from: a build by another plan is another build."""
    images = hashlib.sha256("\n".join(image.key for image in drive.images).encode())
    return {
        "drive": drive.id,
        "images": images.hexdigest(),
        "network": segmenter.fingerprint,
        "configuration": config.model_dump(
            mode="json", include={"drive", "points", "association", "fusion"}
        ),
        "release": hdmap_tools.__version__,
    }


def settings_of(config: Config, meta: MapMeta) -> Config:
    """A configuration that builds maps which can be added to one with this meta."""
    fusion = config.fusion.model_copy(
        update={
            "resolution_m": meta.resolution_m,
            "count_mode": meta.count_mode,
            "intensity_threshold": meta.intensity_threshold,
            "range_edges_m": meta.range_edges_m,
            "reference_height_m": meta.reference_height_m,
        }
    )
    return config.model_copy(update={"fusion": fusion})


def vectorize_alone(
    map_path: MapLocation,
    out: Path,
    config: Config,
    *,
    overwrite: bool = False,
    workers: Workers | None = None,
    told: SegmentProgress | None = None,
) -> VectorizationResult:
    """Vectorize a semantic map into a GeoPackage.

    Args:
        map_path: The map.
        out: The file to make.
        config: How the map is read and which plugins run.
        overwrite: Replace an earlier file.
        workers: Processes to spread a large map's windows over; None: this one does them.
        told: After each window.
    """
    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists; use --overwrite to replace it.")
    choose(config.vectorize)  # what is wrong with the plugins asked for is said before any work
    semantic_map = SemanticMap.open(map_path)
    model = model_for(semantic_map.meta, config, semantic_map)
    result = vectorize_map(
        semantic_map,
        model,
        config.vectorize,
        fill_radius_cells=config.observation.fill_radius_cells,
        crew=None if workers is None else partial(over_workers, workers),
        told=told,
    )
    write_gpkg(result.vector_map, out, overwrite=overwrite)
    return result


def compare_alone(
    map_path: MapLocation,
    reference_path: Path,
    config: Config,
    *,
    drive_path: Path | None = None,
    picture: Path | None = None,
    overwrite: bool = False,
) -> RasterComparison:
    """Hold a semantic map against a reference; near the driven path if the drive is given."""
    semantic_map = SemanticMap.open(map_path)
    window = whole_window(semantic_map, model_for(semantic_map.meta, config, semantic_map), config)
    reference = load_reference(reference_path, window.grid)
    path_xy = None
    if drive_path is not None:
        drive = open_configured(config, drive_path)
        if drive.frame.is_georeferenced:
            drive.frame.require_same(semantic_map.meta.frame)
        else:
            _LOG.info(
                "Drive %s does not know its place; its poses are taken in the map's frame.",
                drive.name,
            )
        path_xy = drive.trajectory.translations[:, :2]
    comparison = compare_raster(
        window,
        reference,
        path_xy=path_xy,
        max_range_m=config.compare.max_range_m if path_xy is not None else None,
        count_filled=config.compare.count_filled,
    )
    if picture is not None:
        agreement_picture(
            window, reference, comparison, picture, trajectory_xy=path_xy, overwrite=overwrite
        )
    return comparison


def merge_maps(
    maps: Sequence[MapLocation],
    subtract: Sequence[MapLocation],
    out: MapLocation,
    *,
    allow_repeats: bool = False,
    overwrite: bool = False,
) -> SemanticMap:
    """Add maps into a new one, and take others out of the sum.

    A drive that two of them hold is refused, unless repeats are allowed.
    """
    opened = [SemanticMap.open(path) for path in maps]
    taken = [SemanticMap.open(path) for path in subtract]
    with map_when_done(out, overwrite) as place:
        merged = SemanticMap.create(place, opened[0].meta)
        for path, one in zip(maps, opened, strict=True):
            merged.merge(one, str(path), allow_repeats=allow_repeats)
        for path, one in zip(subtract, taken, strict=True):
            merged.subtract(one, str(path))
    return SemanticMap.open(out)
