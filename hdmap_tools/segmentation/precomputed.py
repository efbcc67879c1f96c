"""Label images that exist already, as PNGs in a folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.label_png import read_label_png
from hdmap_tools.segmentation.network import camera_of
from hdmap_tools.types import NDArrayByte

LABEL_SET_NAME: Final = "label_set.json"
"""In a folder of label images: what their ids mean."""
MODEL_NAME: Final = "model.json"
"""In a folder of label images: ``{"model": NAME}``, what made them."""
CONFUSION_NAME: Final = "confusion.json"
"""In a folder of label images: the confusion matrix that came with what made them."""


def label_path(folder: Path, image: ImageRef) -> Path:
    """Where an image's labels lie: ``<folder>/<camera>/<timestamp_ns>.png``."""
    return folder / image.camera / f"{image.timestamp_ns}.png"


def require_label_folder(folder: Path) -> None:
    """Raise `ConfigError` unless there is such a folder."""
    if not folder.is_dir():
        raise ConfigError(
            f"There is no folder of label images {folder}; it must hold "
            "<camera>/<timestamp_ns>.png."
        )


class PrecomputedSegmenter:
    """Reads label PNGs, each checked against its image's size and the label set; a `Segmenter`.

    Args:
        folder: Holds ``<camera>/<timestamp_ns>.png``, 8-bit single channel, and may
            hold `MODEL_NAME` and `CONFUSION_NAME`.
        label_set: What the ids in them mean.
        cameras: Cameras by name, for the size of their images.

    Raises:
        ConfigError: If the folder does not exist, or says what made it in a way that
            cannot be read.
        LabelError: If the confusion matrix in it is of other labels.
    """

    def __init__(
        self, folder: Path, label_set: LabelSet, cameras: Mapping[str, PinholeCamera]
    ) -> None:
        require_label_folder(folder)
        self.folder = folder
        self._label_set = label_set
        self._cameras = cameras
        self._name = _model_of(folder)
        self.confusion = _confusion_of(folder, label_set)

    @property
    def name(self) -> str:
        """The model that made the labels, where the folder says it, else ``precomputed``."""
        return self._name

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


def _model_of(folder: Path) -> str:
    path = folder / MODEL_NAME
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return "precomputed"
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read: {error}. Remove it, or mend it.") from error
    name = document.get("model") if isinstance(document, dict) else None
    if not isinstance(name, str) or not name:
        raise ConfigError(
            f'{path} does not say what made the labels; expected {{"model": "NAME"}}.'
        )
    return name


def _confusion_of(folder: Path, label_set: LabelSet) -> ConfusionMatrix | None:
    path = folder / CONFUSION_NAME
    if not path.is_file():
        return None
    matrix = ConfusionMatrix.load(path)
    if matrix.predicted_set.names != label_set.names:
        raise LabelError(
            f"{path} is of the labels of {matrix.predicted_set.name!r}, but the label images beside it "
            f"are of {label_set.name!r}; remove it, or name the label set that it is of."
        )
    return matrix
