"""What all networks share: images into the numbers they want, their answers into label images.

Scores are brought to the image's own size before the best is taken. On five
annotated street images that gave lane marks an IoU of 0.587 against 0.580 for
taking the best first and enlarging ids (road 0.8687 and 0.8682). Images are
shrunk bilinearly, as the networks' own preprocessing does; averaging over
the area instead gave marks 0.595 but road 0.864.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import CalibrationError, ConfigError, LabelError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.segmentation.segmenter import ModelProfile
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat32

PROCESSING_VERSION: Final = 1
"""Raised when pre- or post-processing changes results, so that cached ones are left behind."""


@dataclass(frozen=True, eq=False)
class Network:
    """A loaded network, whichever runtime runs it.

    Attributes:
        path: Model file, for messages.
        runtime: Name and version of what runs it; results may differ in the last bits.
        weights_sha256: Hash of everything that the model file and its weights say.
        input_shape: (N, C, H, W); None where the network takes any length.
        run: From (1, 3, H, W) float32 to the output named by the profile; may be
            called from several threads at once.
    """

    path: Path
    runtime: str
    weights_sha256: str
    input_shape: tuple[int | None, ...]
    run: Callable[[NDArrayFloat32], NDArrayAny] = field(repr=False)


class NetworkSegmenter:
    """Label images from a network and its profile; a `Segmenter`.

    Args:
        network: From `load_onnx` or `load_openvino`.
        profile: How to feed it and read its answer.
        cameras: Cameras by name, for the size that their images must have.

    Raises:
        ConfigError: If the network's input does not fit the profile.
        LabelError: If the profile names no label set.
    """

    def __init__(
        self, network: Network, profile: ModelProfile, cameras: Mapping[str, PinholeCamera]
    ) -> None:
        _check_input(network, profile)
        self.network = network
        self.profile = profile
        self._cameras = cameras
        self._label_set = load_label_set(profile.label_set)

    @property
    def name(self) -> str:
        """The profile's name."""
        return self.profile.name

    @property
    def label_set(self) -> LabelSet:
        """What the network's outputs mean."""
        return self._label_set

    @property
    def fingerprint(self) -> str:
        """Hash of weights, runtime, pre- and post-processing, and label names."""
        said = {
            "processing": PROCESSING_VERSION,
            "runtime": self.network.runtime,
            "weights": self.network.weights_sha256,
            "profile": self.profile.model_dump(
                mode="json", exclude={"name", "sha256", "source", "label_set"}
            ),
            "labels": [self._label_set.name, *self._label_set.names],
        }
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()

    def segment(self, image: ImageRef) -> NDArrayByte:
        """The label image (height, width) uint8 of one camera image.

        Raises:
            ImageError: If the image does not decode or has not the camera's size.
            CalibrationError: If its camera is not among the cameras.
            LabelError: If the network's answer does not fit the label set.
        """
        return self.segment_rgb(read_image(image, camera_of(image, self._cameras)), str(image.path))

    def segment_rgb(self, rgb: NDArrayByte, what: str = "the image") -> NDArrayByte:
        """The label image (height, width) uint8 of an RGB image (height, width, 3) uint8.

        Args:
            rgb: The image.
            what: Names it in messages.
        """
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or rgb.size == 0:
            raise ShapeError(
                f"An image must be (height, width, 3) uint8, found {rgb.shape} {rgb.dtype}."
            )
        answer = self.network.run(batch_from_image(rgb, self.profile))
        about = f"Network {self.name} ({self.network.path}), run on {what},"
        size_px = (rgb.shape[1], rgb.shape[0])
        if self.profile.output == "scores":
            return labels_from_scores(answer, self._label_set, size_px, about)
        return labels_from_ids(answer, self._label_set, size_px, about)


def camera_of(image: ImageRef, cameras: Mapping[str, PinholeCamera]) -> PinholeCamera:
    """The camera that took an image.

    Raises:
        CalibrationError: If it is not among the cameras; the message lists them.
    """
    try:
        return cameras[image.camera]
    except KeyError as error:
        raise CalibrationError(
            f"Image {image.path} is of camera {image.camera!r}, which has no calibration; "
            f"calibrated are {', '.join(sorted(cameras)) or 'none'}."
        ) from error


def batch_from_image(rgb: NDArrayByte, profile: ModelProfile) -> NDArrayFloat32:
    """The network's input (1, 3, H, W) float32 of an image (height, width, 3) uint8 RGB."""
    import cv2

    if profile.input_size_px is not None and profile.input_size_px != (rgb.shape[1], rgb.shape[0]):
        # OpenCV's linear filter takes pixel centres at halves, so nothing shifts.
        rgb = cv2.resize(rgb, profile.input_size_px, interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
    planes = cv2.split(rgb)
    if profile.channels == "bgr":
        planes = planes[::-1]
    batch = np.empty((1, 3, *rgb.shape[:2]), dtype=np.float32)
    for channel, plane in enumerate(planes):
        target = batch[0, channel]
        np.multiply(plane, np.float32(profile.scale), out=target)
        target -= np.float32(profile.mean[channel])
        target /= np.float32(profile.std[channel])
    return batch


def labels_from_scores(
    scores: NDArrayAny, label_set: LabelSet, size_px: tuple[int, int], about: str
) -> NDArrayByte:
    """The best-scored label of each pixel; the lower id where two are equal.

    Args:
        scores: (1, C, h, w), a channel a label.
        label_set: The labels.
        size_px: (width, height) of the result.
        about: Subject of messages.

    Raises:
        LabelError: If the shape or the number of channels does not fit, or a
            score is not finite.
    """
    import cv2

    if scores.ndim != 4 or scores.shape[0] != 1:
        raise LabelError(f"{about} gave shape {scores.shape}; scores must be (1, C, H, W).")
    if scores.shape[1] != len(label_set):
        raise LabelError(
            f"{about} gave {scores.shape[1]} channels, but label set {label_set.name!r} has "
            f"{len(label_set)} labels ({', '.join(label_set.names)}); name the label set that the "
            "network was trained with in its profile."
        )
    scores = np.ascontiguousarray(scores[0], dtype=np.float32)
    if not np.isfinite(scores).all():
        raise LabelError(
            f"{about} gave {int((~np.isfinite(scores)).sum())} scores that are NaN or infinite; the "
            "model file is damaged, or its profile feeds it numbers of the wrong range."
        )
    width, height = size_px
    ids: NDArrayByte = np.zeros((height, width), dtype=np.uint8)
    best = _resized(scores[0], size_px, cv2.INTER_LINEAR)
    # One plane at a time keeps the enlarged scores small: a third of the time of
    # stacking them for argmax.
    for label_id in range(1, len(scores)):
        score = _resized(scores[label_id], size_px, cv2.INTER_LINEAR)
        np.copyto(ids, np.uint8(label_id), where=score > best)
        best = np.maximum(best, score)
    return ids


def labels_from_ids(
    answer: NDArrayAny, label_set: LabelSet, size_px: tuple[int, int], about: str
) -> NDArrayByte:
    """The label image of a network that gives ids (1, h, w) or (1, 1, h, w) itself.

    Raises:
        LabelError: If the shape does not fit, or a value is no whole number or
            outside the label set.
    """
    import cv2

    if answer.ndim == 4 and answer.shape[1] == 1:
        answer = answer[:, 0]
    if answer.ndim != 3 or answer.shape[0] != 1:
        raise LabelError(
            f"{about} gave shape {answer.shape}; ids must be (1, H, W) or (1, 1, H, W). "
            "If these are scores, say `output: scores` in the profile."
        )
    values = answer[0]
    # Before the cast, which would fold 256 into 0 and NaN into anything.
    with np.errstate(invalid="ignore"):
        fits = (values >= 0) & (values <= 255) & (values == np.floor(values))
    if not fits.all():
        raise LabelError(
            f"{about} gave {values[~fits].flat[0]!r} as a label id; expected whole numbers "
            f"0..{len(label_set) - 1} of label set {label_set.name!r}."
        )
    ids = np.ascontiguousarray(values, dtype=np.uint8)
    label_set.check(ids, f"{about} gave an image that")
    # INTER_NEAREST would be half a pixel off; the exact one takes centres at halves.
    return np.asarray(_resized(ids, size_px, cv2.INTER_NEAREST_EXACT), dtype=np.uint8)


def _resized(plane: NDArrayAny, size_px: tuple[int, int], interpolation: int) -> NDArrayAny:
    import cv2

    if plane.shape == (size_px[1], size_px[0]):
        return plane
    return cv2.resize(plane, size_px, interpolation=interpolation)


def _check_input(network: Network, profile: ModelProfile) -> None:
    shape = network.input_shape
    if len(shape) != 4 or shape[0] not in (1, None) or shape[1] not in (3, None):
        hint = (
            " It looks like (N, H, W, C): export the model with channels first."
            if len(shape) == 4 and shape[3] == 3
            else ""
        )
        raise ConfigError(
            f"Model {network.path} takes input {_shape_text(shape)}; expected (1, 3, H, W), one image "
            f"with channels first.{hint}"
        )
    if profile.input_size_px is None:
        if shape[2] is not None or shape[3] is not None:
            raise ConfigError(
                f"Model {network.path} takes input {_shape_text(shape)} only, but profile "
                f"{profile.name!r} feeds images at their own size; set its input_size_px to "
                "the [width, height] of the network."
            )
        return
    width, height = profile.input_size_px
    if shape[2] not in (height, None) or shape[3] not in (width, None):
        raise ConfigError(
            f"Model {network.path} takes input {_shape_text(shape)}, but profile {profile.name!r} "
            f"feeds (1, 3, {height}, {width}) from its input_size_px [{width}, {height}]; "
            "correct the profile, or choose the model it was made for."
        )


def _shape_text(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"
