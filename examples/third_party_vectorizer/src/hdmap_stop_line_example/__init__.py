"""Stop lines: bars of paint that are too wide for a lane mark and lie alone."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import shapely
from pydantic import Field
from scipy import ndimage

from hdmap_tools.plugin_api import (
    MapElement,
    MapWindow,
    StopLine,
    Vectorizer,
    VectorizerOptions,
    VectorMap,
)


class StopLineOptions(VectorizerOptions):
    """What counts as a stop line.

    Attributes:
        min_probability: Cells whose lane-mark probability is above this are paint.
        min_length_m: Shortest stop line; one lane is about 3 m wide.
        max_length_m: Longest stop line.
        min_width_m: Thinnest bar; lane marks are thinner.
        max_width_m: Thickest bar; larger pieces of paint are symbols.
    """

    min_probability: Annotated[float, Field(gt=0, lt=1)] = 0.5
    min_length_m: Annotated[float, Field(gt=0)] = 2.0
    max_length_m: Annotated[float, Field(gt=0)] = 12.0
    min_width_m: Annotated[float, Field(gt=0)] = 0.3
    max_width_m: Annotated[float, Field(gt=0)] = 0.9


class StopLineExample(Vectorizer):
    """Finds stop lines in the lane-mark probability, by the moments of each piece of paint."""

    name = "stop_line_example"
    api_version = "1.0"
    element_types = (StopLine,)
    halo_m = 12.0
    Options = StopLineOptions

    def vectorize(
        self,
        window: MapWindow,
        upstream: VectorMap,
        options: StopLineOptions,
        *,
        rng: np.random.Generator,
    ) -> list[MapElement]:
        """One stop line for each piece of paint that is a bar of the right size."""
        probability = window.probability("lane_mark")
        pieces, count = ndimage.label(probability > options.min_probability, np.ones((3, 3)))
        found = (
            self._bar(window, probability, np.argwhere(pieces == piece), options)
            for piece in range(1, count + 1)
        )
        return [stop_line for stop_line in found if stop_line is not None]

    def _bar(
        self, window: MapWindow, probability: Any, rows_cols: Any, options: StopLineOptions
    ) -> StopLine | None:
        resolution_m = window.grid.resolution_m
        share = probability[tuple(rows_cols.T)].astype(np.float64)
        # Offsets from the window's corner, not city coordinates: squares of the latter
        # would lose digits kilometres from the origin.
        points = rows_cols[:, ::-1] * resolution_m
        centre = np.average(points, axis=0, weights=share)
        covariance = np.cov((points - centre).T, aweights=share, ddof=0).reshape(2, 2)
        # Each cell is itself spread over its area.
        covariance += np.eye(2) * resolution_m**2 / 12.0
        variances, axes = np.linalg.eigh(covariance)
        width_m, length_m = np.sqrt(12.0 * variances)
        is_bar = np.isclose(share.size * resolution_m**2, width_m * length_m, rtol=0.25)
        if not (
            is_bar
            and options.min_length_m <= length_m <= options.max_length_m
            and options.min_width_m <= width_m <= options.max_width_m
        ):
            return None
        ends = centre + np.outer([-0.5, 0.5], axes[:, 1]) * length_m
        xy_city = window.grid.to_city(ends[:, ::-1] / resolution_m)
        x0, y0, x1, y1 = window.grid.bounds_m
        xy_city = np.clip(xy_city, (x0, y0), (x1, y1))
        heights = window.layer("height")[tuple(rows_cols.T)]
        heights = heights[np.isfinite(heights)]
        height_m = float(heights.mean(dtype=np.float64)) if heights.size else 0.0
        votes = window.layer("observations")[tuple(rows_cols.T)]
        return StopLine(
            geometry=shapely.LineString([(x, y, height_m) for x, y in xy_city]),
            confidence=float(np.clip(share.mean(), 0.0, 1.0)),
            sigma_m=float(width_m / np.sqrt(12.0 * share.size)),
            num_observations=int(np.median(votes)),
            width_m=float(width_m),
        )
