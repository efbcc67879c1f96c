"""Reading a semantic map with the observation model that a configuration asks for."""

from __future__ import annotations

import json

from hdmap_tools.config import Config
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.learn_intensity import learn_from_map
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.observation_model import ObservationModel, observation_model
from hdmap_tools.fusion.read_window import HasCounts, read_window
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.segmentation.confusion import ConfusionMatrix, find_confusion


def model_for(meta: MapMeta, config: Config, source: HasCounts | None = None) -> ObservationModel:
    """The observation model to read a map with.

    Args:
        meta: What the map's counts mean.
        config: The model asked for.
        source: The map, from which what intensity says is learned where that is asked for
            and no file is given; without it the model has no such term.

    Raises:
        ConfigError, LabelError: As `observation_model`, and if the matrix cannot be read.
        ShapeError: If intensity is to be learned from a map without any.
    """
    confusion = None
    if config.observation.confusion is not None:
        confusion = ConfusionMatrix.load(config.observation.confusion)
    elif config.observation.model != "vanilla" and meta.confusion is not None:
        confusion = ConfusionMatrix.from_json(
            json.dumps(meta.confusion), "The confusion matrix that the map carries"
        )
    elif config.observation.model != "vanilla":
        confusion = find_confusion(meta.label_set, meta.model)
    model = observation_model(config.observation, meta, config.classes, confusion)
    learns = config.observation.intensity == "learned" and model.intensity is None
    if not learns or source is None:
        return model
    weight = config.observation.intensity_weight
    return model.with_intensity(learn_from_map(source, model, weight=weight), weight)


def whole_window(
    source: SemanticMap | CellCounts, model: ObservationModel, config: Config
) -> MapWindow:
    """All of a map, read through an observation model; one cell where there is none."""
    grid = source.grid or BevGrid(source.meta.resolution_m, 0, 0, 1, 1, source.meta.frame)
    return read_window(source, grid, model, config.observation.fill_radius_cells)
