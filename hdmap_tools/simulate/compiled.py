"""numba's compiler, typed; imported only by modules of kernels, which are imported lazily."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

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


def compiled_inline(function: F) -> F:
    """The same, written out where it is called.

    An array handed to a compiled function is counted on the way in and out, atomically;
    called for every pixel on two cores, that takes longer than the work.
    """
    result: F = numba.njit(
        cache=True, nogil=True, error_model="numpy", fastmath=_FAST, inline="always"
    )(function)
    return result


def in_bands(kernel: Callable[[int, int], None], count: int) -> None:
    """Call ``kernel(first, past_last)`` for bands of rows, on all cores.

    Plain threads instead of numba's own: those abort the process when two threads of
    the caller meet in them. What a band writes may not depend on how bands are cut.
    """
    workers = os.cpu_count() or 1
    # More bands than workers: some rows (sky) are cheaper than others.
    edges = [count * k // (4 * workers) for k in range(4 * workers + 1)]
    list(_pool().map(kernel, edges[:-1], edges[1:]))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="simulate")


# The threads of a pool are not there in a forked process; it makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
