"""The lie of the land: a smooth height for every place, from a seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from hdmap_tools.simulate.location_noise import Purpose, rng_at
from hdmap_tools.types import NDArrayFloat

_BANDS: Final = (
    # waves, shortest and longest wavelength in m, slope of all together (one sigma)
    (3, 220.0, 420.0, 0.018),
    (4, 90.0, 200.0, 0.014),
    (5, 30.0, 80.0, 0.005),
    (8, 3.0, 9.0, 0.0012),
)
"""Hills, undulation and unevenness. Slopes are what a vehicle and a plane notice, so bands are
given by slope; the last is the evenness of a fair road, about 2 mm."""


class Terrain:
    """Height of the ground at any place: a sum of seeded waves, so smooth and exact everywhere.

    Attributes:
        seed: Everything follows from it.
        is_flat: Whether the bare height is 0 everywhere.
        crown: What the road adds at city points (N, 2), `RoadCrown` of the world; None for
            a road as level across as the land.
    """

    def __init__(
        self,
        seed: int,
        is_flat: bool = False,
        crown: Callable[[NDArrayFloat], NDArrayFloat] | None = None,
    ) -> None:
        self.seed = seed
        self.is_flat = is_flat
        self.crown = crown
        rng = rng_at(seed, Purpose.TERRAIN)
        vectors, amplitudes, phases = [], [], []
        for count, shortest_m, longest_m, slope in _BANDS:
            wavelengths = np.exp(rng.uniform(np.log(shortest_m), np.log(longest_m), count))
            # Spread evenly over the half circle, so that no direction stays level.
            headings = (np.arange(count) + rng.uniform(0, 1, count)) * np.pi / count
            k = 2.0 * np.pi / wavelengths
            vectors.append(np.column_stack([k * np.cos(headings), k * np.sin(headings)]))
            # A wave of amplitude a has slopes a·k / √2 (one sigma) along its heading.
            amplitudes.append(slope * np.sqrt(2.0 / count) * np.sqrt(2.0) / k)
            phases.append(rng.uniform(0, 2 * np.pi, count))
        self._vectors = np.concatenate(vectors)
        self._amplitudes = np.concatenate(amplitudes)
        self._phases = np.concatenate(phases)

    def height_at(self, xy: NDArrayFloat) -> NDArrayFloat:
        """(N,) metres of the road surface at city points (N, 2)."""
        height = self.bare_height_at(xy)
        if self.crown is not None:
            height += self.crown(np.asarray(xy, dtype=np.float64))
        return height

    def bare_height_at(self, xy: NDArrayFloat) -> NDArrayFloat:
        """(N,) metres of the land without the crown of the road."""
        xy = np.asarray(xy, dtype=np.float64)
        height = np.zeros(len(xy))
        if self.is_flat:
            return height
        for (kx, ky), amplitude, phase in zip(
            self._vectors, self._amplitudes, self._phases, strict=True
        ):
            height += amplitude * np.sin(kx * xy[:, 0] + ky * xy[:, 1] + phase)
        return height

    def gradient_at(self, xy: NDArrayFloat) -> NDArrayFloat:
        """(N, 2) slope of the land east and north, metres a metre; without the crown."""
        xy = np.asarray(xy, dtype=np.float64)
        gradient = np.zeros((len(xy), 2))
        if self.is_flat:
            return gradient
        for vector, amplitude, phase in zip(
            self._vectors, self._amplitudes, self._phases, strict=True
        ):
            gradient += (amplitude * np.cos(xy @ vector + phase))[:, None] * vector
        return gradient
