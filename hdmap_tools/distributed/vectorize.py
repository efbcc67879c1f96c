"""A map vectorized on the workers of a Dask cluster: of this machine or of many.

Windows are the tasks. What they hand over is put together by this process in the order of the
windows, so the result is that of one process, whoever did what, and however often a window had
to be done again because its worker died.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hdmap_tools.distributed.cluster import Workers, as_they_get_done, connected, deaths_explained
from hdmap_tools.windowed.vectorize_map import WindowPieces, WindowsTask, vectorize_window
from hdmap_tools.windowed.windows import Window


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
    with connected(workers) as client, deaths_explained("Nothing was written."):
        given = ((task, number, window) for number, window in enumerate(windows))
        yield from as_they_get_done(client, _vectorize, given)


def _vectorize(task: WindowsTask, number: int, window: Window) -> tuple[int, WindowPieces]:
    return number, vectorize_window(task, window)
