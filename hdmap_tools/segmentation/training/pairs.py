"""The door to labelled images: every data set by a function, and all by one line of text."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from hdmap_tools.errors import ConfigError
from hdmap_tools.segmentation.training.camvid_folder import open_camvid, open_camvid_32
from hdmap_tools.segmentation.training.cityscapes_folder import open_cityscapes
from hdmap_tools.segmentation.training.drive_pairs import open_drives
from hdmap_tools.segmentation.training.image_pairs import ImagePairs, joined, relabelled
from hdmap_tools.segmentation.training.labelled_files import LabelledFiles
from hdmap_tools.segmentation.training.vistas_folder import open_vistas

SPEC_HELP: Final = (
    "drive:FOLDER[:LABELS], vistas:FOLDER[:SPLIT], vistas-v2:FOLDER[:SPLIT], "
    "cityscapes:FOLDER[:SPLIT], camvid:FOLDER[:SPLIT] or camvid-32:FOLDER; FOLDER alone is a drive"
)
"""How data is named on the command line."""

_KINDS: Final = ("drive", "vistas", "vistas-v2", "cityscapes", "camvid", "camvid-32")


def open_pairs(spec: str) -> ImagePairs:
    """Labelled images by a line of text, as on the command line.

    Args:
        spec: ``drive:FOLDER``, a drive or a folder of simulated ones;
            ``drive:FOLDER:LABELS``, with its label images elsewhere;
            ``vistas:FOLDER:SPLIT``, ``vistas-v2:FOLDER:SPLIT``,
            ``cityscapes:FOLDER:SPLIT``, ``camvid:FOLDER:SPLIT``, the split being the one
            for training when it is left out; ``camvid-32:FOLDER``, which has no splits; or a folder alone, which is a drive.

    Raises:
        ConfigError: If the kind of data is unknown, or a folder is missing or empty.
        DriveError: If a drive cannot be read.
        ImageError: If an image has no label file.
        LabelError: If the label ids' meaning is not known.
    """
    kind, colon, rest = spec.partition(":")
    if kind not in _KINDS:
        if colon and not Path(spec).exists():
            raise ConfigError(f"{spec!r} names no data: {kind!r} is unknown; expected {SPEC_HELP}.")
        kind, rest = "drive", spec
    if not rest:
        raise ConfigError(f"{spec!r} names no folder; expected {SPEC_HELP}.")
    folder, _, second = rest.rpartition(":")
    if not folder or kind == "camvid-32" or Path(rest).exists():
        folder, second = rest, ""
    match kind:
        case "vistas":
            return open_vistas(folder, second or "training", "1.2")
        case "vistas-v2":
            return open_vistas(folder, second or "training", "2.0")
        case "cityscapes":
            return open_cityscapes(folder, second or "train")
        case "camvid":
            return open_camvid(folder, second or "train")
        case "camvid-32":
            return open_camvid_32(folder)
        case _:
            return open_drives([folder], second or None)


__all__ = [
    "SPEC_HELP",
    "ImagePairs",
    "LabelledFiles",
    "joined",
    "open_camvid",
    "open_camvid_32",
    "open_cityscapes",
    "open_drives",
    "open_pairs",
    "open_vistas",
    "relabelled",
]
