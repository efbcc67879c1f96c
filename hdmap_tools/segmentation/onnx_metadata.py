"""The text that an ONNX file carries about itself (``metadata_props``), without loading the model.

Only the outermost fields of the file are walked over: the graph and its weights are
skipped, so looking into a model of any size costs next to nothing, and a model need not
be runnable here to be asked what it is.

Source:
    ONNX ``onnx.proto``, message ``ModelProto`` (graph = 7, metadata_props = 14) and
    ``StringStringEntryProto`` (key = 1, value = 2); the protocol buffers encoding guide
    for varints, tags and wire types.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from hdmap_tools.errors import ConfigError

_GRAPH: Final = 7
_METADATA: Final = 14
_KEY, _VALUE = 1, 2
_BYTES: Final = 2
"""Wire type of what has a length: strings and messages."""
_FIXED_LENGTH: Final = {1: 8, 5: 4}
_MAX_TEXT_BYTES: Final = 64 << 20


class _DamagedError(Exception):
    """The file does not follow the encoding, or ends too early."""


@dataclass(frozen=True)
class _Field:
    """One field: its number, wire type, and where it and its content lie in the file."""

    number: int
    wire_type: int
    start: int
    content: int
    end: int


def read_metadata(model: Path) -> dict[str, str]:
    """The metadata of an ONNX file by key; of a key given twice the last.

    Raises:
        ConfigError: If there is no such file, or it is not an ONNX model, or not all of one.
    """
    try:
        with model.open("rb") as file:
            return dict(_entry(file, field) for field in _model_fields(file) if _is_metadata(field))
    except FileNotFoundError as error:
        raise ConfigError(f"There is no model file {model}.") from error
    except OSError as error:
        raise ConfigError(f"Model {model} cannot be read: {error.strerror or error}.") from error
    except (_DamagedError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{model} is not an ONNX model, or not all of one: {error}. Copy or export it anew."
        ) from error


def with_metadata(content: bytes, key: str, value: str, what: str = "The file") -> bytes:
    """The bytes of an ONNX model with one metadata text put in, in place of one of that key.

    Everything else stays byte for byte as it was.

    Raises:
        ConfigError: If the bytes are not an ONNX model.
    """
    file = io.BytesIO(content)
    kept = []
    try:
        for field in _model_fields(file):
            if not (_is_metadata(field) and _entry(file, field)[0] == key):
                kept.append(content[field.start : field.end])
    except (_DamagedError, UnicodeDecodeError) as error:
        raise ConfigError(f"{what} is not an ONNX model, or not all of one: {error}.") from error
    entry = _text(_KEY, key) + _text(_VALUE, value)
    return b"".join([*kept, _tag(_METADATA, _BYTES), _varint(len(entry)), entry])


def _model_fields(file: BinaryIO) -> list[_Field]:
    length = file.seek(0, io.SEEK_END)
    fields = list(_fields(file, 0, length))
    if not any(field.number == _GRAPH and field.wire_type == _BYTES for field in fields):
        raise _DamagedError(f"its {length} bytes hold no graph")
    return fields


def _is_metadata(field: _Field) -> bool:
    return field.number == _METADATA and field.wire_type == _BYTES


def _fields(file: BinaryIO, start: int, end: int) -> Iterator[_Field]:
    position = start
    while position < end:
        file.seek(position)
        tag = _read_varint(file)
        number, wire_type = tag >> 3, tag & 7
        if wire_type == _BYTES:
            length = _read_varint(file)
            content = file.tell()
        elif wire_type == 0:
            content, length = file.tell(), 0
            _read_varint(file)
            length = file.tell() - content
        elif wire_type in _FIXED_LENGTH:
            content, length = file.tell(), _FIXED_LENGTH[wire_type]
        else:
            raise _DamagedError(f"byte {position} begins no field (wire type {wire_type})")
        if content + length > end:
            raise _DamagedError(
                f"it ends at byte {end}, but its content goes on to {content + length}"
            )
        yield _Field(number, wire_type, position, content, content + length)
        position = content + length


def _entry(file: BinaryIO, field: _Field) -> tuple[str, str]:
    texts = {_KEY: "", _VALUE: ""}
    for part in _fields(file, field.content, field.end):
        if part.number in texts and part.wire_type == _BYTES:
            if part.end - part.content > _MAX_TEXT_BYTES:
                raise _DamagedError(f"its metadata hold a text of {part.end - part.content} bytes")
            file.seek(part.content)
            texts[part.number] = file.read(part.end - part.content).decode()
    return texts[_KEY], texts[_VALUE]


def _read_varint(file: BinaryIO) -> int:
    value = 0
    for shift in range(0, 70, 7):
        byte = file.read(1)
        if not byte:
            raise _DamagedError("it ends within a number")
        value |= (byte[0] & 0x7F) << shift
        if byte[0] < 0x80:
            return value
    raise _DamagedError("a number in it has no end")


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _tag(number: int, wire_type: int) -> bytes:
    return _varint(number << 3 | wire_type)


def _text(number: int, text: str) -> bytes:
    content = text.encode()
    return _tag(number, _BYTES) + _varint(len(content)) + content
