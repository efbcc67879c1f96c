"""Drives with label images: simulated ones carry their own, recorded ones have a folder of them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.segmentation.precomputed import LABEL_SET_NAME, label_path, require_label_folder
from hdmap_tools.segmentation.training.image_pairs import ImagePairs, joined
from hdmap_tools.segmentation.training.labelled_files import LabelledFiles

_TRUTH: Final = Path("truth") / "label_images"
"""Where a simulated drive has its own, as `hdmap_tools.simulate.truth_files` writes them."""

_log = logging.getLogger(__name__)


def open_drives(folders: Sequence[Path | str], labels: Path | str | None = None) -> ImagePairs:
    """The labelled images of one or more drives, one drive after another.

    Args:
        folders: Drives, or folders that hold several of them.
        labels: The folder ``<camera>/<timestamp_ns>.png`` with `LABEL_SET_NAME` of the one
            drive; None takes what lies with each drive.

    Raises:
        ConfigError: If there is no drive, or one has no label images.
        DriveError: If a drive cannot be read.
        LabelError: If a folder of label images does not say what their ids mean, or
            the drives' label sets differ.
    """
    drives = [drive for folder in folders for drive in find_drives(Path(folder))]
    if not drives:
        raise ConfigError("There are no drives to take images from; name at least one.")
    if labels is not None and len(drives) > 1:
        raise ConfigError(
            f"One folder of label images, {labels}, was given for {len(drives)} drives; name each "
            "drive with its own."
        )
    return joined([open_labelled_drive(drive, labels) for drive in drives])


def find_drives(folder: Path) -> list[Path]:
    """The drive at a folder, or those of the simulated drives in it, sorted.

    A folder that is one drive or a data root of recorded ones comes back as it is.
    """
    inside = sorted(found.parent.parent for found in folder.glob(f"*/{_TRUTH.as_posix()}"))
    is_drive = (folder / _TRUTH).is_dir()
    return inside if inside and not is_drive else [folder]


def open_labelled_drive(folder: Path, labels: Path | str | None = None) -> LabelledFiles:
    """The images of one drive that have a label image.

    Args:
        folder: The drive, of any layout that `open_drive` knows.
        labels: Its label images; None: those that it was simulated with.

    Raises:
        ConfigError: If there is no folder of label images, or none fits an image.
        DriveError: If the drive cannot be read.
        LabelError: If the folder does not say what the ids mean.
    """
    drive = open_drive(folder)
    label_folder = Path(labels) if labels is not None else folder / _TRUTH
    if labels is None and not label_folder.is_dir():
        raise ConfigError(
            f"Drive {folder} has no label images of its own: there is no {label_folder}. Give their "
            "folder, <camera>/<timestamp_ns>.png, beside the drive's."
        )
    require_label_folder(label_folder)
    files = [(image.path, label_path(label_folder, image)) for image in drive.images]
    labelled = tuple((image, label) for image, label in files if label.is_file())
    num_labels = sum(1 for _ in label_folder.glob("*/*.png"))
    if not labelled:
        raise ConfigError(
            f"None of the {len(files)} images of drive {folder} has a label image in {label_folder} "
            f"({num_labels} PNGs); their names must be <camera>/<timestamp_ns>.png."
        )
    if len(labelled) < len(files):
        _log.info("%s: %d of %d images have labels", folder, len(labelled), len(files))
    if num_labels > len(labelled):
        _log.warning(
            "%s: %d label images in %s are of no image of the drive",
            folder,
            num_labels - len(labelled),
            label_folder,
        )
    return LabelledFiles(drive.name, _label_set_of(label_folder), labelled)


def _label_set_of(folder: Path) -> LabelSet:
    path = folder / LABEL_SET_NAME
    if not path.is_file():
        raise LabelError(
            f"{folder} does not say what its ids mean: {path} is missing; copy the label set there "
            "as JSON."
        )
    return load_label_set(path)
