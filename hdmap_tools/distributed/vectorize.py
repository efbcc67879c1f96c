"""A map vectorized on the workers of a Dask cluster: of this machine or of many.

Windows are the tasks. What they hand over is put together by this process in the order of the
windows, so the result is that of one process, whoever did what, and however often a window had
to be done again because its worker died.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from hdmap_tools.distributed.cluster import Workers, connected, deaths_explained, queue_length
from hdmap_tools.windowed.vectorize_map import WindowPieces, WindowsTask, vectorize_window
from hdmap_tools.windowed.windows import Window

if TYPE_CHECKING:
    from distributed import Client


def over_workers(
    workers: Workers, task: WindowsTask, windows: Sequence[Window]
) -> Iterator[tuple[int, WindowPieces]]:
    """Vectorize windows on workers that are started, or reached, for it.

    Args:
        workers: Which.
        task: The map and how it is vectorized.
        windows: Of the map.

    Raises:
        ClusterError: If there are none, or they died again and again on one window.
        HDMapError: Whatever a worker raised.
    """
    # Not before: a map that is one window needs none.
    with connected(workers) as client:
        yield from _over(client, task, windows)


def _over(
    client: Client, task: WindowsTask, windows: Sequence[Window]
) -> Iterator[tuple[int, WindowPieces]]:
    from distributed import wait

    waiting, doing = list(enumerate(windows)), dict[Any, int]()
    try:
        with deaths_explained("Nothing was written."):
            while waiting or doing:
                room = queue_length(client)
                while waiting and len(doing) < room:
                    number, window = waiting.pop(0)
                    doing[client.submit(vectorize_window, task, window, pure=False)] = number
                for future in wait(list(doing), return_when="FIRST_COMPLETED").done:
                    yield doing.pop(future), future.result()
    finally:
        client.cancel(list(doing))
