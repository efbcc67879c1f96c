"""The dense engine: labels of an image straight into counts, without observations in between.

The same method as `association.dense.associate_dense` and `CellCounts.add`, point by point in
float32 instead of float64. Points lie sorted by cell; cells outside of clip and view are
passed over by the row; what is left is projected in one vector loop, looked up, and voted.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.association.dense import MAP_GAP_DEG, clip_bounds_m, sweep_hides_from_m
from hdmap_tools.association.lookup import speaks_of_ground
from hdmap_tools.association.visibility import MARGIN_M, NEAREST_M, depth_shape, widened
from hdmap_tools.config import AssociationConfig
from hdmap_tools.errors import ConfigError
from hdmap_tools.fusion.block_kernels import fuse_block, lay_block
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.frame_view import FrameView
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.point_blocks import POINTS_BYTES, PointBlock, PointBlocks
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet
from hdmap_tools.point_map.point_map import PointMap
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat, NDArrayFloat32

_ALL_MEASURED: Final = np.zeros(0, dtype=bool)


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
            ground = block.ground
            view, runs = frame.of_block(ground, block.corner_city, self.meta.resolution_m)
            if len(runs):
                is_new = block.tile not in counts.tiles
                seen = fuse_block(
                    (ground.x, ground.y, ground.z, block.bins),
                    ground.starts,
                    ground.cells,
                    runs,
                    view,
                    camera.is_distorted,
                    size_px,
                    labels,
                    self._slot_of,
                    hides.ravel(),
                    *counts.ballot(block.tile, frame_key),
                    (block.height_mm, block.intensity, _ALL_MEASURED),
                    block.sums,
                )
                total += seen
                if is_new and not seen:
                    del counts.tiles[block.tile]
        return total

    def _hides_from_m(
        self, blocks: list[PointBlock], frame: FrameView, camera: PinholeCamera
    ) -> NDArrayFloat32:
        """Depth from which on what stands in the map hides, by cell of `CELL_PX`."""
        depth = np.full(depth_shape(camera), np.inf, dtype=np.float32)
        frame = frame.from_anywhere()
        for block in blocks:
            standing = block.standing
            view, runs = frame.of_block(standing, block.corner_city, self.meta.resolution_m)
            if len(runs) == 0:
                continue
            lay_block(
                standing.x,
                standing.y,
                standing.z,
                standing.starts,
                runs,
                view,
                camera.is_distorted,
                (camera.width_px, camera.height_px),
                NEAREST_M,
                depth.ravel(),
            )
        return widened(depth, camera, MAP_GAP_DEG, MAP_GAP_DEG) + np.float32(MARGIN_M)

    def _with_none(self, label_image: NDArrayByte) -> NDArrayByte:
        """The labels (height * width + 1,) row by row, and that of no pixel."""
        if len(self._labels) != label_image.size + 1:
            self._labels = np.full(label_image.size + 1, IGNORE_ID, dtype=np.uint8)
        self._labels[:-1].reshape(label_image.shape)[:] = label_image
        return self._labels


def slots_of(label_set: LabelSet) -> NDArrayAny:
    """(512,) uint16 by ``2 * label + bin``: one plus the channel; 0 where the label says nothing of the ground."""
    ids = np.arange(256, dtype=np.uint8)
    speaks = speaks_of_ground(ids, label_set) & (ids < len(label_set))
    return np.where(speaks.repeat(2), 1 + np.arange(512), 0).astype(np.uint16)
