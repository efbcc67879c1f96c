"""The dense engine: labels of an image straight into counts, without observations in between.

The same method as `association.dense.associate_dense` and `CellCounts.add`, point by point in
float32 instead of float64. Points lie sorted by cell; cells outside of clip and view are
passed over by the row; what is left is projected in one vector loop, looked up, and voted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.association.dense import MAP_GAP_DEG, clip_bounds_m, sweep_hides_from_m
from hdmap_tools.association.lookup import speaks_of_ground
from hdmap_tools.association.visibility import CELL_PX, MARGIN_M, NEAREST_M, depth_shape, widened
from hdmap_tools.config import AssociationConfig
from hdmap_tools.errors import ConfigError
from hdmap_tools.fusion.block_kernels import lay_block, rows_in_view, see_block
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.point_blocks import POINTS_BYTES, PointBlock, PointBlocks, SortedPoints
from hdmap_tools.geometry.camera import MIN_DEPTH_M, PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet
from hdmap_tools.point_map.point_map import PointMap
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32, NDArrayInt

_CULLING_MARGIN_PX: Final = 1.0
"""Cells are passed over where they lie so far outside of the image: float32 rounds by much less."""


class DenseFusion:
    """Adds images to counts through a point map.

    Attributes:
        meta: Of the counts that can be added to.

    Args:
        points: The point map.
        meta: Of the counts that will be added to.
        config: Clip, `min_range_m` from the camera, occlusion test.
        max_bytes: Of points kept in memory.

    Raises:
        ConfigError: If counts are kept apart by range, which only observations can be.
    """

    def __init__(
        self,
        points: PointMap,
        meta: MapMeta,
        config: AssociationConfig,
        max_bytes: int = POINTS_BYTES,
    ) -> None:
        if meta.range_edges_m:
            raise ConfigError("The dense engine does not count by range (fusion.range_edges_m).")
        self.meta, self._config = meta, config
        self._blocks = PointBlocks(points, meta, max_bytes)
        self._slot_of = slots_of(meta.label_set)
        self._slots = np.zeros(0, dtype=np.uint16)
        self._labels = np.zeros(0, dtype=np.uint8)

    def add(
        self,
        counts: CellCounts,
        label_image: NDArrayByte,
        camera: PinholeCamera,
        city_SE3_ego: SE3,
        frame_key: int,
        standing_city: NDArrayFloat | None = None,
        ring_gap_deg: float = 2.1,
    ) -> int:
        """Add the votes of one image; gives the number of ground points that it labelled.

        Args:
            counts: Changed; of the engine's meta.
            label_image: (height, width) uint8 ids, the camera's size.
            camera: Calibrated camera.
            city_SE3_ego: Ego pose at the image's own time.
            frame_key: Any number that names the frame; it only breaks ties.
            standing_city: (M, 3) returns of the live sweep that are not ground, city
                metres; None without a sweep.
            ring_gap_deg: Angle between that sweep's rings, degrees.
        """
        config, frame = self._config, FrameView.of(camera, city_SE3_ego, self._config)
        counts.num_frames += 1
        labels = self._with_none(label_image)
        size_px = (camera.width_px, camera.height_px)
        indices = self._blocks.within(clip_bounds_m(city_SE3_ego, config))
        blocks = [block for index in indices if len(block := self._blocks.block(index))]
        hides = np.zeros((0, 0), dtype=np.float32)
        if config.occlusion_test:
            hides = self._hides_from_m(blocks, frame, camera)
            if standing_city is not None and len(standing_city):
                live = sweep_hides_from_m(standing_city, camera, city_SE3_ego, ring_gap_deg)
                hides = np.minimum(hides, live.astype(np.float32))
        total = 0
        for block in blocks:
            ground, view = block.ground, frame.from_block(block.corner_city)
            runs = view.runs(ground, self.meta.resolution_m)
            slots = self._scratch(len(ground))
            seen = see_block(
                ground.x,
                ground.y,
                ground.z,
                block.bins,
                ground.starts,
                runs,
                view.numbers,
                camera.is_distorted,
                size_px,
                labels,
                self._slot_of,
                hides,
                CELL_PX,
                slots,
            )
            if seen:
                total += seen
                counts.vote(
                    block.tile,
                    (runs, ground.starts, ground.cells),
                    slots,
                    frame_key,
                    block.height_mm,
                    block.intensity,
                    sums=block.sums,
                )
        return total

    def _hides_from_m(
        self, blocks: list[PointBlock], frame: FrameView, camera: PinholeCamera
    ) -> NDArrayFloat32:
        """Depth from which on what stands in the map hides, by cell of `CELL_PX`."""
        depth = np.full(depth_shape(camera), np.inf, dtype=np.float32)
        frame = frame.from_anywhere()
        for block in blocks:
            standing, view = block.standing, frame.from_block(block.corner_city)
            if len(standing) == 0:
                continue
            lay_block(
                standing.x,
                standing.y,
                standing.z,
                standing.starts,
                view.runs(standing, self.meta.resolution_m),
                view.numbers,
                camera.is_distorted,
                (camera.width_px, camera.height_px),
                CELL_PX,
                NEAREST_M,
                depth,
            )
        return widened(depth, camera, MAP_GAP_DEG, MAP_GAP_DEG) + np.float32(MARGIN_M)

    def _with_none(self, label_image: NDArrayByte) -> NDArrayByte:
        """The labels (height * width + 1,) row by row, and that of no pixel."""
        if len(self._labels) != label_image.size + 1:
            self._labels = np.full(label_image.size + 1, IGNORE_ID, dtype=np.uint8)
        self._labels[:-1].reshape(label_image.shape)[:] = label_image
        return self._labels

    def _scratch(self, size: int) -> NDArrayAny:
        if len(self._slots) < size:
            self._slots = np.empty(size, dtype=np.uint16)
        return self._slots[:size]


def slots_of(label_set: LabelSet, num_bins: int = 2) -> NDArrayAny:
    """(256,) uint16 one plus the first channel of each label id; 0 where it says nothing of the ground."""
    ids = np.arange(256, dtype=np.uint8)
    speaks = speaks_of_ground(ids, label_set) & (ids < len(label_set))
    return np.where(speaks, 1 + ids.astype(np.int64) * num_bins, 0).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class FrameView:
    """A camera's view at a pose.

    Attributes:
        rows: (5, 4) from the city into the ego frame (rows 0 and 1) and the camera's (2 to 4).
        lens: (16,) fx, fy, cx, cy, k1, k2, p1, p2, k3, the clip (ahead, across, square of the
            least range), the camera's place in the ego frame (x, y), the least depth, and the
            square of the lens' radius.
        planes: (P, 4) half spaces of the city that hold clip and view.
    """

    rows: NDArrayFloat
    lens: NDArrayFloat
    planes: NDArrayFloat

    @classmethod
    def of(cls, camera: PinholeCamera, city_SE3_ego: SE3, config: AssociationConfig) -> FrameView:
        """From an ego pose."""
        ego, cam = city_SE3_ego.inverse(), (city_SE3_ego @ camera.ego_SE3_cam).inverse()
        rows = np.column_stack(
            [
                np.concatenate([ego.rotation[:2], cam.rotation]),
                np.concatenate([ego.translation[:2], cam.translation]),
            ]
        )
        lens, (width, height), radius = camera.lens
        place = camera.ego_SE3_cam.translation
        clip = (config.clip_ahead_m, config.clip_across_m, config.min_range_m**2)
        ahead, left, right, down, depth = rows
        one = np.array([0.0, 0.0, 0.0, 1.0])
        planes = [
            ahead,
            config.clip_ahead_m * one - ahead,
            config.clip_across_m * one - left,
            config.clip_across_m * one + left,
            depth - MIN_DEPTH_M * one,
        ]
        if not camera.is_distorted:
            fx, fy, cx, cy = lens[:4]
            margin = 0.5 + _CULLING_MARGIN_PX
            planes += [
                fx * right + (cx + margin) * depth,
                fy * down + (cy + margin) * depth,
                (width - 1 + margin - cx) * depth - fx * right,
                (height - 1 + margin - cy) * depth - fy * down,
            ]
        numbers = np.array([*lens, *clip, place[0], place[1], MIN_DEPTH_M, radius**2])
        return cls(rows, numbers, np.array(planes))

    def from_anywhere(self) -> FrameView:
        """The same without a least range."""
        lens = self.lens.copy()
        lens[11] = 0.0
        return FrameView(self.rows, lens, self.planes)

    def from_block(self, corner_city: NDArrayFloat) -> BlockView:
        """The same for positions that count from a place."""
        rows, planes = self.rows.copy(), self.planes.copy()
        rows[:, 3] += rows[:, :3] @ corner_city
        rows[:, :3] /= 1000.0  # points of blocks are in millimetres
        planes[:, 3] += planes[:, :3] @ corner_city
        with np.errstate(over="ignore"):  # the radius of a pinhole is infinite
            numbers = np.concatenate([rows.ravel(), self.lens]).astype(np.float32)
        return BlockView(numbers, planes)


@dataclass(frozen=True, eq=False)
class BlockView:
    """A camera's view of a block.

    Attributes:
        numbers: (36,) float32, rows (from millimetres to metres) and lens of `FrameView`.
        planes: (P, 4) half spaces in the block's frame, metres.
    """

    numbers: NDArrayFloat32
    planes: NDArrayFloat

    def runs(self, points: SortedPoints, resolution_m: float) -> NDArrayInt:
        """(R, 2) ranges of cells that may be seen."""
        found: NDArrayInt = rows_in_view(
            self.planes, points.z_range_m, resolution_m, points.row_starts, points.columns
        )
        return found
