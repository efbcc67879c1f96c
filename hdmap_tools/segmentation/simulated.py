"""A network that does not exist: true label images of a simulated drive with errors like a network's."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.label_noise import (
    NoiseFields,
    Sample,
    ViewedGround,
    fitted_scale,
    nearby,
)
from hdmap_tools.segmentation.network import camera_of
from hdmap_tools.segmentation.precomputed import LABEL_SET_NAME, PrecomputedSegmenter
from hdmap_tools.types import NDArrayByte, NDArrayFloat

SIMULATED: Final = "simulated"
"""Name of this network and of the matrix assumed for it."""

TRUE_LABELS: Final = Path("truth") / "label_images"
"""Where a simulated drive has its true label images."""

_VERSION: Final = 1
"""Raised when the same seed gives other labels, so that cached ones are made anew."""
_FIT_IMAGES: Final = 32
_FIT_STRIDE: Final = 4


class SimulatedSegmenter:
    """Reads true label images and puts errors on them; a `Segmenter`.

    Its mean confusion over the drive is the matrix given; see `label_noise` for what the
    errors are like. Labels follow from the seed and the image's camera and time.

    Args:
        truth_folder: Holds ``<camera>/<timestamp_ns>.png`` and ``label_set.json``.
        confusion: How often which label is taken for which, rows true; None is the
            assumed one, ``simulated``. Of a label without counts all pixels stay right.
        seed: Of the errors.
        cameras: Cameras by name.
        trajectory: Poses, for errors that lie on the ground.

    Raises:
        ConfigError: If there are no true label images, or it is not said what they mean.
        LabelError: If the matrix is of another label set than they are.
    """

    def __init__(
        self,
        truth_folder: Path,
        confusion: ConfusionMatrix | None,
        seed: int,
        cameras: Mapping[str, PinholeCamera],
        trajectory: Trajectory,
    ) -> None:
        self._label_set = _label_set_in(truth_folder)
        self._truth = PrecomputedSegmenter(truth_folder, self._label_set, cameras)
        self.confusion = ConfusionMatrix.load(SIMULATED) if confusion is None else confusion
        for side, labels in (
            ("true", self.confusion.true_set),
            ("predicted", self.confusion.predicted_set),
        ):
            if labels.names != self._label_set.names:
                raise LabelError(
                    f"The confusion matrix has the {side} labels of {labels.name!r} "
                    f"({len(labels)} labels), but the true label images in {truth_folder} have "
                    f"those of {self._label_set.name!r} ({len(self._label_set)} labels); give a "
                    "matrix measured on this label set."
                )
        self._cameras, self._trajectory, self._seed = cameras, trajectory, seed
        self._lock = threading.Lock()
        self._scale: NDArrayFloat | None = None
        self._ground: dict[str, ViewedGround] = {}
        self._fields: dict[tuple[int, int], NoiseFields] = {}
        self._fingerprint: str | None = None

    @property
    def name(self) -> str:
        """``simulated``: the assumed matrix is known by this name."""
        return SIMULATED

    @property
    def label_set(self) -> LabelSet:
        """That of the true label images."""
        return self._label_set

    @property
    def fingerprint(self) -> str:
        """Hash of truth, matrix, seed and poses."""
        if self._fingerprint is None:
            digest = hashlib.sha256(f"{SIMULATED} {_VERSION} {self._seed}\n".encode())
            digest.update(self._truth.fingerprint.encode())
            digest.update(self.confusion.counts.tobytes())
            digest.update(self._trajectory.timestamps_ns.tobytes())
            digest.update(self._trajectory.translations.tobytes())
            digest.update(self._trajectory.rotations.tobytes())
            self._fingerprint = digest.hexdigest()
        return self._fingerprint

    def segment(self, image: ImageRef) -> NDArrayByte:
        """The label image (height, width) uint8 of one camera image.

        Raises:
            ImageError: If the true label image is missing or damaged.
            CalibrationError: If the image's camera is not among the cameras.
        """
        from hdmap_tools.segmentation.label_noise_kernels import confused

        labels = self._truth.segment(image)
        camera = camera_of(image, self._cameras)
        with self._lock:
            scale = self._fitted()
            ground = self._ground_of(camera)
            fields = self._fields_for(camera)
        rotations, translations = self._trajectory.interpolate_many(np.array([image.timestamp_ns]))
        pose = SE3(rotations[0], translations[0])
        whether, which = fields.draw(image.key, ground, pose)
        beside, around = nearby(labels, len(self._label_set))
        count = len(self._label_set)
        drawn: NDArrayByte = confused(
            labels.ravel(),
            ground.reach.ravel(),
            beside.reshape(-1, count),
            around.reshape(-1, count),
            scale,
            whether.ravel(),
            which.ravel(),
        )
        return drawn.reshape(labels.shape)

    def _ground_of(self, camera: PinholeCamera) -> ViewedGround:
        if camera.name not in self._ground:
            self._ground[camera.name] = ViewedGround.of_camera(camera)
        return self._ground[camera.name]

    def _fields_for(self, camera: PinholeCamera) -> NoiseFields:
        size_px = (camera.width_px, camera.height_px)
        if size_px not in self._fields:
            self._fields[size_px] = NoiseFields(self._seed, *size_px)
        return self._fields[size_px]

    def _fitted(self) -> NDArrayFloat:
        """The scale of the noise, fitted on images spread over the whole drive."""
        if self._scale is None:
            found = sorted(
                (path.stem, path.parent.name)
                for path in self._truth.folder.glob("*/*.png")
                if path.parent.name in self._cameras
            )
            chosen = found[:: max(1, len(found) // _FIT_IMAGES)]
            samples = []
            for stem, name in chosen:
                image = ImageRef(name, int(stem), self._truth.folder / name / f"{stem}.png")
                ground = self._ground_of(self._cameras[name])
                labels = self._truth.segment(image)
                samples.append(Sample.of_image(labels, ground, len(self._label_set), _FIT_STRIDE))
            counts = self.confusion.counts.astype(np.float64)
            pixels = counts.sum(axis=1, keepdims=True)
            shares = np.where(pixels > 0, counts / np.maximum(pixels, 1), np.eye(len(counts)))
            self._scale = fitted_scale(Sample.joined(samples), shares)
        return self._scale


def _label_set_in(folder: Path) -> LabelSet:
    path = folder / LABEL_SET_NAME
    if not path.is_file():
        raise ConfigError(
            f"The simulated network needs true label images, and there is no {path}; give it a drive "
            "made by `hdmap simulate`."
        )
    return load_label_set(path)
