"""numba's compiler, typed; imported only by modules of kernels, which are imported lazily."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, Final, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile to machine code, kept on disk; the kernel lets other threads run."""
    result: F = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return result


_FAST = {"contract", "arcp", "nsz", "reassoc", "afn"}


def compiled_fast(function: F) -> F:
    """The same for what is only looked at: sums may be reordered; infinities still hold."""
    result: F = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)(function)
    return result


ENOUGH_RAYS: Final = 70_000
"""Rays that are worth a thread of their own. A sweep of 131,000 is done by one: two of them side by
side on two cores took a fifth less time without threads within each."""

ENOUGH_ROWS: Final = 64
"""The same for rows of an image or raster."""


def in_bands(kernel: Callable[[int, int], None], count: int, at_least: int = ENOUGH_RAYS) -> None:
    """Call ``kernel(first, past_last)`` for bands of rows, on all cores.

    Args:
        kernel: Does the rows from the first to before the last.
        count: Rows.
        at_least: Fewer than twice this are done at once by the caller.

    Plain threads instead of numba's own: those abort the process when two threads of
    the caller meet in them. What a band writes may not depend on how bands are cut.
    """
    workers = os.cpu_count() or 1
    # More bands than workers: some rows (sky) are cheaper than others.
    bands = min(4 * workers, count // at_least)
    if bands <= 1:
        kernel(0, count)
        return
    edges = [count * k // bands for k in range(bands + 1)]
    list(_pool().map(kernel, edges[:-1], edges[1:]))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="simulate")


# The threads of a pool are not there in a forked process; it makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
