"""What tables may hold: limits far beyond any vehicle, and words for what breaks them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from hdmap_tools.types import NDArrayFloat

MAX_MOUNT_M: Final = 100.0
"""No sensor is mounted further from the vehicle's origin."""

MAX_POSITION_M: Final = 1e7
"""A quarter of the earth's meridian: no city frame reaches further."""

MAX_RANGE_M: Final = 10_000.0
"""No lidar of a vehicle measures further."""

MAX_SPEED_M_S: Final = 150.0
"""Poses that need a faster vehicle do not belong together."""

MAX_TIME_NS: Final = 2**62
"""The year 2116; sums and differences of such times stay within int64."""

MAX_SPAN_NS: Final = 30 * 86_400 * 10**9
"""30 days: longer than a drive, and short enough for nanoseconds as float64."""

MAX_IMAGE_PX: Final = 100_000

_UNPRINTABLE: Final = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff\u2028\u2029]")
"""Control characters, lone surrogates, separators of lines and paragraphs."""

_MAX_SHOWN: Final = 60
_MAX_NAME: Final = 255
"""Longest name of a file on common file systems."""


def shown(value: object) -> str:
    """A value for a message: on one line, printable, and not long."""
    text = repr(value).encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}… ({len(text)} characters)"


def shown_names(names: Iterable[object]) -> str:
    """Names for a message, of which only the strange ones are quoted."""
    listed = [str(name) for name in names]
    texts = [name if text_problem(name) is None else shown(name) for name in listed[:20]]
    rest = f", … ({len(listed)} in all)" if len(listed) > 20 else ""
    return ", ".join(texts) + rest if texts else "none"


def text_problem(text: str, max_length: int = _MAX_NAME) -> str | None:
    """What is expected instead of a text that cannot stand in messages, paths and files."""
    if len(text) > max_length:
        return f"at most {max_length} characters, not {len(text)}"
    if found := _UNPRINTABLE.search(text):
        return f"printable text, without U+{ord(found[0]):04X}"
    return None


def name_problem(name: str) -> str | None:
    """What is expected instead of a sensor's name that cannot name a folder of its results."""
    if name in ("", ".", "..") or "/" in name or "\\" in name:
        return "a plain name, no path"
    return text_problem(name)


def numbers(value: Any, shape: tuple[int, ...]) -> NDArrayFloat | None:
    """A nested list of numbers as a float64 array of that shape; None if it is anything else.

    Numbers too large for float64 become infinite, as they do in JSON.
    """

    def is_nested(part: Any, depth: int) -> bool:
        if depth == len(shape):
            return isinstance(part, int | float) and not isinstance(part, bool)
        return (
            isinstance(part, Sequence)
            and not isinstance(part, str)
            and len(part) == shape[depth]
            and all(is_nested(item, depth + 1) for item in part)
        )

    if not is_nested(value, 0):
        return None
    try:
        return np.array(value, dtype=np.float64)
    except OverflowError:
        return np.full(shape, np.inf)
