"""Mapping while driving: sweeps and labelled images in, the map around the vehicle out.

    mapper = LiveMapper(cameras, label_set, confusion=confusion)   # how the network errs
    mapper.add_sweep(sweep, city_SE3_ego)                        # at the lidar's rate
    mapper.add_image("front", labels, city_SE3_ego, frame_key)   # at the camera's rate
    window = mapper.window()                                     # whenever it is asked for

Sweeps and images come in the order of their time. Nothing is read or written on the way and
memory does not grow. `examples/live_local_map.py` replays a drive and measures each call.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.planar import associate_planar, ground_plane
from hdmap_tools.association.surface import associate_surface
from hdmap_tools.config import Config
from hdmap_tools.errors import CalibrationError
from hdmap_tools.fusion.local_map import EXTENT_M, LocalMap, RollRule
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.map_reading import model_for
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.types import NDArrayByte


class LiveMapper:
    """A local map that is fed frame by frame.

    Without a sweep so far images are laid on the plane under the wheels; with one, each cell
    is looked up at the height of the ground that the last sweep found.

    Attributes:
        local_map: The counts, in the vehicle's frame.

    Args:
        cameras: Calibrated cameras by name.
        label_set: What the ids of label images mean.
        model: Name of the network, which finds its confusion matrix, where that is known.
        confusion: How the network errs, where it says so itself (`confusion_of`).
        config: `association`, `fusion.resolution_m` and `.count_mode`, `observation`, `classes`.
        intensity_threshold: Lidar intensity from which on a return may be paint, 1..255.
        extent_m: (x0, y0, x1, y1) of the local map around the rear axle, x ahead, y left.
        rule: When a new local frame is made.

    Raises:
        ConfigError, LabelError: If the observation model cannot be made of that.
    """

    def __init__(
        self,
        cameras: Mapping[str, PinholeCamera],
        label_set: LabelSet,
        *,
        model: str = "",
        confusion: ConfusionMatrix | None = None,
        config: Config | None = None,
        intensity_threshold: int = 128,
        extent_m: tuple[float, float, float, float] = EXTENT_M,
        rule: RollRule | None = None,
    ) -> None:
        config = config or Config()
        self._cameras, self._association = dict(cameras), config.association
        meta = MapMeta(
            resolution_m=config.fusion.resolution_m,
            label_set=label_set,
            count_mode=config.fusion.count_mode,
            intensity_threshold=intensity_threshold,
            model=model,
            confusion=None if confusion is None else json.loads(confusion.to_json()),
        )
        self.local_map = LocalMap(meta, extent_m, rule)
        self._model = model_for(self.local_map.meta, config)
        self._fill_radius = config.observation.fill_radius_cells
        self._grounded: GroundedSweep | None = None

    def add_sweep(self, sweep: Sweep, city_SE3_ego: SE3) -> None:
        """Find the ground under the vehicle; the next images are laid on it.

        Args:
            sweep: Motion-compensated to its own time.
            city_SE3_ego: Pose at that time.
        """
        association = self._association
        self._grounded = GroundedSweep.from_sweep(
            sweep, city_SE3_ego, association.max_range_m, association.ground_tolerance_m
        )

    def add_image(self, camera: str, labels: NDArrayByte, city_SE3_ego: SE3, frame_key: int) -> int:
        """Add what an image says of the ground; gives how many cells it labelled.

        Args:
            camera: Name of the camera.
            labels: (height, width) uint8 ids.
            city_SE3_ego: Pose at the image's own time.
            frame_key: Any number that names the image, for example its time; breaks ties.

        Raises:
            CalibrationError: If there is no such camera, or the image is of another size.
        """
        one = self._cameras.get(camera)
        if one is None:
            raise CalibrationError(
                f"There is no camera {camera!r}; there are {', '.join(sorted(self._cameras))}."
            )
        if labels.shape != (one.height_px, one.width_px):
            raise CalibrationError(
                f"Camera {camera} has images of {one.width_px}x{one.height_px}, found labels "
                f"{labels.shape}; they must be (height, width)."
            )
        meta, association = self.local_map.meta, self._association
        if self._grounded is None:
            seen = associate_planar(
                labels,
                meta.label_set,
                one,
                city_SE3_ego,
                ground_plane(None),
                city_SE3_ego,
                meta.resolution_m,
                association,
            )
        else:
            seen = associate_surface(
                labels,
                meta.label_set,
                one,
                city_SE3_ego,
                self._grounded,
                meta.resolution_m,
                association,
            )
        self.local_map.update(seen, city_SE3_ego, frame_key)
        return len(seen)

    @property
    def city_SE3_local(self) -> SE3:
        """Where the local frame is; the origin of the city frame before the first image."""
        return self.local_map.city_SE3_local or SE3.identity()

    def window(self) -> MapWindow:
        """Probabilities and their companions around the vehicle, in the local frame."""
        return self.local_map.window(self._model, self._fill_radius)
