"""What a camera sees of the map at a pose, and of each block of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hdmap_tools.config import AssociationConfig
from hdmap_tools.fusion.point_blocks import SortedPoints
from hdmap_tools.fusion.view_kernels import view_at, view_of_block
from hdmap_tools.geometry.camera import MIN_DEPTH_M, PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.types import NDArrayFloat, NDArrayFloat32, NDArrayInt


@dataclass(frozen=True, eq=False)
class FrameView:
    """A camera's view at a pose.

    Attributes:
        rows: (5, 4) from the city into the ego frame (rows 0 and 1) and the camera's (2 to 4).
        planes: (P, 4) half spaces of the city that hold clip and view.
        inner_planes: (Q, 4) half spaces of the city that clip and view hold; none of a lens that
            is more than a pinhole.
        lens: (16,) fx, fy, cx, cy, k1, k2, p1, p2, k3, the clip (ahead, across, square of the
            least range), the camera's place in the ego frame (x, y), the least depth, and the
            square of the lens' radius, which of a pinhole is infinite.
    """

    rows: NDArrayFloat
    planes: NDArrayFloat
    inner_planes: NDArrayFloat
    lens: NDArrayFloat

    @classmethod
    def of(cls, camera: PinholeCamera, city_SE3_ego: SE3, config: AssociationConfig) -> FrameView:
        """From an ego pose."""
        mount, clip = camera.ego_SE3_cam, (config.clip_ahead_m, config.clip_across_m)
        intrinsics, size_px, radius = camera.lens
        rows, planes, inner_planes = view_at(
            (city_SE3_ego.rotation, city_SE3_ego.translation),
            (mount.rotation, mount.translation),
            intrinsics[:4],
            size_px,
            (*clip, config.min_range_m),
            MIN_DEPTH_M,
            camera.is_distorted,
        )
        place, range2 = mount.translation, config.min_range_m**2
        radius2 = min(radius, 1e18) ** 2  # a larger one overflows float32
        lens = np.array([*intrinsics, *clip, range2, place[0], place[1], MIN_DEPTH_M, radius2])
        return cls(rows, planes, inner_planes, lens)

    def from_anywhere(self) -> FrameView:
        """The same without a least range; all points are tested."""
        lens = self.lens.copy()
        lens[11] = 0.0
        return replace(self, lens=lens, inner_planes=np.zeros((0, 4)))

    def of_block(
        self, points: SortedPoints, corner_city: NDArrayFloat, resolution_m: float
    ) -> tuple[NDArrayFloat32, NDArrayInt]:
        """What kernels need for points that count from a corner.

        Args:
            points: Of a block.
            corner_city: (3,) its corner, metres.
            resolution_m: Edge of its cells.

        Returns:
            (36,) rows, from millimetres to metres, and lens; and (R, 3) ranges of cells that may be
            seen, the third 1 where all points of a range are.
        """
        numbers, runs = view_of_block(
            self.rows,
            self.planes,
            self.inner_planes,
            self.lens,
            corner_city,
            points.z_range_m,
            resolution_m,
            points.row_starts,
            points.columns,
        )
        return numbers, runs
