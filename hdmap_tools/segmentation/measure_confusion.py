"""Measure a network's confusion matrix on annotated images."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.label_png import read_label_png, read_panoptic_png
from hdmap_tools.types import NDArrayByte

_LOG = logging.getLogger(__name__)

_BY_CHANCE: Final = 0.01
"""IoU that masks read with the wrong labels reach here and there."""
_IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png")


class RgbSegmenter(Protocol):
    """What measuring needs of a network; `NetworkSegmenter` is one."""

    @property
    def label_set(self) -> LabelSet:
        """What its ids mean."""
        ...

    def segment_rgb(self, rgb: NDArrayByte, what: str = ...) -> NDArrayByte:
        """The label image (height, width) of an image (height, width, 3) RGB."""
        ...


def measure_confusion(
    pairs: Iterable[tuple[NDArrayByte, NDArrayByte]],
    segment: Callable[[NDArrayByte], NDArrayByte],
    true_set: LabelSet,
    predicted_set: LabelSet,
    source: str = "",
) -> ConfusionMatrix:
    """Count true against predicted labels over images.

    Args:
        pairs: Images (height, width, 3) uint8 RGB with their true labels
            (height, width) uint8, 255 where nothing is known.
        segment: The network: from such an image to its label image.
        true_set: Labels of the truth.
        predicted_set: Labels of the network.
        source: What the images are, kept with the matrix.

    Raises:
        ConfigError: If there is no pair.
        LabelError, ShapeError: If an id is outside its set, or sizes differ.
    """
    labelled = ((truth, segment(image), None) for image, truth in pairs)
    return confusion_of_pairs(labelled, true_set, predicted_set, (), source)


def confusion_of_pairs(
    pairs: Iterable[tuple[NDArrayByte, NDArrayByte, NDArrayByte | None]],
    true_set: LabelSet,
    predicted_set: LabelSet,
    range_edges_m: Sequence[float] = (),
    source: str = "",
) -> ConfusionMatrix:
    """Count true against predicted labels over pairs of label images.

    Args:
        pairs: True labels, predicted labels (both (height, width) uint8, 255 where
            nothing is known), and the band of distance of each pixel or None.
        true_set: Labels of the truth.
        predicted_set: Labels of the network.
        range_edges_m: Where the bands of distance begin; empty where there are none.
        source: What the images are, kept with the matrix.

    Raises:
        ConfigError: If there is no pair.
        LabelError, ShapeError: If an id is outside its set, or sizes differ.
    """
    total: ConfusionMatrix | None = None
    for truth, predicted, band in pairs:
        one = ConfusionMatrix.measure(
            truth,
            predicted,
            true_set,
            predicted_set,
            band_image=band,
            range_edges_m=range_edges_m,
        )
        total = one if total is None else total + one
    if total is None:
        raise ConfigError("There is no annotated image to measure a confusion matrix on.")
    agreed = total.class_agreement()
    if not any(one.iou >= _BY_CHANCE for one in agreed.values()):
        _LOG.warning(
            "Network (%s) and masks (%s) agree on no class of the map (%s); is %r what the ids in the "
            "masks mean?",
            predicted_set.name,
            true_set.name,
            ", ".join(f"{name} IoU {one.iou:.3f}" for name, one in agreed.items()) or "none shared",
            true_set.name,
        )
    return ConfusionMatrix(true_set, predicted_set, total.counts, source, total.bands)


def confusion_from_folders(
    images: Path,
    masks: Path,
    segmenter: RgbSegmenter,
    true_set: LabelSet,
    *,
    mask_suffix: str = "",
    divisor: int = 1,
    ignore: Sequence[str] = (),
    source: str = "",
) -> ConfusionMatrix:
    """Measure a network on a folder of images and one of masks.

    Args:
        images: Holds ``<name>.jpg``, ``.jpeg`` or ``.png``.
        masks: Holds ``<name><mask_suffix>.png``; may be the same folder.
        segmenter: The network.
        true_set: What the masks' classes mean.
        mask_suffix: What a mask's name has beyond its image's, for example ``_panoptic``.
        divisor: 1 for 8-bit masks of class ids; more for 16-bit panoptic masks
            whose class is value // divisor (Waymo: 1000).
        ignore: Labels of the truth that say nothing, such as an undefined one.
        source: What the images are, kept with the matrix.

    Raises:
        ConfigError: If a folder is missing, no mask has an image, or the divisor
            is not positive.
        ImageError: If an image or mask is damaged, or they differ in size.
        LabelError: If a mask holds a class outside the set, or a label to be
            ignored is not in it.
    """
    if divisor < 1:
        raise ConfigError(f"A panoptic mask's divisor must be 1 or more, found {divisor}.")
    ignored_ids = [true_set.id_of(name) for name in ignore]
    found = _matching(images, masks, mask_suffix)

    def pairs() -> Iterator[tuple[NDArrayByte, NDArrayByte]]:
        for image, mask in found:
            truth = read_mask(mask, true_set, divisor)
            truth[np.isin(truth, ignored_ids)] = IGNORE_ID
            yield read_rgb_of_size(image, truth.shape[1], truth.shape[0]), truth

    return measure_confusion(pairs(), segmenter.segment_rgb, true_set, segmenter.label_set, source)


def read_mask(path: Path, true_set: LabelSet, divisor: int = 1) -> NDArrayByte:
    """True ids (height, width) uint8 from a mask of ids (divisor 1) or a panoptic one.

    Raises:
        ImageError: If it is damaged or not of 8 bits (divisor 1) or 16 bits (more).
        LabelError: If it holds a class outside the set.
    """
    if divisor == 1:
        truth = read_label_png(path)
        true_set.check(truth, f"Mask {path}")
        return truth
    classes = read_panoptic_png(path, divisor)
    # Before the cast, which would fold class 256 into 0.
    if classes.max() >= len(true_set):
        raise LabelError(
            f"Mask {path} holds class {int(classes.max())} (value // {divisor}), but label set "
            f"{true_set.name!r} has ids 0..{len(true_set) - 1}; check the divisor."
        )
    return classes.astype(np.uint8)


def _matching(images: Path, masks: Path, mask_suffix: str) -> list[tuple[Path, Path]]:
    for folder in (images, masks):
        if not folder.is_dir():
            raise ConfigError(f"There is no folder {folder}.")
    found = []
    for image in sorted(images.iterdir()):
        mask = masks / f"{image.stem}{mask_suffix}.png"
        if image.suffix.lower() in _IMAGE_SUFFIXES and mask.is_file() and mask != image:
            found.append((image, mask))
    if not found:
        raise ConfigError(
            f"No image <name>{'|'.join(_IMAGE_SUFFIXES)} in {images} has a mask "
            f"<name>{mask_suffix}.png in {masks}."
        )
    return found


def read_rgb_of_size(path: Path, width_px: int, height_px: int) -> NDArrayByte:
    """An image (height, width, 3) uint8 RGB that must have its mask's size.

    Raises:
        ImageError: If it is damaged or of another size.
    """
    # Only the size of this camera is read: the image must be as large as its mask.
    camera = PinholeCamera(path.stem, width_px, height_px, 1.0, 1.0, 0.0, 0.0, SE3.identity())
    return read_image(ImageRef(path.stem, 0, path), camera)
