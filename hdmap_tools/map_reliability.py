"""A semantic map held against truth: how far its probabilities can be believed."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.compare.paper import PAINT_SHARE, true_classes
from hdmap_tools.compare.reference import load_reference
from hdmap_tools.compare.reliability import (
    CellTruth,
    ReliabilityReport,
    assess,
    truth_of_classes,
    truth_of_reference,
)
from hdmap_tools.config import Config
from hdmap_tools.errors import ConfigError, FormatError
from hdmap_tools.fusion.map_location import MapLocation
from hdmap_tools.fusion.observation_model import OTHER
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.fusion.temperature import BLOCK_M, checkerboard, read_evidence
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import MAP_CLASSES
from hdmap_tools.map_reading import model_for
from hdmap_tools.output_folder import CONFIG_NAME, result_folder
from hdmap_tools.view.reliability_diagram import reliability_picture

REPORT_NAME: Final = "reliability.json"
PICTURE_NAME: Final = "reliability.png"
INTENSITY_NAME: Final = "intensity.json"
"""What classes look like, where the map was read with an intensity term that it taught itself."""


def reliability_alone(
    map_path: MapLocation,
    truth_path: Path,
    out: Path,
    config: Config,
    *,
    paint_share: float = PAINT_SHARE,
    block_m: float = BLOCK_M,
    overwrite: bool = False,
) -> ReliabilityReport:
    """Judge a map's probabilities, fit a temperature, and write figures and a diagram into a folder.

    The temperature is fitted on the white squares of a checkerboard and tried on the
    black ones, so that what is reported was not fitted on.

    Args:
        map_path: The semantic map.
        truth_path: Truth raster of a simulated drive (folder), a mask picture with its
            JSON, or a vector map.
        out: Folder to make.
        config: How the map is read.
        paint_share: Share of a cell that must be paint for it to be lane mark; truth
            rasters only.
        block_m: Side of a square of the checkerboard, metres.
        overwrite: Replace an earlier result.

    Raises:
        ConfigError: If block_m is smaller than a cell.
        FormatError: If the truth cannot be read or is of another place.
        ShapeError: If map and truth have too little in common.
    """
    with result_folder(out, "reliability", overwrite) as folder:
        semantic_map = SemanticMap.open(map_path)
        meta = semantic_map.meta
        if not block_m >= meta.resolution_m:
            raise ConfigError(
                f"Squares of {block_m} m are smaller than the map's cells of {meta.resolution_m} m."
            )
        grid = semantic_map.grid or BevGrid(meta.resolution_m, 0, 0, 1, 1, meta.frame)
        model = model_for(meta, config, semantic_map)
        truth = load_truth(truth_path, grid, model.classes, paint_share)
        # Filled cells have no votes of their own, and are not what a temperature is about.
        cells = read_evidence(semantic_map, grid, model, truth.index >= 0)
        rule = f"squares of {block_m:g} m: white ones fitted on, black ones tried on"
        report = assess(
            cells, truth, checkerboard(grid, block_m), rule, config.observation.temperature
        )
        (folder / REPORT_NAME).write_text(report.to_json(), encoding="utf-8")
        reliability_picture(report, folder / PICTURE_NAME)
        if model.intensity is not None:
            model.intensity.save(folder / INTENSITY_NAME)
        (folder / CONFIG_NAME).write_text(config.to_yaml(), encoding="utf-8")
    return report


def load_truth(
    path: Path, grid: BevGrid, classes: tuple[str, ...], paint_share: float = PAINT_SHARE
) -> CellTruth:
    """Truth about the cells of a grid from a truth raster, a mask picture or a vector map.

    Raises:
        FormatError: If it cannot be read or is of another place.
        LabelError: If it tells no two of the map's classes apart.
    """
    if not path.is_dir():
        return truth_of_reference(load_reference(path, grid), classes)
    from hdmap_tools.compare.truth_reference import true_shares
    from hdmap_tools.simulate.truth_raster import TruthRaster

    names = [str(c) for c in MAP_CLASSES]
    shares = true_shares(TruthRaster.open(path), grid)
    if not np.isfinite(shares).any():
        raise FormatError(
            f"The truth raster {path} does not overlap the map; it belongs to another place."
        )
    index = true_classes(shares, names, paint_share)
    return truth_of_classes(index, [*names, OTHER], classes, path.name)
