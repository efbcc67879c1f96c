"""Work done ahead of where it is needed, in threads: reading and preparing while others compute.

What is to gain is what releases the interpreter's lock: reading, decoding, compiled kernels.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

_Item = TypeVar("_Item")
_Made = TypeVar("_Made")
_END: Final = object()


def made_ahead(
    items: Iterable[_Item], make: Callable[[_Item], _Made], *, threads: int = 1, number: int = 4
) -> Iterator[_Made]:
    """What `make` gives for each item, in their order.

    Args:
        items: Taken one after the other, by whoever takes the results.
        make: Called in threads; an error is raised at its item's turn.
        threads: That many at a time.
        number: Results that wait at most.
    """
    source, pool = iter(items), ThreadPoolExecutor(threads)
    waiting: deque[Future[_Made]] = deque()
    try:
        for item in source:
            waiting.append(pool.submit(make, item))
            if len(waiting) >= number:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        _close(source)


def taken_ahead(items: Iterable[_Item], number: int = 4) -> Iterator[_Item]:
    """The items, in their order, each computed in one other thread before it is asked for.

    Args:
        items: Of any kind, a generator for example.
        number: That wait at most.
    """
    source = iter(items)
    pool = ThreadPoolExecutor(1)
    waiting: deque[Future[object]] = deque()
    try:
        for _ in range(number):
            waiting.append(pool.submit(next, source, _END))
        while (item := waiting.popleft().result()) is not _END:
            waiting.append(pool.submit(next, source, _END))
            yield item  # type: ignore[misc]
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        _close(source)


def _close(source: Iterator[object]) -> None:
    """End a generator that was left before its end, and what it holds."""
    if isinstance(source, Generator):
        source.close()
