"""The bird's-eye-view grid: which cell a city point falls in."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdmap_tools.errors import MapMismatchError, ShapeError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt


@dataclass(frozen=True)
class BevGrid:
    """A window of the cell lattice that is anchored at city (0, 0).

    Cell (ix, iy) covers ``[ix, ix + 1) * resolution_m`` east and the same north.
    Two grids of one resolution therefore share cell edges, and merging maps
    needs no resampling. Arrays over a grid are (y, x): row 0 is the **south**
    edge and rows go north; only pictures are turned north-up, by `to_picture`.

    Attributes:
        resolution_m: Cell size, metres.
        x_min, y_min: First cell index, inclusive.
        x_max, y_max: Last cell index, exclusive.
        frame: The city frame the cells lie in.
    """

    resolution_m: float
    x_min: int
    y_min: int
    x_max: int
    y_max: int
    frame: MapFrame = MapFrame()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.resolution_m) and self.resolution_m > 0):
            raise ShapeError(f"Grid resolution must be positive metres, found {self.resolution_m}.")
        if self.x_max < self.x_min or self.y_max < self.y_min:
            raise ShapeError(
                f"Grid bounds are reversed: x {self.x_min}..{self.x_max}, y {self.y_min}..{self.y_max}."
            )

    @classmethod
    def from_bounds(
        cls,
        bounds_m: tuple[float, float, float, float],
        resolution_m: float,
        frame: MapFrame | None = None,
    ) -> BevGrid:
        """The smallest grid that covers (x0, y0, x1, y1) in city metres."""
        if not (math.isfinite(resolution_m) and resolution_m > 0):
            raise ShapeError(f"Grid resolution must be positive metres, found {resolution_m}.")
        if not all(math.isfinite(b) for b in bounds_m):
            raise ShapeError(f"Grid bounds must be finite city metres, found {tuple(bounds_m)}.")
        x0, y0, x1, y1 = (b / resolution_m for b in bounds_m)
        # A bound that is a whole number of cells but for rounding stays that number.
        slack = 1e-9
        return cls(
            resolution_m,
            math.floor(x0 + slack),
            math.floor(y0 + slack),
            math.ceil(x1 - slack),
            math.ceil(y1 - slack),
            frame or MapFrame(),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns), that is (y, x)."""
        return self.y_max - self.y_min, self.x_max - self.x_min

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) of the outer cell edges, city metres."""
        r = self.resolution_m
        return self.x_min * r, self.y_min * r, self.x_max * r, self.y_max * r

    @property
    def x_centres_m(self) -> NDArrayFloat:
        """City x of the cell centres of each column, metres."""
        return (np.arange(self.x_min, self.x_max, dtype=np.float64) + 0.5) * self.resolution_m

    @property
    def y_centres_m(self) -> NDArrayFloat:
        """City y of the cell centres of each row, metres, south to north."""
        return (np.arange(self.y_min, self.y_max, dtype=np.float64) + 0.5) * self.resolution_m

    def cells_of(self, xy_city: NDArrayFloat) -> NDArrayInt:
        """Lattice cells (N, 2) as (ix, iy) of city points (N, 2) or (N, 3); floor, not truncation."""
        return cells_of(xy_city, self.resolution_m)

    def rows_cols_of(self, xy_city: NDArrayFloat) -> NDArrayInt:
        """Array positions (N, 2) as (row, col); may lie outside the grid."""
        cells = self.cells_of(xy_city)
        return np.column_stack([cells[:, 1] - self.y_min, cells[:, 0] - self.x_min])

    def contains(self, rows_cols: NDArrayInt) -> NDArrayBool:
        """(N,) bool: which array positions lie inside."""
        rows, cols = self.shape
        return np.asarray(
            (rows_cols[:, 0] >= 0)
            & (rows_cols[:, 0] < rows)
            & (rows_cols[:, 1] >= 0)
            & (rows_cols[:, 1] < cols)
        )

    def to_city(self, rows_cols: NDArrayFloat) -> NDArrayFloat:
        """City points (N, 2) of fractional array positions (row, col); whole numbers are cell centres."""
        rows_cols = np.asarray(rows_cols, dtype=np.float64)
        return np.column_stack(
            [
                (rows_cols[:, 1] + self.x_min + 0.5) * self.resolution_m,
                (rows_cols[:, 0] + self.y_min + 0.5) * self.resolution_m,
            ]
        )

    def to_grid(self, xy_city: NDArrayFloat) -> NDArrayFloat:
        """Fractional array positions (N, 2) as (row, col) of city points; inverse of `to_city`."""
        xy_city = np.asarray(xy_city, dtype=np.float64)
        return np.column_stack(
            [
                xy_city[:, 1] / self.resolution_m - self.y_min - 0.5,
                xy_city[:, 0] / self.resolution_m - self.x_min - 0.5,
            ]
        )

    def expand(self, cells: int) -> BevGrid:
        """The grid with a margin of so many cells on each side."""
        return BevGrid(
            self.resolution_m,
            self.x_min - cells,
            self.y_min - cells,
            self.x_max + cells,
            self.y_max + cells,
            self.frame,
        )

    def union(self, other: BevGrid) -> BevGrid:
        """The smallest grid that covers both."""
        self.require_same_lattice(other)
        return BevGrid(
            self.resolution_m,
            min(self.x_min, other.x_min),
            min(self.y_min, other.y_min),
            max(self.x_max, other.x_max),
            max(self.y_max, other.y_max),
            self.frame,
        )

    def require_same_lattice(self, other: BevGrid) -> None:
        """Raise unless both grids have one resolution and one frame."""
        if self.resolution_m != other.resolution_m:
            raise MapMismatchError(
                f"Grids differ in resolution: {self.resolution_m} m and {other.resolution_m} m; "
                "build both maps at one resolution."
            )
        self.frame.require_same(other.frame)


def cells_of(xy_city: NDArrayFloat, resolution_m: float) -> NDArrayInt:
    """Lattice cells (N, 2) as (ix, iy) of city points (N, 2) or (N, 3).

    Floor, not truncation: truncation folds the cells (-1, 0) into 0.
    """
    return np.floor(np.asarray(xy_city, dtype=np.float64)[:, :2] / resolution_m).astype(np.int64)


def to_picture(array: Any) -> Any:
    """Turn an array over a grid, rows going north, into a picture with north up."""
    return np.asarray(array)[::-1]
