"""Label images that exist already, as PNGs in a folder."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from hdmap_tools.errors import ConfigError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.label_png import read_label_png
from hdmap_tools.segmentation.network import camera_of
from hdmap_tools.types import NDArrayByte


def label_path(folder: Path, image: ImageRef) -> Path:
    """Where an image's labels lie: ``<folder>/<camera>/<timestamp_ns>.png``."""
    return folder / image.camera / f"{image.timestamp_ns}.png"


class PrecomputedSegmenter:
    """Reads label PNGs, each checked against its image's size and the label set; a `Segmenter`.

    Args:
        folder: Holds ``<camera>/<timestamp_ns>.png``, 8-bit single channel.
        label_set: What the ids in them mean.
        cameras: Cameras by name, for the size of their images.

    Raises:
        ConfigError: If the folder does not exist.
    """

    def __init__(
        self, folder: Path, label_set: LabelSet, cameras: Mapping[str, PinholeCamera]
    ) -> None:
        if not folder.is_dir():
            raise ConfigError(
                f"There is no folder of label images {folder}; it must hold "
                "<camera>/<timestamp_ns>.png."
            )
        self.folder = folder
        self._label_set = label_set
        self._cameras = cameras

    @property
    def name(self) -> str:
        """``precomputed``: what made the labels is not known."""
        return "precomputed"

    @property
    def label_set(self) -> LabelSet:
        """What the ids mean."""
        return self._label_set

    @property
    def fingerprint(self) -> str:
        """Hash of the label set and of the names, sizes and times of the PNGs."""
        digest = hashlib.sha256(self._label_set.model_dump_json(exclude={"source"}).encode())
        for path in sorted(self.folder.glob("*/*.png")):
            stat = path.stat()
            name = path.relative_to(self.folder).as_posix()
            digest.update(f"{name} {stat.st_size} {stat.st_mtime_ns}\n".encode())
        return digest.hexdigest()

    def segment(self, image: ImageRef) -> NDArrayByte:
        """The label image (height, width) uint8 of one camera image.

        Raises:
            ImageError: If the PNG is missing, damaged, in colour, or not of the
                image's size.
            LabelError: If it holds an id outside the label set.
            CalibrationError: If the image's camera is not among the cameras.
        """
        camera = camera_of(image, self._cameras)
        path = label_path(self.folder, image)
        labels = read_label_png(path, size_px=(camera.width_px, camera.height_px))
        self._label_set.check(labels, f"Label image {path}")
        return labels
