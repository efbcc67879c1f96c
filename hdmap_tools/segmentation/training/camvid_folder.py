"""CamVid, as its authors hand it out in colours, and as SegNet's do in eleven classes."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import LabelError
from hdmap_tools.labels.camvid import CAMVID, CAMVID_32, CAMVID_VOID_ID
from hdmap_tools.labels.label_set import IGNORE_ID, load_label_set
from hdmap_tools.readers.image import read_rgb
from hdmap_tools.segmentation.training.labelled_files import (
    LabelledFiles,
    list_files,
    paired,
    require_folder,
)
from hdmap_tools.types import NDArrayByte

_IMAGES: Final = "701_StillsRaw_full"
_LABELS: Final = "LabeledApproved_full"


def open_camvid(folder: Path | str, split: str = "train") -> LabelledFiles:
    """The images and labels of one split of CamVid; void becomes 255.

    Args:
        folder: Holds ``<split>/*.png`` and ``<split>annot/*.png``.
        split: ``train``, ``val`` or ``test``.

    Raises:
        ConfigError: If a folder is missing or empty.
        ImageError: If an image has no label file.
    """
    images, labels = Path(folder) / split, Path(folder) / f"{split}annot"
    layout = f"CamVid in SegNet's layout: {split}/*.png beside {split}annot/*.png"
    require_folder(images, layout)
    require_folder(labels, layout)
    return LabelledFiles(
        name=f"CamVid {split}",
        label_set=load_label_set(CAMVID),
        files=paired(
            list_files(images, "*", (".png",)),
            lambda image: labels / image.name,
            f"{images} (*.png)",
        ),
        void_id=CAMVID_VOID_ID,
    )


def open_camvid_32(folder: Path | str) -> LabelledFiles:
    """All images of CamVid with its own 32 labels, the only form that has lane markings.

    Args:
        folder: Holds ``701_StillsRaw_full/*.png`` and ``LabeledApproved_full/*_L.png``.

    Raises:
        ConfigError: If a folder is missing or empty.
        ImageError: If an image has no label file.
    """
    images, labels = (Path(folder) / name for name in (_IMAGES, _LABELS))
    layout = f"CamVid as handed out: {_IMAGES}/*.png beside {_LABELS}/*_L.png"
    require_folder(images, layout)
    require_folder(labels, layout)
    return LabelledFiles(
        name="CamVid, 32 labels",
        label_set=load_label_set(CAMVID_32),
        files=paired(
            list_files(images, "*", (".png",)),
            lambda image: labels / f"{image.stem}_L.png",
            f"{images} (*.png)",
        ),
        read_ids=read_camvid_colours,
        void_id=load_label_set(CAMVID_32).id_of("Void"),
    )


def read_camvid_colours(path: Path) -> NDArrayByte:
    """Ids (h, w) uint8 of ``camvid-32`` from a label image in colours.

    Raises:
        ImageError: If the file is missing or damaged.
        LabelError: If it holds a colour that is no label's.
    """
    rgb = read_rgb(path, "a label image of CamVid")
    # Every channel of every colour is a multiple of 64: six bits are its number.
    numbers = (rgb[..., 0] >> 6) << 4 | (rgb[..., 1] >> 6) << 2 | rgb[..., 2] >> 6
    ids: NDArrayByte = np.take(_ids_of_colours(), numbers)
    bad = (ids == IGNORE_ID) | ((rgb & 63) != 0).any(axis=2)
    if bad.any():
        colour = tuple(int(value) for value in rgb[bad][0])
        raise LabelError(
            f"Label image {path} has the colour {colour} ({int(bad.sum())} pixels of no label), "
            "which is none of CamVid's; label images must not be resized or saved as JPEG."
        )
    return ids


@lru_cache
def _ids_of_colours() -> NDArrayByte:
    table = np.full(64, IGNORE_ID, dtype=np.uint8)
    for label in load_label_set(CAMVID_32).labels:
        red, green, blue = (value >> 6 for value in label.color)
        table[red << 4 | green << 2 | blue] = label.id
    table.setflags(write=False)
    return table
