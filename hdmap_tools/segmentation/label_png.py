"""Label images on disk: 8-bit single-channel PNG whose values are class ids, never colours."""

from __future__ import annotations

import os
import struct
import uuid
from pathlib import Path
from typing import Final

from hdmap_tools.errors import ImageError, ShapeError
from hdmap_tools.readers.image import find_damage
from hdmap_tools.types import NDArrayAny, NDArrayByte

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES: Final = {
    0: "greyscale",
    2: "colour (RGB)",
    3: "palette colour",
    4: "greyscale with alpha",
    6: "colour with alpha (RGBA)",
}


def read_label_png(path: Path, *, size_px: tuple[int, int] | None = None) -> NDArrayByte:
    """The ids (height, width) uint8 in a label PNG.

    The file's own checksums are verified first: image libraries fill what a
    truncated file lacks with zeros, which here would be a class.

    Args:
        path: The PNG.
        size_px: (width, height) it must have; None takes any.

    Raises:
        ImageError: If the file is missing, damaged, of another size, or holds
            anything but one channel of 8 bits.
    """
    return _read_ids(path, bits=8, size_px=size_px)


def read_panoptic_png(path: Path, divisor: int) -> NDArrayAny:
    """Class values (height, width) uint16 of a 16-bit panoptic mask: value // divisor.

    Raises:
        ImageError: If the file is missing, damaged, or not one channel of 16 bits.
    """
    masks: NDArrayAny = _read_ids(path, bits=16, size_px=None) // divisor
    return masks


def write_label_png(path: Path, label_image: NDArrayByte) -> None:
    """Write ids (height, width) uint8 atomically; the same ids give the same bytes.

    Raises:
        OSError: If the folder cannot be made or written to.
    """
    import cv2

    if label_image.ndim != 2 or label_image.dtype != "uint8" or label_image.size == 0:
        raise ShapeError(
            f"A label image is (height, width) uint8, found {label_image.shape} {label_image.dtype}."
        )
    # Label images are large areas of one number: without filters and at the lowest level they take
    # a fifth of the default's time to write and to read, and are no larger.
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    done, encoded = cv2.imencode(".png", label_image, settings)
    if not done:
        raise ImageError(f"The label image for {path} could not be encoded as PNG.")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(encoded.tobytes())
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _read_ids(path: Path, bits: int, size_px: tuple[int, int] | None) -> NDArrayAny:
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise ImageError(f"Label image {path} is missing.") from error
    except OSError as error:
        raise ImageError(f"Label image {path} cannot be read: {error.strerror}.") from error
    width, height, depth, colour_type = _checked_header(content, path)
    if colour_type != 0 or depth != bits:
        kind = _COLOUR_TYPES.get(colour_type, f"colour type {colour_type}")
        raise ImageError(
            f"Label image {path} is a {kind} PNG of {depth} bits; expected one channel of {bits} bits: "
            "label images hold class ids, never colours. Save the ids themselves."
        )
    # Before decoding, so that a header asking for gigabytes costs nothing.
    if size_px is not None and (width, height) != size_px:
        raise ImageError(
            f"Label image {path} is {width}x{height} pixels, but its camera image is "
            f"{size_px[0]}x{size_px[1]}; make the labels at the image's own size."
        )
    import cv2
    import numpy as np

    try:
        ids = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageError(f"Label image {path} does not decode: {error}") from error
    if ids is None or ids.shape != (height, width) or ids.dtype.itemsize * 8 != bits:
        found = "nothing" if ids is None else f"{ids.shape} {ids.dtype}"
        raise ImageError(
            f"Label image {path} decodes to {found}; expected ({height}, {width}) of {bits} bits."
        )
    return ids


def _checked_header(content: bytes, path: Path) -> tuple[int, int, int, int]:
    """Width, height, bit depth and colour type, once every chunk's checksum holds.

    Source:
        PNG specification, third edition (W3C), sections 5.2, 5.3 and 11.2.1.
    """
    if not content.startswith(_SIGNATURE):
        raise ImageError(f"Label image {path} is not a PNG ({len(content)} bytes).")
    damage = find_damage(content)
    if damage is not None:
        raise ImageError(f"Label image {path} is damaged: {damage}. Make it anew.")
    length, kind = struct.unpack_from(">I4s", content, len(_SIGNATURE))
    if kind != b"IHDR" or length != 13:
        raise ImageError(f"Label image {path} is not a PNG: it begins with {kind!r}, not a header.")
    width, height, depth, colour_type = struct.unpack_from(">IIBB", content, len(_SIGNATURE) + 8)
    return width, height, depth, colour_type
