"""Cityscapes as it is handed out: ``leftImg8bit`` with ``gtFine``, a folder a city."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from hdmap_tools.labels.cityscapes import CITYSCAPES_IDS
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.training.labelled_files import (
    LabelledFiles,
    list_files,
    paired,
    require_folder,
)

_IMAGES: Final = "leftImg8bit"
_LABELS: Final = "gtFine"


def open_cityscapes(folder: Path | str, split: str = "train") -> LabelledFiles:
    """The images and label ids of one split of Cityscapes.

    Args:
        folder: Holds ``leftImg8bit/<split>/<city>/*_leftImg8bit.png`` and
            ``gtFine/<split>/<city>/*_gtFine_labelIds.png``.
        split: ``train``, ``val``, or a folder of that layout of one's own.

    Raises:
        ConfigError: If a folder is missing or empty.
        ImageError: If an image has no label file.
    """
    images, labels = (Path(folder) / name / split for name in (_IMAGES, _LABELS))
    layout = f"Cityscapes: {_IMAGES}/{split}/<city> beside {_LABELS}/{split}/<city>"
    require_folder(images, layout)
    require_folder(labels, layout)

    def label_of(image: Path) -> Path:
        name = image.name.replace(f"_{_IMAGES}.png", f"_{_LABELS}_labelIds.png")
        return labels / image.parent.name / name

    found = list_files(images, f"*/*_{_IMAGES}.png", (".png",))
    return LabelledFiles(
        name=f"Cityscapes {split}",
        label_set=load_label_set(CITYSCAPES_IDS),
        files=paired(found, label_of, f"{images} (<city>/*_{_IMAGES}.png)"),
    )
