"""What one frame saw: the contract between association and fusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat


@dataclass(frozen=True, eq=False)
class Observations:
    """Labelled ground points of one frame (one image).

    Attributes:
        points_city: (N, 3) float64 metres, city frame: where the ground was seen.
        labels: (N,) uint8 ids of the segmentation's label set.
        intensity: (N,) uint8 lidar intensity; None when there is none at all.
        has_intensity: (N,) bool: where a return measured it; None means everywhere.
            A vote without intensity counts into the lowest bin: it is no sign of paint.
        range_m: (N,) metres over ground from the camera; None where nothing asks for it.
    """

    points_city: NDArrayFloat
    labels: NDArrayByte
    intensity: NDArrayByte | None = None
    has_intensity: NDArrayBool | None = None
    range_m: NDArrayFloat | None = None

    def __post_init__(self) -> None:
        count = len(self.labels)
        if self.points_city.shape != (count, 3) or self.labels.shape != (count,):
            raise ShapeError(
                f"Observations need points (N, 3) and labels (N,), found {self.points_city.shape} "
                f"and {self.labels.shape}."
            )
        if self.labels.dtype != np.uint8:
            raise ShapeError(f"Labels must be uint8 ids, found {self.labels.dtype}.")
        if self.intensity is not None and (
            self.intensity.shape != (count,) or self.intensity.dtype != np.uint8
        ):
            raise ShapeError(
                f"Intensity must be (N,) uint8, found {self.intensity.shape} {self.intensity.dtype}."
            )
        if self.has_intensity is not None and (
            self.intensity is None or self.has_intensity.shape != (count,)
        ):
            raise ShapeError("has_intensity must be (N,) and come with intensity.")
        if self.range_m is not None and self.range_m.shape != (count,):
            raise ShapeError(f"range_m must be (N,), found {self.range_m.shape}.")
        if not np.isfinite(self.points_city).all():
            raise ShapeError(
                "Observations hold NaN or infinite points; readers and association drop them first."
            )

    def __len__(self) -> int:
        return len(self.labels)

    def chosen(self, rows: NDArrayAny) -> Observations:
        """Those of the rows, by number or (N,) bool."""
        intensity, has_intensity, range_m = self.intensity, self.has_intensity, self.range_m
        return Observations(
            self.points_city[rows],
            self.labels[rows],
            None if intensity is None else intensity[rows],
            None if has_intensity is None else has_intensity[rows],
            None if range_m is None else range_m[rows],
        )
