"""Steps of the pipeline on their own that start from a semantic map: vectorize, compare and merge."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from hdmap_tools.compare.raster import RasterComparison, compare_raster
from hdmap_tools.compare.reference import load_reference
from hdmap_tools.config import Config
from hdmap_tools.distributed.cluster import Workers
from hdmap_tools.distributed.vectorize import over_workers
from hdmap_tools.errors import OutputExistsError
from hdmap_tools.formats.gpkg import write_gpkg
from hdmap_tools.fusion.map_location import MapLocation
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.map_reading import model_for, whole_window
from hdmap_tools.opening import open_configured
from hdmap_tools.segmentation.cache import SegmentProgress
from hdmap_tools.unfinished_map import map_when_done
from hdmap_tools.vectorization import VectorizationResult, choose
from hdmap_tools.view.agreement import agreement_picture
from hdmap_tools.windowed.vectorize_map import vectorize_map

_LOG = logging.getLogger(__name__)


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
