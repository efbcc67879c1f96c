"""The whole method: from a drive to a semantic map, vectors, exports and a comparison."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from hdmap_tools.compare.raster import RasterComparison, compare_raster
from hdmap_tools.compare.reference import Reference, load_references
from hdmap_tools.config import Config
from hdmap_tools.errors import FormatError
from hdmap_tools.formats.by_name import write_vector_map
from hdmap_tools.formats.gpkg import write_gpkg
from hdmap_tools.map_reading import model_for, whole_window
from hdmap_tools.mapping import build_map, map_meta
from hdmap_tools.opening import open_for, with_absolute_paths
from hdmap_tools.output_folder import CONFIG_NAME, result_folder
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.point_map.for_drive import with_points
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.run_metrics import RunMetrics, versions
from hdmap_tools.segmentation.cache import LabelCache
from hdmap_tools.segmentation.open_segmenter import find_model, open_segmenter
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.steps import Steps
from hdmap_tools.types import NDArrayByte
from hdmap_tools.vectorization import PluginFailure, choose
from hdmap_tools.view.agreement import agreement_picture
from hdmap_tools.view.image_overlay import project_window_into_image
from hdmap_tools.view.overview import CameraPicture, Panel, known_bounds, overview_picture
from hdmap_tools.windowed.vectorize_map import vectorize_map

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
    with result_folder(out, "run", overwrite) as folder:
        with steps.timed("open"):
            drive = open_for(config, drive_path)
            config = settled(config, drive)
            segmenter = open_segmenter(config.segmentation, drive)
            check_settings(config, drive, segmenter)
        with steps.timed("points"):
            with_map, drive = with_points(config, drive, folder.parent / "scratch")
        maps, counts = build_map(
            drive,
            segmenter,
            folder / MAP_NAME,
            with_map,
            cache,
            steps,
            also_in=folder.parent / "also",
            scratch=folder,
        )
        with steps.timed("read"):
            made = maps[config.association.method]
            model = model_for(made.meta, config, made)
            windows = {method: whole_window(one, model, config) for method, one in maps.items()}
            window = windows[config.association.method]
        with steps.timed("vectorize"):
            result = vectorize_map(
                made,
                model,
                config.vectorize,
                fill_radius_cells=config.observation.fill_radius_cells,
                whole=window,
            )
        with steps.timed("export"):
            export(result.vector_map, folder, config)
        with steps.timed("compare"):
            compared = compare_with_reference(windows, drive, config)
        with steps.timed("pictures"):
            draw_overview(folder / OVERVIEW_NAME, windows, result.vector_map, drive, config)
            draw_agreement(folder / AGREEMENT_NAME, window, compared, drive, config)
        metrics = RunMetrics(
            drive=drive.id,
            model=segmenter.name,
            association=config.association.method,
            resolution_m=config.fusion.resolution_m,
            intensity_threshold=made.meta.intensity_threshold,
            num_images=counts.used,
            num_images_dropped=dict(counts.dropped),
            num_observations=dict(counts.observations),
            num_tiles=len(made.tile_indices()),
            num_elements=result.vector_map.counts(),
            plugins=result.vector_map.provenance.get("plugins", []),
            failures={failure.name: failure.message for failure in result.failures},
            comparisons={method: comparison for method, (_, comparison) in compared.items()},
            seconds={name: round(value, 3) for name, value in steps.seconds.items()},
            warnings=drive.warnings,
            versions=versions(),
        )
        (folder / METRICS_NAME).write_text(metrics.to_json(), encoding="utf-8")
        (folder / CONFIG_NAME).write_text(config.to_yaml(), encoding="utf-8")
    return RunResult(metrics, result.failures)


def export(vector_map: VectorMap, folder: Path, config: Config) -> None:
    """Write the working file and the configured exports."""
    write_gpkg(vector_map, folder / FEATURES_NAME)
    for name in config.export.formats:
        write_vector_map(vector_map, folder / EXPORT_NAMES[name], name)


def settled(config: Config, drive: Drive) -> Config:
    """The configuration with what was left open filled in, and paths that hold from anywhere.

    So that the one written beside the result makes the same map again.
    """
    model, reference = config.segmentation.model, config.compare.reference
    if model is None and config.segmentation.labels is None:
        model = find_model(drive.root)
        _LOG.info("Using the model %s.", model)
    if reference is None:
        # A vector map does not say where it ends; cells do.
        masks = [p for p in drive.reference_maps if p.suffix == ".png" or p.is_dir()]
        if len(masks) == 1:
            reference = masks[0]
            _LOG.info("Comparing with %s, which lies with the drive.", reference)
    chosen = {
        "segmentation": config.segmentation.model_copy(update={"model": model}),
        "compare": config.compare.model_copy(update={"reference": reference}),
    }
    return with_absolute_paths(config.model_copy(update=chosen))


def check_settings(config: Config, drive: Drive, segmenter: Segmenter) -> None:
    """Say what is wrong with the later steps' settings before the long first one, not after.

    Raises:
        HDMapError: As those steps would.
    """
    model_for(map_meta(config, drive, segmenter, 1), config)
    choose(config.vectorize)
    reference = config.compare.reference
    if reference is not None and not reference.exists():
        raise FormatError(
            f"The reference {reference} does not exist; expected a mask PNG, a map or a truth raster."
        )


def compare_with_reference(
    windows: dict[str, MapWindow], drive: Drive, config: Config
) -> dict[str, tuple[Reference, RasterComparison]]:
    """Hold each method's map against the reference, if there is one."""
    path = config.compare.reference
    if path is None:
        return {}
    compared = {}
    references = load_references(path, {method: one.grid for method, one in windows.items()})
    for method, reference in references.items():
        comparison = compare_raster(
            windows[method],
            reference,
            path_xy=drive.trajectory.translations[:, :2],
            max_range_m=config.compare.max_range_m,
            count_filled=config.compare.count_filled,
        )
        compared[method] = reference, comparison
    return compared


def draw_agreement(
    path: Path,
    window: MapWindow,
    compared: dict[str, tuple[Reference, RasterComparison]],
    drive: Drive,
    config: Config,
) -> None:
    """Write where the main map and the reference agree, if there is one."""
    if config.association.method not in compared:
        return
    reference, comparison = compared[config.association.method]
    agreement_picture(
        window,
        reference,
        comparison,
        path,
        trajectory_xy=drive.trajectory.translations,
        title=f"{drive.id} against {reference.source}",
    )


def draw_overview(
    path: Path,
    windows: dict[str, MapWindow],
    vector_map: VectorMap,
    drive: Drive,
    config: Config,
) -> None:
    """Write maps side by side, and a camera image without and with the map in it."""
    method = config.association.method
    window = windows[method]
    image = middle_front_image(drive, config.drive.max_pose_gap_s)
    camera = drive.cameras[image.camera]
    pose = drive.trajectory.interpolate(image.timestamp_ns, config.drive.max_pose_gap_s)
    photo = shrunk(read_image(image, camera), _PHOTO_WIDTH_PX)
    small_camera = camera.scaled(photo.shape[1], photo.shape[0])
    overlaid = project_window_into_image(window, vector_map, small_camera, pose, photo)
    panels = [Panel(f"{method}, with vectors", window, vector_map)]
    panels += [Panel(name, other) for name, other in windows.items()]
    overview_picture(
        path,
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


def middle_front_image(drive: Drive, max_pose_gap_s: float) -> ImageRef:
    """The image in the middle of the drive of the camera that looks most nearly ahead."""
    times = np.array([image.timestamp_ns for image in drive.images], dtype=np.int64)
    has_pose = drive.trajectory.covers(times, max_pose_gap_s)
    images = [image for image, ok in zip(drive.images, has_pose, strict=True) if ok]
    names = sorted({image.camera for image in images})
    ahead = max(names, key=lambda name: float(drive.cameras[name].ego_SE3_cam.rotation[0, 2]))
    images = [image for image in images if image.camera == ahead]
    return images[len(images) // 2]
