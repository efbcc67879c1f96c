"""CamVid as SegNet's authors hand it out: ``train`` with ``trainannot``, eleven classes."""

from __future__ import annotations

from pathlib import Path

from hdmap_tools.labels.camvid import CAMVID, CAMVID_VOID_ID
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.training.labelled_files import (
    LabelledFiles,
    list_files,
    paired,
    require_folder,
)


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
