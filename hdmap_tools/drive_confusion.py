"""Measure a confusion matrix on whole drives whose true label images are known."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.association.planar import ground_plane
from hdmap_tools.config import Config
from hdmap_tools.errors import ConfigError
from hdmap_tools.frame_source import FrameSource
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.readers.drive import Drive
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.measure_confusion import confusion_of_pairs
from hdmap_tools.segmentation.open_segmenter import label_set_of
from hdmap_tools.segmentation.precomputed import LABEL_SET_NAME, PrecomputedSegmenter, label_path
from hdmap_tools.segmentation.range_bands import band_image, check_edges, ground_range_m
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.types import NDArrayByte

_LOG = logging.getLogger(__name__)

TRUE_LABELS: Final = Path("truth") / "label_images"
"""Where a simulated drive has its true label images."""

_DEFAULT_SET: Final = "paz2020"
_SWEEPS_FOR_GROUND: Final = 5


def confusion_of_drive(
    drive: Drive,
    segmenter: Segmenter,
    *,
    truth: Path | None = None,
    true_set: LabelSet | None = None,
    range_edges_m: Sequence[float] = (),
    source: str = "",
    told: Callable[[int, int], None] | None = None,
) -> ConfusionMatrix:
    """Count true against predicted labels over the images of a drive that have both.

    Args:
        drive: The drive.
        segmenter: Gives the predicted labels; images for which a folder of predictions
            has none are left out.
        truth: Folder of true label images ``<camera>/<timestamp_ns>.png``; None:
            `TRUE_LABELS` in the drive.
        true_set: What their ids mean; None: what the folder says, or ``paz2020``.
        range_edges_m: Where bands of distance begin, from 0; empty: not told apart.
        source: What this was measured on; the drive and the segmenter if empty.
        told: Told of progress: images done and in all.

    Raises:
        ConfigError: If there is no image with truth and prediction, or the bands are wrong.
        ImageError, LabelError: If a label image is damaged or holds an unknown id.
    """
    folder = truth or drive.root / TRUE_LABELS
    truths = PrecomputedSegmenter(folder, true_set or _label_set_of(folder), drive.cameras)
    images = [image for image in drive.images if label_path(folder, image).is_file()]
    if isinstance(segmenter, PrecomputedSegmenter):
        images = [i for i in images if label_path(segmenter.folder, i).is_file()]
    if not images:
        raise ConfigError(
            f"No image of drive {drive.name} has true labels in {folder} and a prediction; expected "
            "<camera>/<timestamp_ns>.png in both."
        )
    if len(images) < len(drive.images):
        _LOG.warning(
            "%d of %d images have no truth or no prediction and are left out.",
            len(drive.images) - len(images),
            len(drive.images),
        )
    bands: dict[str, NDArrayByte] = {}
    if range_edges_m:
        check_edges(range_edges_m)
        height_m = ground_height_m(drive)
        bands = {
            name: band_image(ground_range_m(drive.cameras[name], height_m), range_edges_m)
            for name in {image.camera for image in images}
        }

    def pairs() -> Iterator[tuple[NDArrayByte, NDArrayByte, NDArrayByte | None]]:
        for number, image in enumerate(images):
            yield truths.segment(image), segmenter.segment(image), bands.get(image.camera)
            if told is not None:
                told(number + 1, len(images))

    return confusion_of_pairs(
        pairs(),
        truths.label_set,
        segmenter.label_set,
        range_edges_m,
        source or f"{segmenter.name} on {drive.id}, {len(images)} images",
    )


def ground_height_m(drive: Drive) -> float:
    """Height of the ground under the vehicle in the ego frame, from a few sweeps; 0 without any."""
    source = FrameSource(drive, Config())
    with_sweep = [image for image in drive.images if source.sweep_ref(image) is not None]
    step = max(len(with_sweep) // _SWEEPS_FOR_GROUND, 1)
    planes = [ground_plane(source.grounded_sweep(image)) for image in with_sweep[::step]]
    return float(np.median([c for _, _, c in planes])) if planes else 0.0


def _label_set_of(folder: Path) -> LabelSet:
    return label_set_of(folder, None if (folder / LABEL_SET_NAME).is_file() else _DEFAULT_SET)
