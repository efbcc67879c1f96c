"""Read one camera image, and notice when it is damaged.

`cv2.imread` returns a partly grey image for a truncated JPEG, with a word on stderr
only; its grey would be labelled and counted. What `cv2.imdecode` does depends on the
version of OpenCV. So the file's structure is walked first.
"""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.errors import ImageError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.types import NDArrayByte

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
# In entropy-coded data FF 00 is a stuffed byte, FF D0..D7 a restart, FF FF padding.
_JPEG_MARKER_IN_SCAN: Final = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_JPEG_EOI: Final = 0xD9
_JPEG_SOS: Final = 0xDA
_JPEG_WITHOUT_LENGTH: Final = frozenset({0x01, *range(0xD0, 0xD9)})


def read_image(ref: ImageRef, camera: PinholeCamera) -> NDArrayByte:
    """Read the image and check it against its camera.

    Args:
        ref: The image.
        camera: Its camera; the image must have exactly this camera's size.

    Returns:
        (H, W, 3) uint8, RGB, in the sensor's orientation (an EXIF rotation tag is
        ignored: calibration refers to the pixels as stored).

    Raises:
        ImageError: If the file is missing, empty, truncated, does not decode, or
            has another size than the camera.
    """
    image = read_rgb(ref.path, f"the image of camera {ref.camera} at {ref.timestamp_ns} ns")
    height, width = image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise ImageError(
            f"Image {ref.path} is {width}x{height} px, but camera {ref.camera} is calibrated for "
            f"{camera.width_px}x{camera.height_px} px; use the images the calibration was made for."
        )
    return image


def read_rgb(path: Path, expected: str = "a JPEG or PNG") -> NDArrayByte:
    """Any image file as (H, W, 3) uint8 RGB, in the orientation that its pixels are stored in.

    Args:
        path: The file.
        expected: What was looked for there, for the message where it cannot be read.

    Raises:
        ImageError: If the file is missing, empty, truncated or does not decode.
    """
    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise ImageError(
            f"Image {path} cannot be read ({error.strerror or error}); expected {expected}."
        ) from error
    damage = find_damage(encoded)
    if damage is not None:
        raise ImageError(
            f"Image {path} is damaged: {damage}. Copy it again or remove it from the drive."
        )
    image = _decode(encoded)
    if image is None:
        raise ImageError(
            f"Image {path} does not decode ({len(encoded)} bytes, starts with "
            f"{encoded[:8].hex(' ')}); expected a JPEG or PNG. Copy it again or remove it."
        )
    return image


def find_damage(encoded: bytes) -> str | None:
    """What is wrong with the structure of a JPEG or PNG file, or None.

    Other formats pass: only their decoder can judge them. A JPEG whose coded pixels
    were altered in place passes too, since JPEG carries no checksum.
    """
    if not encoded:
        return "the file is empty"
    if encoded.startswith(b"\xff\xd8"):
        return _jpeg_damage(encoded)
    if encoded.startswith(_PNG_SIGNATURE):
        return _png_damage(encoded)
    return None


def _jpeg_damage(encoded: bytes) -> str | None:
    """Walk the markers: an embedded thumbnail has an end marker of its own, so searching misleads."""
    truncated = f"the JPEG ends after {len(encoded)} bytes without its end marker (truncated)"
    position, has_pixels = 2, False
    while position + 1 < len(encoded):
        if encoded[position] != 0xFF:
            return f"byte {position} is not a JPEG marker"
        marker = encoded[position + 1]
        if marker == 0xFF:
            position += 1
            continue
        if marker == _JPEG_EOI:
            return None if has_pixels else "the JPEG holds no pixels"
        if marker in _JPEG_WITHOUT_LENGTH:
            position += 2
            continue
        if position + 4 > len(encoded):
            return truncated
        position += 2 + int.from_bytes(encoded[position + 2 : position + 4], "big")
        if marker == _JPEG_SOS:
            has_pixels = True
            following = _JPEG_MARKER_IN_SCAN.search(encoded, position)
            if following is None:
                return truncated
            position = following.start()
    return truncated


def _png_damage(encoded: bytes) -> str | None:
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(encoded):
        (length,) = struct.unpack_from(">I", encoded, position)
        end = position + 12 + length
        if end > len(encoded):
            break
        kind = encoded[position + 4 : position + 8]
        (checksum,) = struct.unpack_from(">I", encoded, end - 4)
        if zlib.crc32(encoded[position + 4 : end - 4]) != checksum:
            return f"PNG chunk {kind!r} at byte {position} fails its checksum"
        if kind == b"IEND":
            return None
        position = end
    return f"the PNG ends after {len(encoded)} bytes without its end chunk (truncated)"


def _decode(encoded: bytes) -> NDArrayByte | None:
    import cv2

    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error:  # for example more pixels than OpenCV allows
        return None
    if bgr is None:
        return None
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
