"""Windows of a probabilistic map with known truth, drawn from shapes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import shapely
import xarray as xr
from shapely import affinity
from shapely.geometry import LineString, Point, box
from shapely.geometry.base import BaseGeometry

from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import MAP_CLASSES
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayFloat32, NDArrayInt


def window_from_posterior(
    posterior: NDArrayFloat32,
    grid: BevGrid,
    *,
    observations: NDArrayFloat32 | None = None,
    intensity: NDArrayFloat32 | None = None,
    height: NDArrayFloat32 | None = None,
) -> MapWindow:
    """A window around a posterior (class, y, x); cells whose first class is NaN are unknown.

    Missing layers are: 10 observations where known, intensity 20, height 0.
    """
    known = np.isfinite(posterior[0])
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = -np.where(posterior > 0, posterior * np.log(posterior), 0.0).sum(axis=0)
    layers = {
        "entropy": np.where(known, entropy, np.nan),
        "observations": np.where(known, 10.0, 0.0) if observations is None else observations,
        "intensity": np.where(known, 20.0, np.nan) if intensity is None else intensity,
        "height": np.where(known, 0.0, np.nan) if height is None else height,
    }
    dataset = xr.Dataset(
        {
            "posterior": (("class", "y", "x"), posterior.astype(np.float32)),
            **{name: (("y", "x"), np.asarray(a, dtype=np.float32)) for name, a in layers.items()},
        },
        coords={
            "class": [str(c) for c in MAP_CLASSES],
            "y": grid.y_centres_m,
            "x": grid.x_centres_m,
        },
    )
    return MapWindow(dataset, grid)


def coverage(geometry: BaseGeometry, grid: BevGrid, oversampling: int = 4) -> NDArrayFloat32:
    """(y, x) share of each cell that a city-frame geometry covers, by sub-cell sampling."""
    step = grid.resolution_m / oversampling
    x0, y0 = grid.bounds_m[:2]
    xs = x0 + (np.arange(grid.shape[1] * oversampling) + 0.5) * step
    ys = y0 + (np.arange(grid.shape[0] * oversampling) + 0.5) * step
    shapely.prepare(geometry)
    inside = shapely.contains_xy(geometry, *np.meshgrid(xs, ys))
    rows, cols = grid.shape
    blocks = inside.reshape(rows, oversampling, cols, oversampling)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def window_from_shapes(
    shapes: Mapping[str, BaseGeometry],
    grid: BevGrid,
    *,
    accuracy: float = 0.95,
    background: str = "vegetation",
    unknown: BaseGeometry | None = None,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    paint_intensity: float = 80.0,
) -> MapWindow:
    """A window in which each cell believes its true class, mixed by coverage.

    Args:
        shapes: City-frame areas by map class, later ones painted over earlier ones.
        grid: Window to draw.
        accuracy: Posterior of the true class in a fully covered cell.
        background: Class where no shape lies.
        unknown: Area without any evidence.
        noise: Standard deviation of noise added to the log-posterior.
        rng: Source of that noise.
        paint_intensity: Mean lidar intensity on crosswalk and lane mark; 20 elsewhere.
    """
    names = [str(c) for c in MAP_CLASSES]
    share = np.zeros((len(names), *grid.shape), dtype=np.float64)
    share[names.index(background)] = 1.0
    for name, geometry in shapes.items():
        covered = coverage(geometry, grid)
        share *= 1.0 - covered
        share[names.index(str(name))] += covered
    rest = (1.0 - accuracy) / (len(names) - 1)
    posterior = share * (accuracy - rest) + rest
    if noise > 0.0:
        generator = rng or np.random.default_rng(0)
        posterior = posterior * np.exp(generator.normal(0.0, noise, posterior.shape))
    posterior /= posterior.sum(axis=0)
    paint = share[names.index("lane_mark")] + share[names.index("crosswalk")]
    intensity = 20.0 + (paint_intensity - 20.0) * paint
    observations = np.full(grid.shape, 10.0)
    height = np.zeros(grid.shape)
    if unknown is not None:
        hidden = coverage(unknown, grid) > 0.5
        posterior[:, hidden] = np.nan
        intensity[hidden] = np.nan
        height[hidden] = np.nan
        observations[hidden] = 0.0
    return window_from_posterior(
        posterior.astype(np.float32),
        grid,
        observations=observations.astype(np.float32),
        intensity=intensity.astype(np.float32),
        height=height.astype(np.float32),
    )


STREET_BOUNDS_M = (0.0, 0.0, 60.0, 28.0)
"""(x0, y0, x1, y1) of the street, city metres."""


def street_shapes(*, stop_line: bool = False) -> dict[str, BaseGeometry]:
    """What is true in `street_scene`, by map class: city-frame areas, later ones on top.

    A road of two lanes runs east between y = 9 m and y = 19 m, with an island in its middle at
    x = 46..53 m. Solid lines at y = 9.7 and 18.3 m leave the crosswalk at x = 36..40 m
    free (they end at 35 and begin again at 41 m); a dashed one lies at y = 14.1 m (3 m long,
    3 m apart). All are 0.2 m wide. Sidewalks 3 m wide lie on both sides, vegetation
    beyond and on the island. Road, solid lines and sidewalks go on beyond the window.
    """
    x0, x1 = STREET_BOUNDS_M[0] - 30.0, STREET_BOUNDS_M[2] + 30.0
    road = box(x0, 9.0, x1, 19.0)
    island = LineString([(47.0, 14.0), (52.0, 14.0)]).buffer(1.0)
    paint = [
        box(start, y - 0.1, end, y + 0.1)
        for y in (9.7, 18.3)
        for start, end in ((x0, 35.0), (41.0, x1))
    ]
    paint += [box(x, 14.0, x + 3.0, 14.2) for x in (1.6, 7.6, 13.6, 19.6, 25.6, 55.0)]
    if stop_line:
        paint.append(box(33.0, 10.2, 33.5, 13.4))
    return {
        "sidewalk": box(x0, 6.0, x1, 22.0),
        "road": road.difference(island),
        "lane_mark": shapely.union_all(paint),
        "crosswalk": box(36.0, 9.4, 40.0, 18.6),
        "vegetation": island,
    }


def street_scene(
    *,
    resolution_m: float = 0.2,
    angle_deg: float = 0.0,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    stop_line: bool = False,
) -> MapWindow:
    """A street with everything that the built-in vectorizers look for; see `street_shapes`.

    A disc of 2 m radius around (8, 19) m, over the northern kerb, is unknown.

    Args:
        resolution_m: Cell size.
        angle_deg: Turns the street counter-clockwise about the middle of the window.
        noise: Standard deviation of noise added to the log-posterior.
        rng: Source of that noise.
        stop_line: Paint one, 0.5 m wide, across the southern lane at x = 33 m.
    """
    grid = BevGrid.from_bounds(STREET_BOUNDS_M, resolution_m)
    x0, y0, x1, y1 = STREET_BOUNDS_M
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    shapes = {
        name: affinity.rotate(shape, angle_deg, origin=middle)
        for name, shape in street_shapes(stop_line=stop_line).items()
    }
    unknown = affinity.rotate(Point(8.0, 19.0).buffer(2.0), angle_deg, origin=middle)
    return window_from_shapes(shapes, grid, unknown=unknown, noise=noise, rng=rng)


def argmax_classes(window: MapWindow) -> NDArrayInt:
    """(y, x) index of the most probable class, -1 where unknown."""
    posterior = window.dataset["posterior"].values
    return np.where(window.is_known, np.nan_to_num(posterior).argmax(axis=0), -1)
