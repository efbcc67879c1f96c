"""Label images for people: the labels' colours over the picture, and a legend."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import ImageError, ShapeError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet
from hdmap_tools.types import NDArrayByte

OPACITY: Final = 0.5
_JPEG_QUALITY: Final = 90
_ROW_PX: Final = 28


def overlay_picture(
    rgb: NDArrayByte, labels: NDArrayByte, label_set: LabelSet, opacity: float = OPACITY
) -> NDArrayByte:
    """The labels' colours over an image; where nothing is said (`IGNORE_ID`) the image is darker.

    Args:
        rgb: (h, w, 3) uint8, RGB.
        labels: (h, w) uint8 ids.
        label_set: Gives the colours.
        opacity: Share of the colours, 0..1.

    Returns:
        (h, w, 3) uint8, RGB.

    Raises:
        ShapeError: If image and labels differ in size.
        LabelError: If an id is outside the label set.
    """
    import cv2

    if rgb.shape != (*labels.shape, 3):
        raise ShapeError(
            f"An overlay needs an image and labels of one size, found {rgb.shape} and {labels.shape}."
        )
    label_set.check(labels, "The label image")
    colours = label_set.colors.copy()
    colours[IGNORE_ID] = 0
    mixed = cv2.addWeighted(rgb, 1 - opacity, colours[labels], opacity, 0.0)
    return np.asarray(mixed, dtype=np.uint8)


def legend_picture(label_set: LabelSet) -> NDArrayByte:
    """The colours of a label set with their names, (h, w, 3) uint8, RGB."""
    import cv2

    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.6
    names = [f"{label.id} {label.name}" for label in label_set.labels]
    widest = max(cv2.getTextSize(name, font, scale, 1)[0][0] for name in names)
    picture = np.full((_ROW_PX * len(names), 2 * _ROW_PX + widest, 3), 255, dtype=np.uint8)
    for row, (label, name) in enumerate(zip(label_set.labels, names, strict=True)):
        top = row * _ROW_PX
        picture[top + 3 : top + _ROW_PX - 3, 4 : _ROW_PX + 12] = 128  # white is seen, too
        picture[top + 4 : top + _ROW_PX - 4, 5 : _ROW_PX + 11] = label.color
        corner = (_ROW_PX + 20, top + _ROW_PX - 8)
        cv2.putText(picture, name, corner, font, scale, (0, 0, 0), 1, cv2.LINE_AA)
    return picture


def write_picture(path: Path, rgb: NDArrayByte) -> None:
    """Write a picture (h, w, 3) uint8 RGB as JPEG or PNG, by its suffix.

    Raises:
        ImageError: If it cannot be encoded.
        FormatError, OutputExistsError: If it cannot be written.
    """
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if path.suffix == ".jpg" else []
    done, encoded = cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), settings)
    if not done:
        raise ImageError(f"The picture {path} could not be encoded.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(path) as temporary:
        temporary.write_bytes(encoded.tobytes())
