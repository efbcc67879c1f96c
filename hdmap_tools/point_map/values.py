"""Points of the point map, as association and refinement read them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.types import NDArrayBool, NDArrayByte, NDArrayFloat


@dataclass(frozen=True, eq=False)
class MapPoints:
    """Thinned points of a place, without what moved.

    Attributes:
        points_city: (N, 3) float64 metres, city frame.
        intensity: (N,) uint8, normalized over ring and range; comparable between drives.
        is_ground: (N,) bool: on the ground surface, or standing on it.
    """

    points_city: NDArrayFloat
    intensity: NDArrayByte
    is_ground: NDArrayBool

    def __post_init__(self) -> None:
        count = len(self.points_city)
        if (
            self.points_city.shape != (count, 3)
            or self.intensity.shape != (count,)
            or self.is_ground.shape != (count,)
        ):
            raise ShapeError(
                f"Map points need points (N, 3), intensity (N,) and is_ground (N,), found "
                f"{self.points_city.shape}, {self.intensity.shape}, {self.is_ground.shape}."
            )

    def __len__(self) -> int:
        return len(self.points_city)

    @classmethod
    def joined(cls, parts: list[MapPoints]) -> MapPoints:
        """All of them, in order; none give an empty one."""
        if not parts:
            return cls(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0, bool))
        return cls(
            np.concatenate([part.points_city for part in parts]),
            np.concatenate([part.intensity for part in parts]),
            np.concatenate([part.is_ground for part in parts]),
        )
