"""Columns of Arrow tables as numpy arrays, without pandas.

Arrow's own `to_numpy` imports pandas wherever it is installed, which takes half a second of
each command's start.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hdmap_tools.types import NDArrayAny


def values_of(column: Any) -> NDArrayAny:
    """Values (N,) of a `pyarrow.ChunkedArray`; missing ones become NaN, whole numbers then float64."""
    import pyarrow as pa

    if column.null_count == 0:
        chunks = [chunk for chunk in column.chunks if len(chunk)] or [pa.nulls(0, column.type)]
        if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
            return _joined([np.from_dlpack(chunk) for chunk in chunks])
        if pa.types.is_boolean(column.type):
            return _joined([_bits_of(chunk) for chunk in chunks])
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            return np.array(column.to_pylist(), dtype=object)
    return np.asarray(column.to_numpy())


def _bits_of(chunk: Any) -> NDArrayAny:
    packed = np.frombuffer(chunk.buffers()[1], dtype=np.uint8)
    bits = np.unpackbits(packed, count=chunk.offset + len(chunk), bitorder="little")
    return bits[chunk.offset :].astype(bool)


def _joined(parts: list[NDArrayAny]) -> NDArrayAny:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
