"""The whole method: from a drive to a semantic map, vectors, exports and a comparison."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hdmap_tools.compare.raster import RasterComparison, compare_raster
from hdmap_tools.compare.reference import Reference, load_reference
from hdmap_tools.config import Config
from hdmap_tools.errors import ConfigError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.formats.by_name import write_vector_map
from hdmap_tools.formats.gpkg import write_gpkg
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.observation_model import ObservationModel, observation_model
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.mapping import (
    FrameCounts,
    FrameSource,
    LabelledImages,
    fuse,
    in_segments,
    intensity_threshold,
    map_meta,
    require_images,
)
from hdmap_tools.output_folder import MARKER, map_folder, output_folder
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.run_metrics import RunMetrics, versions
from hdmap_tools.segmentation.cache import LabelCache, SegmentProgress, segment_drive
from hdmap_tools.segmentation.confusion import ConfusionMatrix, find_confusion
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.types import NDArrayByte
from hdmap_tools.vectorization import PluginFailure, VectorizationResult, vectorize
from hdmap_tools.view.agreement import agreement_picture
from hdmap_tools.view.image_overlay import project_window_into_image
from hdmap_tools.view.overview import CameraPicture, Panel, known_bounds, overview_picture

if TYPE_CHECKING:
    from hdmap_tools.map_model.vector_map import VectorMap

_LOG = logging.getLogger(__name__)

MAP_NAME: Final = "semantic_map"
FEATURES_NAME: Final = "features.gpkg"
EXPORT_NAMES: Final = {"lanelet2": "lanelet2_map.osm", "geojson": "map.geojson"}
OVERVIEW_NAME: Final = "overview.png"
AGREEMENT_NAME: Final = "agreement.png"
METRICS_NAME: Final = "metrics.json"

_PHOTO_WIDTH_PX: Final = 1000

IMAGES_PER_SEGMENT: Final = 240
"""Images fused between two commits: bounds memory and what a killed build loses."""


@dataclass
class Steps:
    """What a run tells the outside while it goes on.

    Attributes:
        segmented: Told after each image.
        seconds: Time by step, filled in.
    """

    segmented: SegmentProgress | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the time of a block to a step."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


@dataclass(frozen=True)
class RunResult:
    """What `run` made.

    Attributes:
        metrics: Also in metrics.json.
        failures: Vectorizers that gave nothing.
    """

    metrics: RunMetrics
    failures: tuple[PluginFailure, ...]


def run(
    drive_path: Path,
    out: Path,
    config: Config,
    *,
    cache: LabelCache | None = None,
    overwrite: bool = False,
    steps: Steps | None = None,
) -> RunResult:
    """Turn a drive into a map: every step, in order.

    Args:
        drive_path: Folder of the drive.
        out: Folder to make: semantic_map, features.gpkg, exports, pictures,
            metrics.json and the configuration used.
        config: Every step's settings.
        cache: Where label images are kept between runs.
        overwrite: Replace an earlier result.
        steps: Told of progress.

    Raises:
        HDMapError: Whatever cannot be read, used or written; then nothing is left behind.
    """
    steps = steps or Steps()
    with output_folder(out, overwrite) as folder:
        with steps.timed("open"):
            drive = open_for(config, drive_path)
            segmenter = open_segmenter(config.segmentation, drive)
        semantic_map, counts, others = build_map(
            drive, segmenter, folder / MAP_NAME, config, cache, steps
        )
        with steps.timed("read"):
            model = model_for(semantic_map.meta, config)
            window = whole_window(semantic_map, model, config)
            windows: dict[str, MapWindow] = {config.association.method: window}
            windows |= {name: whole_window(other, model, config) for name, other in others.items()}
        with steps.timed("vectorize"):
            result = vectorize(window, config.vectorize)
        with steps.timed("export"):
            export(result.vector_map, folder, config)
        with steps.timed("compare"):
            references = {
                name: reference
                for name, other in windows.items()
                if (reference := reference_for(config, drive, other.grid)) is not None
            }
            comparisons = {
                name: compare_raster(
                    windows[name],
                    reference,
                    path_xy=drive.trajectory.translations[:, :2],
                    max_range_m=config.compare.max_range_m,
                    count_filled=config.compare.count_filled,
                )
                for name, reference in references.items()
            }
        with steps.timed("pictures"):
            draw(folder, windows, result.vector_map, drive, config)
            method = config.association.method
            if method in references:
                agreement_picture(
                    window,
                    references[method],
                    comparisons[method],
                    folder / AGREEMENT_NAME,
                    trajectory_xy=drive.trajectory.translations,
                    title=f"{drive.id} against {references[method].source}",
                )
        metrics = RunMetrics(
            drive=drive.id,
            model=segmenter.name,
            association=config.association.method,
            resolution_m=config.fusion.resolution_m,
            intensity_threshold=semantic_map.meta.intensity_threshold,
            num_images=counts.used,
            num_images_dropped=dict(counts.dropped),
            num_tiles=len(semantic_map.tiles()),
            num_elements=result.vector_map.counts(),
            plugins=result.vector_map.provenance.get("plugins", []),
            failures={failure.name: failure.message for failure in result.failures},
            comparisons=comparisons,
            seconds={name: round(value, 3) for name, value in steps.seconds.items()},
            warnings=drive.warnings,
            versions=versions(),
        )
        (folder / METRICS_NAME).write_text(metrics.to_json(), encoding="utf-8")
        (folder / MARKER).write_text(config.to_yaml(), encoding="utf-8")
    return RunResult(metrics, result.failures)


def open_configured(config: Config, drive_path: Path) -> Drive:
    """Open a drive as configured."""
    wanted = config.drive
    return open_drive(drive_path, wanted.layout, wanted.scene, wanted.cameras)


def open_for(config: Config, drive_path: Path) -> Drive:
    """Open a drive to be mapped: it has images, and its place on earth is settled."""
    drive = open_configured(config, drive_path)
    require_images(drive)
    origin = config.export.origin
    if origin is not None and drive.frame.is_georeferenced:
        raise ConfigError(
            f"Drive {drive.name} knows its place on earth ({drive.frame.describe()}); leave --origin out."
        )
    if origin is not None:
        drive = replace(drive, frame=MapFrame.from_origin(*origin))
    if config.export.formats and not drive.frame.is_georeferenced:
        _ = drive.frame.crs  # raises NoOriginError before hours of work, not after
    return drive


def build_map(
    drive: Drive,
    segmenter: Segmenter,
    path: Path,
    config: Config,
    cache: LabelCache | None,
    steps: Steps,
    *,
    overwrite: bool = False,
) -> tuple[SemanticMap, FrameCounts, dict[str, CellCounts]]:
    """Segment, associate and fuse a drive into a new semantic map.

    Returns:
        The map, how many images went in, and the counts of the methods in
        `association.also`, in memory.
    """
    counts = FrameCounts()
    source = FrameSource(drive, config)
    images = source.usable_images(counts)
    for reason, number in counts.dropped.items():
        if number:
            _LOG.warning("%d of %d images left out: %s.", number, len(drive.images), reason)

    looked_at: dict[ImageRef, NDArrayByte] = {}

    def labels_of(some: tuple[ImageRef, ...]) -> LabelledImages:
        for image, labels in segment_drive(drive, segmenter, some, cache):
            looked_at[image] = labels
            yield image, labels

    with steps.timed("segment and fuse"):
        threshold = intensity_threshold(config, source, images, labels_of, segmenter.label_set)
        meta = map_meta(config, drive, segmenter.label_set, segmenter.name, threshold)
        semantic_map = SemanticMap.create(path, meta, overwrite=overwrite)
        others: dict[str, CellCounts] = {}
        # Labels made for the threshold are not made again; the order of frames does not matter.
        rest = [image for image in images if image not in looked_at]
        labelled = segment_drive(drive, segmenter, rest, cache, steps.segmented)
        for segment in in_segments(chain(looked_at.items(), labelled), IMAGES_PER_SEGMENT):
            fused = fuse(source, segment, meta, source.methods, counts)
            semantic_map.add(fused.pop(config.association.method), drive.id)
            for name, more in fused.items():
                others[name] = others[name].merge(more) if name in others else more
    return semantic_map, counts, others


def build_alone(
    drive_path: Path,
    out: Path,
    config: Config,
    *,
    cache: LabelCache | None = None,
    overwrite: bool = False,
    steps: Steps | None = None,
) -> dict[str, Any]:
    """`build_map` into a place of its own: a new map that is whole or not there.

    Returns:
        Drive, images used and dropped, tiles, seconds by step.
    """
    steps = steps or Steps()
    with map_folder(out, overwrite) as folder:
        with steps.timed("open"):
            drive = open_for(config, drive_path)
            segmenter = open_segmenter(config.segmentation, drive)
        semantic_map, counts, _ = build_map(drive, segmenter, folder, config, cache, steps)
        return {
            "drive": drive.id,
            "model": segmenter.name,
            "intensity_threshold": semantic_map.meta.intensity_threshold,
            "num_images": counts.used,
            "num_images_dropped": dict(counts.dropped),
            "num_tiles": len(semantic_map.tiles()),
            "seconds": {name: round(value, 3) for name, value in steps.seconds.items()},
        }


def vectorize_alone(
    map_path: Path, out: Path, config: Config, *, overwrite: bool = False
) -> VectorizationResult:
    """Vectorize a semantic map into a GeoPackage."""
    with atomic_output(out, overwrite) as temporary:
        semantic_map = SemanticMap.open(map_path)
        window = whole_window(semantic_map, model_for(semantic_map.meta, config), config)
        result = vectorize(window, config.vectorize)
        write_gpkg(result.vector_map, temporary)
    return result


def compare_alone(
    map_path: Path,
    reference_path: Path,
    config: Config,
    *,
    drive_path: Path | None = None,
    picture: Path | None = None,
    overwrite: bool = False,
) -> RasterComparison:
    """Hold a semantic map against a reference; near the driven path if the drive is given."""
    semantic_map = SemanticMap.open(map_path)
    window = whole_window(semantic_map, model_for(semantic_map.meta, config), config)
    reference = load_reference(reference_path, window.grid)
    path_xy = None
    if drive_path is not None:
        drive = open_configured(config, drive_path)
        drive.frame.require_same(semantic_map.meta.frame)
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
    maps: Sequence[Path], subtract: Sequence[Path], out: Path, *, overwrite: bool = False
) -> SemanticMap:
    """Add maps into a new one, and take others out of the sum."""
    opened = [SemanticMap.open(path) for path in maps]
    taken = [SemanticMap.open(path) for path in subtract]
    with map_folder(out, overwrite) as folder:
        merged = SemanticMap.create(folder, opened[0].meta)
        for one in opened:
            merged.merge(one)
        for one in taken:
            merged.subtract(one)
    return SemanticMap.open(out)


def confusion_for(config: Config, label_set: LabelSet, model: str) -> ConfusionMatrix | None:
    """The confusion matrix configured, or the one known for the model."""
    if config.observation.confusion is not None:
        return ConfusionMatrix.load(config.observation.confusion)
    return find_confusion(label_set, model)


def model_for(meta: MapMeta, config: Config) -> ObservationModel:
    """The observation model to read a map with."""
    confusion = None
    if config.observation.model == "confusion":
        confusion = confusion_for(config, meta.label_set, meta.model)
    return observation_model(config.observation, meta, config.classes, confusion)


def whole_window(
    source: SemanticMap | CellCounts, model: ObservationModel, config: Config
) -> MapWindow:
    """All of a map, read through an observation model; one cell where there is none."""
    grid = source.grid or BevGrid(source.meta.resolution_m, 0, 0, 1, 1, source.meta.frame)
    return read_window(source, grid, model, config.observation.fill_radius_cells)


def export(vector_map: VectorMap, folder: Path, config: Config) -> None:
    """Write the working file and the configured exports."""
    write_gpkg(vector_map, folder / FEATURES_NAME)
    for name in config.export.formats:
        write_vector_map(vector_map, folder / EXPORT_NAMES[name], name)


def reference_for(config: Config, drive: Drive, grid: BevGrid) -> Reference | None:
    """What the result is compared with: as configured, else a mask that lies with the drive."""
    path = config.compare.reference
    if path is None:
        masks = [p for p in drive.reference_maps if p.suffix == ".png"]
        if len(masks) != 1:
            return None
        path = masks[0]
        _LOG.info("Comparing with %s, which lies with the drive.", path)
    return load_reference(path, grid)


def draw(
    folder: Path,
    windows: dict[str, MapWindow],
    vector_map: VectorMap,
    drive: Drive,
    config: Config,
) -> None:
    """Write the overview: maps side by side, and a camera image without and with the map in it."""
    method = config.association.method
    window = windows[method]
    image = middle_front_image(drive)
    camera = drive.cameras[image.camera]
    pose = drive.trajectory.interpolate(image.timestamp_ns, config.drive.max_pose_gap_s)
    photo = shrunk(read_image(image, camera), _PHOTO_WIDTH_PX)
    small_camera = camera.scaled(photo.shape[1], photo.shape[0])
    overlaid = project_window_into_image(window, vector_map, small_camera, pose, photo)
    panels = [Panel(f"{method}, with vectors", window, vector_map)]
    panels += [Panel(name, other) for name, other in windows.items()]
    overview_picture(
        folder / OVERVIEW_NAME,
        panels,
        images=[
            CameraPicture(image.key, photo),
            CameraPicture(f"{image.camera} with the map drawn back into it", overlaid),
        ],
        trajectory_xy=drive.trajectory.translations,
        city_SE3_ego=pose,
        bounds_m=known_bounds([window]),
        title=drive.id,
    )


def shrunk(image: NDArrayByte, max_width_px: int) -> NDArrayByte:
    """A picture (height, width, 3) no wider than that; a report needs no more pixels."""
    import cv2

    height, width = image.shape[:2]
    if width <= max_width_px:
        return image
    size = (max_width_px, max(round(height * max_width_px / width), 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def middle_front_image(drive: Drive) -> ImageRef:
    """The image in the middle of the drive of the camera that looks most nearly ahead."""
    names = sorted({image.camera for image in drive.images})
    ahead = max(names, key=lambda name: drive.cameras[name].ego_SE3_cam.rotation[0, 2])
    images = [
        image
        for image in drive.images
        if image.camera == ahead
        and drive.trajectory.timestamps_ns[0]
        <= image.timestamp_ns
        <= drive.trajectory.timestamps_ns[-1]
    ]
    return images[len(images) // 2]
