"""What all networks share: images fed one by one, in batches or in tiles, and label images back."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.errors import CalibrationError, LabelError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.segmentation.answers import (
    best_labels,
    enlarged_scores,
    labels_from_ids,
    labels_from_scores,
)
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.inputs import fed_size, input_of, neutral_colour
from hdmap_tools.segmentation.network_checks import check_input, check_output
from hdmap_tools.segmentation.segmenter import ModelProfile
from hdmap_tools.segmentation.tiling import Span, Tiling, blended
from hdmap_tools.segmentation.undistortion import Rectification
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
        run: From (N, 3, H, W) float32 to the output named by the profile; may be
            called from several threads at once.
        output_shape: Of that output, None where it is not known before it is run; empty
            where nothing of it is known.
    """

    path: Path
    runtime: str
    weights_sha256: str
    input_shape: tuple[int | None, ...]
    run: Callable[[NDArrayFloat32], NDArrayAny] = field(repr=False)
    output_shape: tuple[int | None, ...] = ()

    @property
    def takes_batches(self) -> bool:
        """Whether it takes several images at once."""
        return self.input_shape[0] is None


@dataclass(frozen=True)
class Handling:
    """How images are brought to a network, whichever it is.

    Attributes:
        batch: So many images or tiles at once, where the network takes several.
        tiling: Cut images into tiles at their own scale; None feeds them whole.
        undistort: Show the network the rectified image of a camera with distortion.
    """

    batch: int = 1
    tiling: Tiling | None = None
    undistort: bool = True


class NetworkSegmenter:
    """Label images from a network and its profile; a `Segmenter`.

    Args:
        network: From `load_onnx` or `load_openvino`.
        profile: How to feed it and read its answer.
        cameras: Cameras by name, for the size and the lens of their images.
        label_set: What its outputs mean; None is the set that the profile names.
        confusion: The matrix that came with the network.
        handling: How images are brought to it.

    Raises:
        ConfigError: If the network's input does not fit the profile or the tiles.
        LabelError: If the profile names no label set, or one of another size than the
            network's output.
    """

    def __init__(
        self,
        network: Network,
        profile: ModelProfile,
        cameras: Mapping[str, PinholeCamera],
        *,
        label_set: LabelSet | None = None,
        confusion: ConfusionMatrix | None = None,
        handling: Handling | None = None,
    ) -> None:
        self.handling = handling or Handling()
        self.network = network
        self.profile = profile
        self.confusion = confusion
        self._cameras = cameras
        self._label_set = load_label_set(profile.label_set) if label_set is None else label_set
        check_input(network, profile, self.handling.tiling)
        check_output(network, profile, self._label_set)
        self._rectifications: dict[str, Rectification] = {}
        self._lock = threading.Lock()

    @property
    def name(self) -> str:
        """The profile's name."""
        return self.profile.name

    @property
    def label_set(self) -> LabelSet:
        """What the network's outputs mean."""
        return self._label_set

    @property
    def batch(self) -> int:
        """How many images it is best given at once."""
        return self.handling.batch if self.network.takes_batches else 1

    @property
    def fingerprint(self) -> str:
        """Hash of weights, runtime, pre- and post-processing, lenses and label names."""
        said: dict[str, Any] = {
            "processing": PROCESSING_VERSION,
            "runtime": self.network.runtime,
            "weights": self.network.weights_sha256,
            "profile": self.profile.model_dump(
                mode="json", exclude={"name", "sha256", "source", "label_set"}
            ),
            "labels": [self._label_set.name, *self._label_set.names],
        }
        if self.handling.tiling is not None:
            said["tiles"] = asdict(self.handling.tiling)
        lenses = {
            name: camera.lens
            for name, camera in self._cameras.items()
            if self.handling.undistort and camera.is_distorted
        }
        if lenses:
            said["lenses"] = lenses
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()

    def segment(self, image: ImageRef) -> NDArrayByte:
        """The label image (height, width) uint8 of one camera image.

        Of a camera with distortion, `IGNORE_ID` where the rectified image does not reach.

        Raises:
            ImageError: If the image does not decode or has not the camera's size.
            CalibrationError: If its camera is not among the cameras.
            LabelError: If the network's answer does not fit the label set.
        """
        return self.segment_many([image])[0]

    def segment_many(self, images: Sequence[ImageRef]) -> list[NDArrayByte]:
        """`segment` of several images, which the network gets together where it can."""
        cameras = [camera_of(image, self._cameras) for image in images]
        rgbs = [read_image(image, camera) for image, camera in zip(images, cameras, strict=True)]
        ways = [self._rectification(camera) for camera in cameras]
        border = neutral_colour(self.profile)
        seen = [
            rgb if way is None else way.rectify(rgb, border)
            for rgb, way in zip(rgbs, ways, strict=True)
        ]
        found = self._segment(seen, [str(image.path) for image in images])
        return [
            labels if way is None else way.to_recorded(labels)
            for labels, way in zip(found, ways, strict=True)
        ]

    def segment_rgb(self, rgb: NDArrayByte, what: str = "the image") -> NDArrayByte:
        """The label image (height, width) uint8 of an RGB image (height, width, 3) uint8.

        Args:
            rgb: The image, without distortion.
            what: Names it in messages.
        """
        return self._segment([rgb], [what])[0]

    def _rectification(self, camera: PinholeCamera) -> Rectification | None:
        if not (self.handling.undistort and camera.is_distorted):
            return None
        with self._lock:
            if camera.name not in self._rectifications:
                self._rectifications[camera.name] = Rectification(camera)
            return self._rectifications[camera.name]

    def _segment(self, rgbs: Sequence[NDArrayByte], whats: Sequence[str]) -> list[NDArrayByte]:
        for rgb in rgbs:
            if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or rgb.size == 0:
                raise ShapeError(
                    f"An image must be (height, width, 3) uint8, found {rgb.shape} {rgb.dtype}."
                )
        tiling = self.handling.tiling
        if tiling is None:
            return self._whole(rgbs, whats)
        return [self._tiled(rgb, what, tiling) for rgb, what in zip(rgbs, whats, strict=True)]

    def _whole(self, rgbs: Sequence[NDArrayByte], whats: Sequence[str]) -> list[NDArrayByte]:
        size_px = self.profile.input_size_px
        to_labels = labels_from_scores if self.profile.output == "scores" else labels_from_ids
        results = []
        answers = self._answers(rgbs, whats, size_px)
        for rgb, (answer, about) in zip(rgbs, answers, strict=True):
            height, width = rgb.shape[:2]
            fed = (width, height) if size_px else fed_size((width, height), self.profile)
            labels = to_labels(answer, self._label_set, fed, about)
            results.append(np.ascontiguousarray(labels[:height, :width]))
        return results

    def _tiled(self, rgb: NDArrayByte, what: str, tiling: Tiling) -> NDArrayByte:
        columns, rows = tiling.columns(rgb.shape[1]), tiling.rows(rgb.shape[0])
        if self.profile.output == "scores":
            strips = (self._strip(rgb, what, tiling, columns, row) for row in rows)
            return np.concatenate(list(blended(strips, rows, best_labels)))
        labels: NDArrayByte = np.empty(rgb.shape[:2], dtype=np.uint8)
        fed = fed_size(tiling.size_px, self.profile)
        for row in rows:
            cut = [tiling.cut(rgb, column, row) for column in columns]
            answers = self._answers(cut, [what] * len(cut), None)
            for column, (answer, about) in zip(columns, answers, strict=True):
                found = labels_from_ids(answer, self._label_set, fed, about)
                (left, right), (top, bottom) = column.own, row.own
                labels[top:bottom, left:right] = found[
                    top - row.start : bottom - row.start, left - column.start : right - column.start
                ]
        return labels

    def _strip(
        self, rgb: NDArrayByte, what: str, tiling: Tiling, columns: Sequence[Span], row: Span
    ) -> NDArrayFloat32:
        """(C, end - begin, width) scores of a row of tiles, blended from left to right."""
        shape = (len(self._label_set), row.end - row.begin, rgb.shape[1])
        strip = np.zeros(shape, dtype=np.float32)
        fed = fed_size(tiling.size_px, self.profile)
        cut = [tiling.cut(rgb, column, row) for column in columns]
        answers = self._answers(cut, [what] * len(cut), None)
        for column, (answer, about) in zip(columns, answers, strict=True):
            scores = enlarged_scores(answer, self._label_set, fed, about)
            strip[:, :, column.begin : column.end] += (
                column.weights
                * scores[
                    :,
                    row.begin - row.start : row.end - row.start,
                    column.begin - column.start : column.end - column.start,
                ]
            )
        return strip

    def _answers(
        self,
        rgbs: Sequence[NDArrayByte],
        whats: Sequence[str],
        input_size_px: tuple[int, int] | None,
    ) -> Iterator[tuple[NDArrayAny, str]]:
        """The answer (1, ...) to each image, fed at a size or (None) its own, and what to call it.

        As many images of one size as a batch takes are fed together.
        """
        start = 0
        while start < len(rgbs):
            end = start + 1
            while end < min(start + self.batch, len(rgbs)) and (
                input_size_px is not None or rgbs[end].shape == rgbs[start].shape
            ):
                end += 1
            some = rgbs[start:end]
            batch = [input_of(rgb, self.profile, input_size_px) for rgb in some]
            answer = self.network.run(batch[0] if len(batch) == 1 else np.concatenate(batch))
            ran_on = ", ".join(dict.fromkeys(whats[start:end]))
            about = f"Network {self.name} ({self.network.path}), run on {ran_on},"
            if len(some) > 1 and (answer.ndim == 0 or len(answer) != len(some)):
                raise LabelError(
                    f"{about} gave shape {answer.shape} for {len(some)} images; expected an answer "
                    "an image, along the first axis."
                )
            for index in range(len(some)):
                yield (answer if len(some) == 1 else answer[index : index + 1]), about
            start = end


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
