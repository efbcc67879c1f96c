"""Reading a mask picture and the JSON beside it that says where it lies."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hdmap_tools.errors import FormatError, brief_problems
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MapClass
from hdmap_tools.types import NDArrayBool

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_Finite = Annotated[float, Field(allow_inf_nan=False)]
# Beyond any map, yet small enough that no sum or product of them loses a millimetre.
_CityMetres = Annotated[float, Field(gt=-1e8, lt=1e8)]
_Size = Annotated[int, Field(gt=0, lt=2**31)]


class MaskSidecar(BaseModel):
    """What stands beside a mask picture ``NAME.png`` in ``NAME.json``.

    Other fields (where it comes from, notes) are allowed and not read.

    Attributes:
        resolution_m: Size of a pixel, 1 mm to 1 km.
        origin_xy_m: (x, y) of the picture's south-west corner, city metres, each below 1e8.
        size_px: (width, height) of the picture; row 0 is the north edge.
        classes: Map classes whose union the mask marks.
        map_origin_latlon: Latitude and longitude of city (0, 0), where known.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    resolution_m: Annotated[float, Field(ge=0.001, le=1000)]
    origin_xy_m: tuple[_CityMetres, _CityMetres]
    size_px: tuple[_Size, _Size]
    classes: Annotated[tuple[MapClass, ...], Field(min_length=1)] = DRIVABLE_CLASSES
    map_origin_latlon: tuple[_Finite, _Finite] | None = None


@dataclass(frozen=True, eq=False)
class Mask:
    """A mask in its own city frame.

    Attributes:
        is_marked: (rows, columns) bool, row 0 at the **south** edge as in all grids.
        sidecar: Where it lies and what it marks.
        frame: Its city frame; without CRS where the sidecar names no place on earth.
    """

    is_marked: NDArrayBool
    sidecar: MaskSidecar
    frame: MapFrame

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) of the outer pixel edges, metres in the mask's frame."""
        x0, y0 = self.sidecar.origin_xy_m
        width, height = self.sidecar.size_px
        r = self.sidecar.resolution_m
        return x0, y0, x0 + width * r, y0 + height * r


def load_mask(path: Path) -> Mask:
    """Read a mask picture with its sidecar.

    Raises:
        FormatError: If either file is missing, damaged, or does not fit the other.
    """
    sidecar = _load_sidecar(path.with_suffix(".json"), path)
    picture = _read_mask_png(path, sidecar)
    values = np.unique(picture)
    if len(values[values != 0]) > 1:
        listed = ", ".join(map(str, values[:5])) + (" ..." if len(values) > 5 else "")
        raise FormatError(
            f"{path} holds {len(values)} different values ({listed}); expected 0 "
            "and one other value. Write one mask for each union of classes."
        )
    frame = MapFrame()
    if sidecar.map_origin_latlon is not None:
        frame = MapFrame.from_origin(*sidecar.map_origin_latlon)
    return Mask(np.ascontiguousarray(picture[::-1] != 0), sidecar, frame)


def _load_sidecar(path: Path, mask_path: Path) -> MaskSidecar:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise FormatError(
            f"Mask {mask_path} has no {path.name} beside it, so its place is not known; write one with "
            "resolution_m, origin_xy_m (south-west corner) and size_px."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path} is not a readable text file: {error}") from error
    try:
        return MaskSidecar.model_validate(json.loads(text))
    except ValidationError as error:
        raise FormatError(f"{path} does not describe a mask: {brief_problems(error)}.") from error
    except RecursionError as error:
        raise FormatError(f"{path} is not JSON of a mask: it is nested too deeply.") from error
    except ValueError as error:  # no JSON, or a number of thousands of digits
        raise FormatError(f"{path} is not JSON: {error}") from error


def _read_mask_png(path: Path, sidecar: MaskSidecar) -> NDArrayBool:
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(f"Mask {path} cannot be read: {error.strerror or error}.") from error
    size = _checked_png_size(data, path)
    if size != sidecar.size_px:
        raise FormatError(
            f"Mask {path} is {size[0]} x {size[1]} pixels, but its JSON says size_px "
            f"{list(sidecar.size_px)} (width, height); one of them belongs to another file."
        )
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FormatError(f"Mask {path} does not decode as PNG: {error}") from error
    if picture is None:
        raise FormatError(f"Mask {path} does not decode as PNG.")
    if picture.ndim == 3:
        colours = picture[..., : 1 if picture.shape[2] <= 2 else 3]
        if (colours != colours[..., :1]).any():
            raise FormatError(
                f"Mask {path} is coloured; expected one channel: 0 and one other value."
            )
        picture = colours[..., 0]
    return np.asarray(picture)


def _checked_png_size(data: bytes, path: Path) -> tuple[int, int]:
    """(width, height), after walking all chunks: decoders fill what is cut off with black."""
    if not data.startswith(_PNG_SIGNATURE):
        raise FormatError(f"Mask {path} is not a PNG file.")
    position, kind, size = len(_PNG_SIGNATURE), b"", (0, 0)
    while kind != b"IEND":
        head = data[position : position + 8]
        length, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
        body = data[position + 4 : position + 8 + length]
        stored = data[position + 8 + length : position + 12 + length]
        if len(stored) != 4 or zlib.crc32(body) != int.from_bytes(stored, "big"):
            raise FormatError(
                f"Mask {path} is damaged or cut off at byte {position} of {len(data)}; copy it again."
            )
        if kind == b"IHDR":
            size = struct.unpack(">II", body[4:12])
        position += 12 + length
    return size
