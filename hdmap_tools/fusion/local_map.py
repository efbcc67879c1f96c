"""The map around the vehicle, in its own frame: what one place of the drive saw.

The paper's rule: observations are added into the current local frame until the pose has
moved past a threshold; then a new local map is made and the old one is carried over into it.
Carrying over resamples cells, and resampling again and again smears what it carries. So
while only the position has moved, the new frame is laid whole cells further along the
old one, which moves every count exactly; cells are resampled only when the heading
has turned past its threshold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdmap_tools.association.observations import Observations
from hdmap_tools.errors import ShapeError
from hdmap_tools.fusion.cell_counts import TILE_CELLS, CellCounts, Tile, TileIndex, combine_tiles
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.observation_model import ObservationModel
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayInt

EXTENT_M: Final = (-10.0, -15.0, 30.0, 15.0)
"""(x0, y0, x1, y1) around the rear axle, x ahead, y left."""


@dataclass(frozen=True)
class RollRule:
    """When a new local map is made.

    Attributes:
        translation_m: Distance in x-y from the local frame's origin beyond which one is.
        rotation_rad: Difference in heading beyond which one is.
    """

    translation_m: float = 1.0
    rotation_rad: float = float(np.deg2rad(5.0))


class LocalMap:
    """Counts in the ego frame; its memory does not grow with the drive.

    The local frame is level: x ahead and y left of a past pose of the vehicle, seen
    from above, within the thresholds of the present one. Heights stay those of the
    city frame, so carrying over does not change them.

    Attributes:
        meta: What the counts mean; its frame is the local one, which has no place on earth.
        grid: The cells, anchored to the local frame's origin.
        rule: When a new map is made.
        city_SE3_local: Where the local frame is; None before the first update.
        num_rolls: New maps made so far.
    """

    def __init__(
        self,
        meta: MapMeta,
        extent_m: tuple[float, float, float, float] = EXTENT_M,
        rule: RollRule | None = None,
    ) -> None:
        self.meta = meta.model_copy(update={"frame_document": MapFrame().to_json()})
        self.grid = BevGrid.from_bounds(extent_m, meta.resolution_m)
        self.rule = rule or RollRule()
        if min(self.grid.shape) < 1 or self.rule.translation_m < 0 or self.rule.rotation_rad < 0:
            raise ShapeError(
                f"A local map needs an extent x0 < x1, y0 < y1 and thresholds of at least 0, found {extent_m} "
                f"and {self.rule}."
            )
        self.city_SE3_local: SE3 | None = None
        self.num_rolls = 0
        self._held = Tile.zeros(len(meta.label_set), meta.num_bins, self.grid.shape)

    def update(self, observations: Observations, city_SE3_ego: SE3, frame_key: int) -> bool:
        """Follow the vehicle, and add what one frame saw.

        Args:
            observations: Labelled ground points, city frame.
            city_SE3_ego: Pose of the vehicle when it saw them.
            frame_key: Any number that names the frame.

        Returns:
            Whether a new local map was made.
        """
        rolled = self.follow(city_SE3_ego)
        assert self.city_SE3_local is not None
        points = self.city_SE3_local.inverse().transform_from(observations.points_city)
        points[:, 2] = observations.points_city[:, 2]
        x0, y0, x1, y1 = self.grid.bounds_m
        # One cell more: whether a point on the edge is inside is decided by its cell.
        r = self.grid.resolution_m
        inside = (
            (points[:, 0] > x0 - r) & (points[:, 0] < x1 + r)
            & (points[:, 1] > y0 - r) & (points[:, 1] < y1 + r)
        )  # fmt: skip
        seen = CellCounts(self.meta)
        seen.add(replace(observations.chosen(inside), points_city=points[inside]), frame_key)
        self._held = combine_tiles(self._held, seen.window(self.grid), 1, (0, 0))
        return rolled

    def follow(self, city_SE3_ego: SE3) -> bool:
        """Lay the local frame anew if the pose has moved past a threshold; whether it has."""
        pose = _level(city_SE3_ego)
        if self.city_SE3_local is None:
            self.city_SE3_local = pose
            return False
        moved = self.city_SE3_local.inverse() @ pose
        turned = abs(moved.yaw_rad) > self.rule.rotation_rad
        if not turned and np.hypot(*moved.translation[:2]) <= self.rule.translation_m:
            return False
        if not turned:
            r = self.grid.resolution_m
            whole = np.rint(moved.translation[:2] / r) * r
            pose = self.city_SE3_local @ SE3(np.eye(3), np.array([*whole, 0.0]))
        self._held = self._carried_over(pose)
        self.city_SE3_local = pose
        self.num_rolls += 1
        return True

    def counts(self) -> Tile:
        """A copy of the layers over `grid`."""
        return Tile({name: layer.copy() for name, layer in self._held.layers.items()})

    def window(self, model: ObservationModel, fill_radius_cells: int = 0) -> MapWindow:
        """The posterior and its companions over `grid`, in the local frame."""
        return read_window(
            _Held(self.meta, self.grid, self._held), self.grid, model, fill_radius_cells
        )

    def _carried_over(self, city_SE3_new: SE3) -> Tile:
        """What is held, as cells of another local frame: each takes the old cell under its centre."""
        assert self.city_SE3_local is not None
        xs, ys = np.meshgrid(self.grid.x_centres_m, self.grid.y_centres_m)
        centres = np.column_stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)])
        old_SE3_new = self.city_SE3_local.inverse() @ city_SE3_new
        at = self.grid.rows_cols_of(old_SE3_new.transform_from(centres))
        inside = self.grid.contains(at)
        return Tile(
            {name: _gathered(layer, at, inside) for name, layer in self._held.layers.items()}
        )


@dataclass(eq=False)
class _Held:
    """The layers of a local map in the shape in which maps are read."""

    meta: MapMeta
    grid: BevGrid
    held: Tile

    def tile_indices(self) -> tuple[TileIndex, ...]:
        """Tiles of the lattice that the local map lies on."""
        g = self.grid
        return tuple(
            (tx, ty)
            for tx in range(g.x_min // TILE_CELLS, -(-g.x_max // TILE_CELLS))
            for ty in range(g.y_min // TILE_CELLS, -(-g.y_max // TILE_CELLS))
        )

    def window(self, grid: BevGrid) -> Tile:
        """The layers over a grid of the local lattice, zeros beyond the local map."""
        window = Tile.zeros(len(self.meta.label_set), self.meta.num_bins, grid.shape)
        x0, x1 = max(grid.x_min, self.grid.x_min), min(grid.x_max, self.grid.x_max)
        y0, y1 = max(grid.y_min, self.grid.y_min), min(grid.y_max, self.grid.y_max)
        if x0 >= x1 or y0 >= y1:
            return window
        to, of = (
            (..., slice(y0 - g.y_min, y1 - g.y_min), slice(x0 - g.x_min, x1 - g.x_min))
            for g in (grid, self.grid)
        )
        for name, layer in window.layers.items():
            layer[to] = self.held.layers[name][of]
        return window


def _level(city_SE3_ego: SE3) -> SE3:
    """The pose seen from above: position in x-y and heading."""
    x, y, _ = city_SE3_ego.translation
    return SE3.from_yaw(city_SE3_ego.yaw_rad, (float(x), float(y), 0.0))


def _gathered(layer: NDArrayAny, at: NDArrayInt, inside: NDArrayBool) -> NDArrayAny:
    """A layer (..., y, x) with each cell taken from row and column `at` (cells, 2); 0 outside."""
    shape = layer.shape
    flat = layer.reshape(*shape[:-2], -1)
    taken = flat[..., np.where(inside, at[:, 0] * shape[-1] + at[:, 1], 0)]
    return np.where(inside, taken, 0).astype(layer.dtype).reshape(shape)
