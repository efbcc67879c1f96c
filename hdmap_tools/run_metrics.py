"""What a run reports: metrics.json."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict

from hdmap_tools.compare.raster import RasterComparison

_REPORTED: Final = ("hdmap-tools", "numpy", "shapely", "pyproj", "zarr", "icechunk", "onnxruntime")


class RunMetrics(BaseModel):
    """Figures of one `hdmap run`.

    Attributes:
        drive: ``<layout>:<name>``.
        model: Segmentation model.
        association: Method whose map was written and vectorized.
        resolution_m: Cell size.
        intensity_threshold: k, 0..255.
        num_images: Images fused.
        num_images_dropped: Images left out, by reason.
        num_observations: Labelled ground points by camera.
        num_tiles: Tiles of the map with evidence.
        num_elements: Vector map elements by type.
        plugins: Vectorizers that ran, with distribution, version and options.
        failures: Vectorizers that gave nothing, and why.
        comparisons: Against the reference, by method of association.
        seconds: Wall time by step.
        warnings: What the reader left out.
        versions: Python and packages.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    drive: str
    model: str
    association: str
    resolution_m: float
    intensity_threshold: int
    num_images: int
    num_images_dropped: dict[str, int]
    num_observations: dict[str, int]
    num_tiles: int
    num_elements: dict[str, int]
    plugins: list[dict[str, Any]]
    failures: dict[str, str]
    comparisons: dict[str, RasterComparison]
    seconds: dict[str, float]
    warnings: tuple[str, ...]
    versions: dict[str, str]

    def to_json(self) -> str:
        """The document, indented, with a line break at its end."""
        return self.model_dump_json(indent=2) + "\n"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for name in _REPORTED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
