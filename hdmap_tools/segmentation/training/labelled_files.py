"""Image files with their label files: what all data set folders come down to."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import ConfigError, ImageError
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet
from hdmap_tools.readers.image import find_damage, read_rgb
from hdmap_tools.segmentation.label_png import read_label_png
from hdmap_tools.types import NDArrayByte

_MAX_NAMED: Final = 3


@dataclass(frozen=True)
class LabelledFiles:
    """Pairs of files; an `ImagePairs`.

    Attributes:
        name: Names the data in logs.
        label_set: What the ids in the label files mean.
        files: (image, labels) paths.
        read_ids: From a label file to ids (h, w) uint8.
        void_id: An id of the files that says nothing and becomes 255.
    """

    name: str
    label_set: LabelSet
    files: tuple[tuple[Path, Path], ...]
    read_ids: Callable[[Path], NDArrayByte] = read_label_png
    void_id: int | None = None

    def __len__(self) -> int:
        return len(self.files)

    def read(self, index: int) -> tuple[NDArrayByte, NDArrayByte]:
        """One pair: rgb (h, w, 3) uint8 and ids (h, w) uint8, 255 where nothing is judged.

        Raises:
            ImageError: If a file is missing or damaged, or the two differ in size.
            LabelError: If an id is outside the label set.
        """
        image_path, label_path = self.files[index]
        ids = self.read_ids(label_path)
        rgb = read_rgb(image_path)
        if rgb.shape[:2] != ids.shape:
            raise ImageError(
                f"Image {image_path} is {rgb.shape[1]}x{rgb.shape[0]} pixels, but its labels "
                f"{label_path} are {ids.shape[1]}x{ids.shape[0]}; both must have the same size."
            )
        if self.void_id is not None:
            ids = np.where(ids == self.void_id, np.uint8(IGNORE_ID), ids)
        self.label_set.check(ids, f"Label image {label_path}")
        return rgb, ids

    def describe(self, index: int) -> str:
        """The files of a pair, for messages."""
        image_path, label_path = self.files[index]
        return f"{image_path} with labels {label_path}"


def read_palette_png(path: Path) -> NDArrayByte:
    """Ids (h, w) uint8 of a label PNG of 8 bits, greyscale or palette.

    OpenCV turns a palette into its colours, of which two labels may share one; the
    ids are the palette's indices.

    Raises:
        ImageError: If the file is missing, damaged, or neither of the two.
    """
    from PIL import Image

    try:
        content = path.read_bytes()
    except OSError as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else "cannot be read"
        raise ImageError(f"Label image {path} {reason}.") from error
    damage = find_damage(content)
    if damage is not None:
        raise ImageError(f"Label image {path} is damaged: {damage}. Copy it again.")
    try:
        with Image.open(path, formats=["PNG"]) as image:
            if image.mode not in ("P", "L"):
                raise ImageError(
                    f"Label image {path} is a PNG of mode {image.mode}; expected one of 8 bits with "
                    "a palette or in grey, whose values are label ids. Use the folder of label "
                    "ids, not of colours or instances."
                )
            return np.array(image, dtype=np.uint8)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ImageError(f"Label image {path} does not decode: {error}.") from error


def require_folder(folder: Path, layout: str) -> None:
    """Raise `ConfigError` unless a data set's folder is there.

    Args:
        folder: One that must exist.
        layout: How the data set lies on disk, for the message.
    """
    if not folder.is_dir():
        raise ConfigError(f"There is no folder {folder}; expected {layout}.")


def paired(
    images: Iterable[Path], label_of: Callable[[Path], Path], what: str
) -> tuple[tuple[Path, Path], ...]:
    """Each image with its label file.

    Args:
        images: Image files.
        label_of: Where an image's label file must lie.
        what: The folder and the files looked for, for messages.

    Raises:
        ConfigError: If there are no images.
        ImageError: If an image has no label file; the message names the first few.
    """
    files = tuple((image, label_of(image)) for image in sorted(images))
    if not files:
        raise ConfigError(f"There are no images in {what}.")
    missing = [label for _, label in files if not label.is_file()]
    if missing:
        named = ", ".join(str(path) for path in missing[:_MAX_NAMED])
        more = f" and {len(missing) - _MAX_NAMED} more" if len(missing) > _MAX_NAMED else ""
        raise ImageError(
            f"{len(missing)} of {len(files)} images have no label file: {named}{more} missing. "
            "Finish copying the labels, or remove the images."
        )
    return files


def list_files(folder: Path, pattern: str, endings: tuple[str, ...]) -> list[Path]:
    """Files below a folder by pattern and by ending in any case, hidden ones left out."""
    return [
        path
        for path in folder.glob(pattern)
        if path.suffix.lower() in endings and not path.name.startswith(".")
    ]
