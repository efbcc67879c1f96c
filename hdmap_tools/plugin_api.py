"""The contract of vectorizer plugins: all that an author imports.

A vectorizer turns one window of the probabilistic map into map elements::

    from hdmap_tools.plugin_api import Crosswalk, MapWindow, Vectorizer, VectorizerOptions

    class MyCrosswalks(Vectorizer):
        name = "my_crosswalks"
        element_types = (Crosswalk,)

        def vectorize(self, window, upstream, options, *, rng):
            probability = window.probability("crosswalk")
            ...
            return [Crosswalk(geometry=polygon, confidence=0.9, sigma_m=0.1)]

and is registered in its distribution's ``pyproject.toml``::

    [project.entry-points."hdmap_tools.vectorizers"]
    my_crosswalks = "my_package:MyCrosswalks"

The same window, upstream, options and generator state must give the same
elements. See ``plugins/README.md`` for the whole story.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MAP_CLASSES, MapClass
from hdmap_tools.map_model.elements import (
    BoundaryKind,
    Centerline,
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    MarkColor,
    MarkStyle,
    RoadBoundary,
    SidewalkArea,
    StopLine,
    VegetationArea,
    VirtualBoundary,
)
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.types import NDArrayBool, NDArrayFloat32

if TYPE_CHECKING:
    import xarray as xr

API_VERSION: Final = "1.0"
"""Same major: accepted; newer minor than the host's: a warning; other major: refused."""

__all__ = [
    "API_VERSION",
    "DRIVABLE_CLASSES",
    "MAP_CLASSES",
    "BevGrid",
    "BoundaryKind",
    "Centerline",
    "Crosswalk",
    "LaneMark",
    "Lanelet",
    "MapClass",
    "MapElement",
    "MapFrame",
    "MapWindow",
    "MarkColor",
    "MarkStyle",
    "RoadBoundary",
    "SidewalkArea",
    "StopLine",
    "VectorMap",
    "VegetationArea",
    "Vectorizer",
    "VectorizerOptions",
    "VirtualBoundary",
]


class VectorizerOptions(BaseModel):
    """Base of a plugin's options: unknown names and wrong types are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True, eq=False)
class MapWindow:
    """A read-only window of the probabilistic map.

    Rows go north (row 0 is the south edge), columns east.

    Attributes:
        dataset: ``posterior (class, y, x)`` float32, sums to 1 over class where
            there is evidence and is NaN where there is none; beside the map's
            classes there may be a last class ``other``, none of them; ``entropy (y, x)``
            float32 in nats; ``observations (y, x)`` float32, votes per cell (0:
            filled from neighbours or unknown); ``intensity (y, x)`` float32 mean
            lidar intensity 0..255, NaN where none; ``height (y, x)`` float32 mean
            ground height in the city frame, metres, NaN where none. Coordinates
            ``class``, ``y``, ``x`` (cell centres, city metres).
        grid: Which cells these are.
    """

    dataset: xr.Dataset
    grid: BevGrid

    def __post_init__(self) -> None:
        for variable in self.dataset.variables.values():
            if isinstance(variable.data, np.ndarray):
                variable.data.setflags(write=False)

    @property
    def frame(self) -> MapFrame:
        """The city frame of the window."""
        return self.grid.frame

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the map's classes, in the order of the posterior."""
        return tuple(str(c) for c in self.dataset["class"].values)

    @property
    def is_known(self) -> NDArrayBool:
        """(y, x) bool: cells with evidence."""
        return np.asarray(np.isfinite(self.dataset["posterior"].values[0]))

    def probability(self, *classes: str) -> NDArrayFloat32:
        """(y, x) probability that the cell is any of these classes; 0 where unknown.

        A class that the map does not have counts as probability 0.
        """
        rows = [self.classes.index(c) for c in classes if c in self.classes]
        posterior = self.dataset["posterior"].values
        if not rows:
            return np.zeros(self.grid.shape, dtype=np.float32)
        summed = np.nan_to_num(posterior[rows].sum(axis=0), nan=0.0)
        return np.asarray(summed, dtype=np.float32)

    def layer(self, name: str) -> NDArrayFloat32:
        """(y, x) of ``entropy``, ``observations``, ``intensity`` or ``height``."""
        return np.asarray(self.dataset[name].values)


class Vectorizer(ABC):
    """Base class of vectorizers.

    Attributes:
        name: Lower case with underscores; equals the entry point's name.
        api_version: The plugin API it was written for.
        element_types: What it emits; anything else is refused.
        requires: Names of vectorizers whose elements it reads from ``upstream``.
        halo_m: How far from a place what it makes there may depend on the map, metres: a
            large map is vectorized in windows that overlap by so much, and their elements are
            put together again.
        scope: ``window``; or ``map`` for one that must see the whole map and the finished
            elements of those that it requires, such as one whose elements name others by id.
            Such a one is shown the map in one piece, with the memory that this takes.
        Options: Typed options, with defaults.
    """

    name: ClassVar[str]
    api_version: ClassVar[str] = API_VERSION
    element_types: ClassVar[tuple[type[MapElement], ...]]
    requires: ClassVar[tuple[str, ...]] = ()
    halo_m: ClassVar[float] = 5.0
    scope: ClassVar[Literal["window", "map"]] = "window"
    Options: type[VectorizerOptions] = VectorizerOptions

    @abstractmethod
    def vectorize(
        self, window: MapWindow, upstream: VectorMap, options: Any, *, rng: np.random.Generator
    ) -> list[MapElement]:
        """Extract elements from one window.

        Args:
            window: The map; read-only.
            upstream: Elements of the vectorizers named in ``requires``.
            options: An instance of ``Options``.
            rng: The only source of randomness.

        Returns:
            Elements with 3D geometry inside the window, city frame, metres. Leave
            ``id``, ``plugin`` and ``plugin_version`` empty: the runner fills them in.
        """
