"""Windows made from windows: moved, turned, cut, with other layers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayAny


def moved(window: MapWindow, cells_east: int, cells_north: int) -> MapWindow:
    """The same arrays, so many cells further east and north."""
    grid = window.grid
    return _placed(
        window,
        BevGrid(
            grid.resolution_m,
            grid.x_min + cells_east,
            grid.y_min + cells_north,
            grid.x_max + cells_east,
            grid.y_max + cells_north,
            grid.frame,
        ),
        lambda array: array,
    )


def rotated(window: MapWindow) -> MapWindow:
    """The window turned by 90 degrees counter-clockwise about city (0, 0); cells map to cells."""
    grid = window.grid
    turned = BevGrid(
        grid.resolution_m, -grid.y_max, grid.x_min, -grid.y_min, grid.x_max, grid.frame
    )
    # City (x, y) goes to (-y, x), so row r, column c goes to row c, column (rows - 1 - r).
    return _placed(window, turned, lambda array: np.swapaxes(array, -1, -2)[..., ::-1])


def cropped(window: MapWindow, rows: slice, cols: slice) -> MapWindow:
    """A part of the window; the slices have both ends."""
    grid = window.grid
    part = BevGrid(
        grid.resolution_m,
        grid.x_min + cols.start,
        grid.y_min + rows.start,
        grid.x_min + cols.stop,
        grid.y_min + rows.stop,
        grid.frame,
    )
    return _placed(window, part, lambda array: array[..., rows, cols])


def copied(window: MapWindow) -> MapWindow:
    """The same window over arrays of its own."""
    return _placed(window, window.grid, lambda array: array)


def with_layers(window: MapWindow, **layers: NDArrayAny) -> MapWindow:
    """The same window with other arrays, by name of the dataset's variable."""
    dataset = window.dataset.copy(deep=False)
    for name, array in layers.items():
        dataset[name] = (window.dataset[name].dims, array)
    return MapWindow(dataset, window.grid)


def _placed(
    window: MapWindow, grid: BevGrid, change: Callable[[NDArrayAny], NDArrayAny]
) -> MapWindow:
    dataset = xr.Dataset(
        {
            name: (variable.dims, np.array(change(np.asarray(variable.values))))
            for name, variable in window.dataset.data_vars.items()
        },
        coords={
            "class": np.array(window.dataset["class"].values),
            "y": grid.y_centres_m,
            "x": grid.x_centres_m,
        },
    )
    return MapWindow(dataset, grid)
