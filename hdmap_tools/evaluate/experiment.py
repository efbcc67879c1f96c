"""The paper's experiment on a simulated drive: its four methods and ours, against exact truth."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.compare.paper import (
    ANY_PAINT,
    PAINT_SHARE,
    PaperScores,
    paper_scores,
    true_classes,
)
from hdmap_tools.compare.reliability import reliability, truth_of_classes
from hdmap_tools.config import Config, ObservationConfig
from hdmap_tools.errors import ConfigError
from hdmap_tools.evaluate.calibration import TruthOfDrive, confusion_of_drives
from hdmap_tools.evaluate.decision import fit_decision, weighted
from hdmap_tools.evaluate.maps import fuse_variants
from hdmap_tools.evaluate.methods import (
    ASSOCIATIONS,
    BANDS_M,
    BY_RANGE,
    CLIP,
    CONFUSION_EDGES_M,
    COUNT_MODES,
    MODE_METHODS,
    OUR_MAP,
    OUR_METHODS,
    OURS,
    PAPER_METHODS,
    Method,
    band_name,
)
from hdmap_tools.evaluate.regions import passed_mask, terrain_masks
from hdmap_tools.evaluate.report import DriveEvaluation, MethodScores
from hdmap_tools.fusion.intensity_likelihood import IntensityLikelihood
from hdmap_tools.fusion.learn_intensity import learn_from_truth
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.observation_model import OTHER, ObservationModel, observation_model
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.fusion.temperature import fit_temperature, read_evidence
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import MAP_CLASSES
from hdmap_tools.opening import open_configured
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.point_map.for_drive import with_points
from hdmap_tools.readers.drive import Drive
from hdmap_tools.segmentation.cache import LabelCache
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.steps import Steps
from hdmap_tools.types import NDArrayBool, NDArrayFloat

_LOG = logging.getLogger(__name__)

_NAMES: Final = tuple(str(c) for c in MAP_CLASSES)


@dataclass(frozen=True, eq=False)
class Evaluated:
    """What an evaluation made, for its report and pictures.

    Attributes:
        evaluation: The figures.
        windows: Maps by method, read with hole filling.
        truth: (y, x) true class, index into the map classes and ``other``; negative outside.
        mask: (y, x) cells that were compared.
        maps: Counts by variant.
        models: How each method read them.
        confusion: As measured on the calibration drives.
        drive: At the poses that were used.
        config: With the point map that was used.
    """

    evaluation: DriveEvaluation
    windows: dict[str, MapWindow]
    truth: np.ndarray
    mask: NDArrayBool
    maps: dict[str, SemanticMap]
    models: dict[str, ObservationModel]
    confusion: ConfusionMatrix
    drive: Drive
    config: Config


@dataclass(frozen=True, eq=False)
class Learned:
    """What the calibration drives taught.

    Attributes:
        drive_ids: Of the drives.
        confusion: By range, over all of them.
        intensity: What each class looks like, on the first.
        priors: Share of each class, and of ``other``, in what the first saw.
        temperature: Fitted on the first.
        decision: Weights of classes that do best on the first.
    """

    drive_ids: tuple[str, ...]
    confusion: ConfusionMatrix
    intensity: IntensityLikelihood
    priors: dict[str, float]
    temperature: float = 1.0
    decision: dict[str, float] = field(default_factory=dict)


def evaluate_drive(
    drive_path: Path,
    learned: Learned,
    scratch: Path,
    config: Config,
    *,
    cache: LabelCache | None = None,
    steps: Steps | None = None,
) -> Evaluated:
    """Run the experiment on one drive.

    Args:
        drive_path: The drive to be evaluated, simulated.
        learned: From other drives (`learn`).
        scratch: Folder for point maps and semantic maps; exists.
        config: Cell size, segmentation, point map; methods and observation models are set here.
        cache: Where label images are kept.
        steps: Told of progress.

    Raises:
        ConfigError: If the drive has no truth, or taught what it is to be evaluated with.
    """
    steps = steps or Steps()
    drive = open_configured(config, drive_path)
    TruthOfDrive.of(drive)
    if drive.id in learned.drive_ids:
        raise ConfigError(
            f"Drive {drive.name} cannot be evaluated with what was measured on itself."
        )
    segmenter = open_segmenter(config.segmentation, drive)
    config, drive = _with_points(config, drive, scratch / "evaluated", steps)
    with steps.timed("fuse"):
        maps = fuse_variants(
            drive,
            segmenter,
            config,
            (*CLIP, *COUNT_MODES, *BY_RANGE),
            _made(scratch / "maps"),
            cache,
            steps,
        )
    with steps.timed("score"):
        return _scored(drive, config, maps, learned, segmenter.name, steps)


def learn(
    calibration_paths: Sequence[Path],
    scratch: Path,
    config: Config,
    *,
    cache: LabelCache | None = None,
    steps: Steps | None = None,
) -> Learned:
    """Measure confusion, priors, intensity, temperature and decision on simulated drives.

    Args:
        calibration_paths: Drives: on all of them the confusion matrix is measured, on the
            first also the rest.
        scratch: Folder for point maps and semantic maps; exists.
        config: As for `evaluate_drive`.
        cache: Where label images are kept.
        steps: Told of progress.

    Raises:
        ConfigError: If there is no drive, or one has no truth.
    """
    steps = steps or Steps()
    if not calibration_paths:
        raise ConfigError(
            "An evaluation needs another drive on which confusion, intensity and temperature are "
            "measured; give one, or a world in which one can be simulated."
        )
    others = [open_configured(config, path) for path in calibration_paths]
    for one in others:
        TruthOfDrive.of(one)
    with steps.timed("calibrate"):
        segmenters = [open_segmenter(config.segmentation, other) for other in others]
        confusion = confusion_of_drives(others, segmenters, CONFUSION_EDGES_M, cache)
    config, drive = _with_points(config, others[0], scratch / "calibration", steps)
    with steps.timed("calibrate"):
        made = fuse_variants(
            drive,
            segmenters[0],
            config,
            [v for v in CLIP if v.name == OUR_MAP],
            _made(scratch / "calibration_maps"),
            cache,
            steps,
        )[OUR_MAP]
        grid = made.grid
        if grid is None:
            raise ConfigError(f"Calibration drive {drive.name} saw no ground.")
        shares = TruthOfDrive.of(drive).shares(grid)
        intensity = learn_from_truth(made, grid, shares, _NAMES, f"simulated drive {drive.name}")
        learned = Learned(
            tuple(other.id for other in others),
            confusion,
            intensity,
            _class_shares(made, grid, shares),
        )
        model = _model(OURS, made.meta, learned)
        truth = truth_of_classes(
            true_classes(shares, _NAMES), (*_NAMES, OTHER), model.classes, drive.name
        )
        cells = read_evidence(made, grid, model, truth.index >= 0)
        rows, cols = cells.cells.T
        fit = fit_temperature(cells.evidence, truth.index[rows, cols], cells.offset)
        learned = replace(learned, temperature=fit.temperature)
        window = read_window(made, grid, model, 1)
        decision = fit_decision(window.dataset["posterior"].values, truth.index, model.classes)
    _LOG.info(
        "Temperature %.2f on %d cells of %s; weights of the decision %s.",
        fit.temperature,
        fit.num_cells,
        drive.id,
        decision,
    )
    return replace(learned, decision=decision)


def _class_shares(made: SemanticMap, grid: BevGrid, shares: NDArrayFloat) -> dict[str, float]:
    """Share of each class, and of ``other``, in the true area of the cells that a map knows."""
    seen = made.window(grid).layers["counts"].any(axis=(0, 1)) & np.isfinite(shares).all(axis=0)
    mean = shares[:, seen].mean(axis=1)
    rest = max(1.0 - float(mean.sum()), 0.0)
    # No class is impossible because one drive did not meet it.
    least = 1e-3
    found = {name: max(float(m), least) for name, m in zip(_NAMES, mean, strict=True)}
    found[OTHER] = max(rest, least)
    total = sum(found.values())
    return {name: share / total for name, share in found.items()}


def _scored(
    drive: Drive,
    config: Config,
    maps: dict[str, SemanticMap],
    learned: Learned,
    segmenter: str,
    steps: Steps,
) -> Evaluated:
    grids = [grid for made in maps.values() if (grid := made.grid) is not None]
    if not grids:
        raise ConfigError(f"Drive {drive.name} saw no ground, so there is nothing to evaluate.")
    grid = grids[0]
    for other in grids[1:]:
        grid = grid.union(other)
    shares = TruthOfDrive.of(drive).shares(grid)
    gap = config.drive.max_pose_gap_s
    poses = [drive.trajectory.interpolate(image.timestamp_ns, gap) for image in drive.images]
    models = {
        m.name: _model(m, maps[m.map_name].meta, learned)
        for m in (*PAPER_METHODS, *OUR_METHODS, *MODE_METHODS)
    }
    windows = {
        method.name: read_window(maps[method.map_name], grid, models[method.name], 1)
        for method in (*PAPER_METHODS, *OUR_METHODS, *MODE_METHODS)
    }
    # Compared is what the drive could see: cells with a point that fell into an image.
    mask = _has_votes(windows["CFN"])
    methods = {}
    for method in (*PAPER_METHODS, *OUR_METHODS, *MODE_METHODS):
        window = windows[method.name]
        weights = learned.decision if method.uses_decision else {}
        methods[method.name] = MethodScores(
            filled=_scores(window, shares, mask, weights=weights),
            unfilled=_scores(window, shares, mask, weights=weights, with_filled=False),
            any_paint=_scores(window, shares, mask, ANY_PAINT, weights),
        )
    by_range, by_terrain = _by_place(drive, config, grid, maps, models["CFN"], shares, poses)
    ours = models["ours"]
    truth = true_classes(shares, _NAMES)
    told = truth_of_classes(truth, (*_NAMES, OTHER), ours.classes, drive.name)
    cells = read_evidence(maps[OUR_MAP], grid, ours, told.index >= 0)
    rows, cols = cells.cells.T
    true_of_cells = told.index[rows, cols]
    evaluation = DriveEvaluation(
        world=drive.name,
        drive=drive.id,
        calibration=learned.drive_ids,
        segmenter=segmenter,
        length_m=drive.trajectory.length_m,
        num_images=len(drive.images),
        resolution_m=config.fusion.resolution_m,
        methods=methods,
        by_range=by_range,
        by_terrain=by_terrain,
        temperature=learned.temperature,
        decision=learned.decision,
        priors=learned.priors,
        reliability_before=reliability(cells.posterior(), true_of_cells, names=ours.classes),
        reliability_after=reliability(
            cells.posterior(learned.temperature), true_of_cells, names=ours.classes
        ),
        recall={str(c): a.recall for c, a in learned.confusion.class_agreement().items()},
        seconds={name: round(value, 2) for name, value in steps.seconds.items()},
    )
    return Evaluated(
        evaluation, windows, truth, mask, maps, models, learned.confusion, drive, config
    )


def _by_place(
    drive: Drive,
    config: Config,
    grid: BevGrid,
    maps: dict[str, SemanticMap],
    model: ObservationModel,
    shares: NDArrayFloat,
    poses: Sequence[SE3],
) -> tuple[dict[str, dict[str, PaperScores]], dict[str, dict[str, PaperScores]]]:
    """Methods of association by distance ahead, and by how the road runs, over what each knows."""
    terrain = terrain_masks(grid, drive.trajectory)
    by_range: dict[str, dict[str, PaperScores]] = {}
    by_terrain: dict[str, dict[str, PaperScores]] = {}
    for method in ASSOCIATIONS:
        for band in BANDS_M:
            passed = passed_mask(grid, poses, band, config.association.clip_across_m)
            window = read_window(maps[band_name(method, band)], grid, model, 0)
            by_range.setdefault(method, {})[f"{band[0]:g} to {band[1]:g} m"] = _where_known(
                window, shares, passed
            )
            if band == BANDS_M[1]:
                by_terrain[method] = {
                    name: _where_known(window, shares, passed & part)
                    for name, part in terrain.items()
                    if (passed & part).any()
                }
    return by_range, by_terrain


def _where_known(window: MapWindow, shares: NDArrayFloat, mask: NDArrayBool) -> PaperScores:
    """Scores over the cells that the map knows; coverage over all of the mask."""
    known = np.isfinite(window.dataset["posterior"].values).all(axis=0)
    coverage = _scores(window, shares, mask).coverage
    return _scores(window, shares, mask & known).model_copy(update={"coverage": coverage})


def _has_votes(window: MapWindow) -> NDArrayBool:
    """(y, x) bool: cells with votes of their own, not filled from their neighbours."""
    return np.asarray(window.dataset["observations"].values > 0)


def _scores(
    window: MapWindow,
    shares: NDArrayFloat,
    mask: NDArrayBool,
    paint_share: float = PAINT_SHARE,
    weights: dict[str, float] | None = None,
    *,
    with_filled: bool = True,
) -> PaperScores:
    posterior = weighted(window.dataset["posterior"].values, window.classes, weights or {})
    if not with_filled:
        posterior[:, ~_has_votes(window)] = np.nan
    return paper_scores(posterior, window.classes, shares, _NAMES, mask, paint_share=paint_share)


def _model(method: Method, meta: MapMeta, learned: Learned) -> ObservationModel:
    given: dict[str, Any] = dict(method.observation)
    if method.uses_temperature:
        given["temperature"] = learned.temperature
    if method.uses_priors:
        given["priors"] = {name: learned.priors[name] for name in _NAMES}
        given["other_prior"] = learned.priors[OTHER]
    config = ObservationConfig.model_validate(given)
    model = observation_model(config, meta, MAP_CLASSES, learned.confusion)
    if method.uses_learned_intensity:
        model = model.with_intensity(learned.intensity, config.intensity_weight)
    return model


def _with_points(config: Config, drive: Drive, scratch: Path, steps: Steps) -> tuple[Config, Drive]:
    with steps.timed("points"):
        dense = config.association.model_copy(update={"method": "dense"})
        return with_points(config.model_copy(update={"association": dense}), drive, scratch)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder
