"""What is measured on other drives than the evaluated one: confusion, intensity, temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hdmap_tools.compare.truth_reference import true_shares
from hdmap_tools.drive_confusion import confusion_of_drive
from hdmap_tools.errors import ConfigError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.readers.drive import Drive, ImageRef
from hdmap_tools.segmentation.cache import LabelCache, segment_drive
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.simulate.truth_files import LABEL_IMAGES, TRUTH_FOLDER
from hdmap_tools.simulate.truth_raster import TruthRaster
from hdmap_tools.types import NDArrayByte, NDArrayFloat


@dataclass(frozen=True, eq=False)
class TruthOfDrive:
    """Where a simulated drive keeps its truth.

    Attributes:
        folder: ``truth`` in the drive's folder.
    """

    folder: Path

    @classmethod
    def of(cls, drive: Drive) -> TruthOfDrive:
        """The truth of a drive.

        Raises:
            ConfigError: If it has none: it was recorded, not simulated.
        """
        folder = drive.root / TRUTH_FOLDER
        if not (folder / LABEL_IMAGES).is_dir() or not (folder / "raster").is_dir():
            raise ConfigError(
                f"Drive {drive.name} has no truth in {folder}; expected a drive of `hdmap simulate`."
            )
        return cls(folder)

    def shares(self, grid: BevGrid) -> NDArrayFloat:
        """(class, y, x) share of each cell that each map class covers; NaN where nothing is known."""
        return true_shares(TruthRaster.open(self.folder / "raster"), grid)


def confusion_of_drives(
    drives: Sequence[Drive],
    segmenters: Sequence[Segmenter],
    range_edges_m: Sequence[float],
    cache: LabelCache | None = None,
) -> ConfusionMatrix:
    """How often a segmenter says which label, over all images of simulated drives, by range.

    Args:
        drives: With true label images.
        segmenters: The same one, opened for each drive.
        range_edges_m: Where bands of distance begin, from 0.
        cache: Where label images are kept.

    Raises:
        ConfigError: If a drive has no image with truth.
    """
    total: ConfusionMatrix | None = None
    for drive, segmenter in zip(drives, segmenters, strict=True):
        kept = _Cached(drive, segmenter, cache)
        one = confusion_of_drive(drive, kept, range_edges_m=range_edges_m)
        total = one if total is None else total + one
    assert total is not None
    return total


class _Cached:
    """A segmenter that looks into the cache first; a `Segmenter`."""

    def __init__(self, drive: Drive, segmenter: Segmenter, cache: LabelCache | None) -> None:
        self._drive, self._segmenter, self._cache = drive, segmenter, cache

    @property
    def name(self) -> str:
        return self._segmenter.name

    @property
    def label_set(self) -> LabelSet:
        return self._segmenter.label_set

    @property
    def fingerprint(self) -> str:
        return self._segmenter.fingerprint

    def segment(self, image: ImageRef) -> NDArrayByte:
        ((_, labels),) = segment_drive(self._drive, self._segmenter, [image], self._cache)
        return labels
