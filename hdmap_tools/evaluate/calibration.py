"""What is measured on other drives than the evaluated one: confusion, intensity, temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hdmap_tools.compare.truth_reference import true_shares
from hdmap_tools.errors import ConfigError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.readers.drive import Drive
from hdmap_tools.segmentation.cache import LabelCache, segment_drive
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.label_png import read_label_png
from hdmap_tools.segmentation.precomputed import label_path
from hdmap_tools.segmentation.segmenter import Segmenter
from hdmap_tools.simulate.truth_files import LABEL_IMAGES, TRUTH_FOLDER, true_label_set
from hdmap_tools.simulate.truth_raster import TruthRaster
from hdmap_tools.types import NDArrayFloat


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
    drives: Sequence[Drive], segmenters: Sequence[Segmenter], cache: LabelCache | None = None
) -> ConfusionMatrix:
    """How often a segmenter says which label, over all images of simulated drives.

    Args:
        drives: With true label images.
        segmenters: The same one, opened for each drive.
        cache: Where label images are kept.

    Raises:
        ConfigError: If a drive has no truth, or there is no image.
    """
    total: ConfusionMatrix | None = None
    true_set = true_label_set()
    for drive, segmenter in zip(drives, segmenters, strict=True):
        folder = TruthOfDrive.of(drive).folder / LABEL_IMAGES
        for image, predicted in segment_drive(drive, segmenter, drive.images, cache):
            truth = read_label_png(label_path(folder, image))
            one = ConfusionMatrix.measure(truth, predicted, true_set, segmenter.label_set)
            total = one if total is None else total + one
    if total is None:
        raise ConfigError("The calibration drives have no images to measure a confusion matrix on.")
    names = ", ".join(drive.name for drive in drives)
    return ConfusionMatrix(
        total.true_set, total.predicted_set, total.counts, f"simulated drives {names}"
    )
