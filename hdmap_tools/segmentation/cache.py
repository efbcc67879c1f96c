"""Label images of a whole drive, each computed once and kept."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from hdmap_tools.errors import ImageError, LabelError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.segmentation.label_png import read_label_png, write_label_png
from hdmap_tools.segmentation.network import NetworkSegmenter, camera_of
from hdmap_tools.segmentation.precomputed import PrecomputedSegmenter
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.types import NDArrayByte

_log = logging.getLogger(__name__)


class SegmentProgress(Protocol):
    """What a progress bar needs to be told."""

    def __call__(self, done: int, total: int) -> None:
        """Images done so far, of how many; called first with 0 done."""
        ...


class LabelCache:
    """Label images kept as PNGs, by what they were made from.

    A key holds the segmenter's fingerprint, the image file's bytes and the
    image size, so a changed network, profile or image is a new entry and no
    entry ever goes stale.

    Args:
        folder: Where they lie. The default is in the user's cache and not beside
            the drive, because a drive's folder is often read-only or shared.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = default_folder() if folder is None else folder
        self._is_writable = True

    def read(self, path: Path, label_set: LabelSet, size_px: tuple[int, int]) -> NDArrayByte | None:
        """The label image (height, width) uint8 kept at `path_of`, or None if there is no sound one."""
        if not os.path.exists(
            path
        ):  # where Path.exists raises, as for a locked folder, this is False
            return None
        try:
            labels = read_label_png(path, size_px=size_px)
            label_set.check(labels, f"Cached label image {path}")
        except (ImageError, LabelError) as error:
            _log.warning("Computed anew: %s", error)
            return None
        return labels

    def write(self, path: Path, labels: NDArrayByte) -> None:
        """Keep a label image; a folder that cannot be written to is warned of once."""
        if not self._is_writable:
            return
        try:
            write_label_png(path, labels)
        except OSError as error:
            self._is_writable = False
            _log.warning(
                "Label images are not cached: %s cannot be written to (%s).", self.folder, error
            )

    def path_of(self, segmenter: Segmenter, image: ImageRef, camera: PinholeCamera) -> Path | None:
        """Where an image's labels are kept, or None if the image file cannot be read."""
        try:
            content = hashlib.sha256(image.path.read_bytes()).hexdigest()
        except OSError:
            return None  # the segmenter says what is wrong with it
        key = f"{segmenter.fingerprint} {content} {camera.width_px}x{camera.height_px}"
        name = hashlib.sha256(key.encode()).hexdigest()
        return self.folder / name[:2] / f"{name}.png"


def default_folder() -> Path:
    """``$XDG_CACHE_HOME/hdmap_tools/labels``, or below ``~/.cache``.

    Source:
        XDG Base Directory Specification 0.8: a path that is not absolute is ignored.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(given) if Path(given).is_absolute() else Path("~/.cache").expanduser()
    return base / "hdmap_tools" / "labels"


def segment_drive(
    drive: Drive,
    segmenter: Segmenter,
    images: Sequence[ImageRef],
    cache: LabelCache | None = None,
    progress: SegmentProgress | None = None,
) -> Iterator[tuple[ImageRef, NDArrayByte]]:
    """The label images of a drive's images, in their order, computed as they are taken.

    One image at a time with all threads, unless the segmenter takes batches: on two cores
    and 1600x900 images that took 55 to 60 ms each, two images side by side with a thread
    each 73 ms.

    Args:
        drive: Its cameras give the size of the images.
        segmenter: Makes the label images.
        images: Which images.
        cache: Where to look first and to keep results; None does neither.
            Precomputed labels are not cached: they are files already.
        progress: Told before each image and after the last.

    Yields:
        The image and its labels (height, width) uint8.

    Raises:
        ImageError, LabelError, CalibrationError: As the segmenter raises them, at
            the image's turn or, in a batch, at that of its first image.
    """
    if isinstance(segmenter, PrecomputedSegmenter):
        cache = None

    def path_of(image: ImageRef) -> Path | None:
        return None if cache is None else cache.path_of(segmenter, image, camera_of_image(image))

    def camera_of_image(image: ImageRef) -> PinholeCamera:
        return camera_of(image, drive.cameras)

    def kept(image: ImageRef, path: Path | None) -> NDArrayByte | None:
        if cache is None or path is None:
            return None
        camera = camera_of_image(image)
        return cache.read(path, segmenter.label_set, (camera.width_px, camera.height_px))

    size = segmenter.batch if isinstance(segmenter, NetworkSegmenter) else 1
    for start in range(0, len(images), size):
        some = images[start : start + size]
        if progress is not None:
            progress(start, len(images))
        paths = [path_of(image) for image in some]
        found = [kept(image, path) for image, path in zip(some, paths, strict=True)]
        missing = [index for index, labels in enumerate(found) if labels is None]
        computed = _segmented(segmenter, [some[index] for index in missing])
        for index, labels in zip(missing, computed, strict=True):
            found[index] = labels
            path = paths[index]
            if cache is not None and path is not None:
                cache.write(path, labels)
        for index, (image, one) in enumerate(zip(some, found, strict=True)):
            if progress is not None and index:
                progress(start + index, len(images))
            assert one is not None
            yield image, one
    if progress is not None:
        progress(len(images), len(images))


def _segmented(segmenter: Segmenter, images: list[ImageRef]) -> list[NDArrayByte]:
    if isinstance(segmenter, NetworkSegmenter):
        return segmenter.segment_many(images) if images else []
    return [segmenter.segment(image) for image in images]
