"""A build on the workers of a Dask cluster: of this machine or of many.

Segments of the drive are the tasks. Their counts stay on the workers that made them; those of
one tile are then added up and written by one worker, in a fork of the map's session, and this
process commits. Counts are integers: the map is that of an undivided build, whoever did what,
and however often a task had to be done again because its worker died.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from hdmap_tools.distributed.cluster import deaths_explained, listening, queue_length, teller
from hdmap_tools.distributed.count_segment import (
    SeenCells,
    SegmentCounts,
    SegmentTask,
    count_segment,
)
from hdmap_tools.frame_source import FrameCounts
from hdmap_tools.fusion.cell_counts import TileIndex
from hdmap_tools.fusion.map_store import add_to_tile
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.segmentation.cache import SegmentProgress

if TYPE_CHECKING:
    from distributed import Client, Future

_AT_ONCE: Final = 10
"""Priority of what is short and waited for, before segments."""


def add_segments(
    client: Client,
    task: SegmentTask,
    drive_id: str,
    semantic_map: SemanticMap,
    numbers: list[int],
    counts: FrameCounts,
    segmented: SegmentProgress | None = None,
) -> None:
    """Count segments on the workers and add them to a map, a commit for those that are ready together.

    Args:
        client: Of the cluster.
        task: How the drive is mapped.
        drive_id: The drive.
        semantic_map: Changed.
        numbers: Of the segments.
        counts: Told what went in.
        segmented: Told of images done, of all workers together.

    Raises:
        ClusterError: If workers died again and again.
        HDMapError: Whatever a worker raised.
    """
    from distributed import wait

    heard = count(counts.used + 1)

    def hear() -> None:
        if segmented is not None:
            segmented(next(heard), task.num_images)

    waiting, counting = list(numbers), set[Any]()
    kept = "What was committed is kept, and the same command goes on from there."
    with deaths_explained(kept), listening(client, hear) as name:
        ready: list[Any] = []
        while waiting or counting or ready:
            room = queue_length(client)
            while waiting and len(counting) < room:
                counting.add(client.submit(_count, task, waiting.pop(0), name, pure=False))
            if not ready:
                wait(counting, return_when="FIRST_COMPLETED")
                ready = [future for future in counting if future.done()]
                counting.difference_update(ready)
                continue  # the workers' queues are filled before they are asked to write
            asked = [client.submit(_outline, future, priority=_AT_ONCE) for future in ready]
            outlines = client.gather(asked)
            _write(client, semantic_map, drive_id, ready, outlines)
            ready = []
            for outline in outlines:
                counts.used += outline.num_frames
                counts.observations.update(outline.observations)


@dataclass(frozen=True)
class _Outline:
    number: int
    num_frames: int
    observations: dict[str, int]
    tiles: tuple[TileIndex, ...]


def _count(task: SegmentTask, number: int, name: str) -> SegmentCounts:
    return count_segment(task, number, teller(name))


def _outline(counts: SegmentCounts) -> _Outline:
    return _Outline(counts.number, counts.num_frames, counts.observations, tuple(counts.tiles))


def _write(
    client: Client,
    semantic_map: SemanticMap,
    drive_id: str,
    ready: list[Future],
    outlines: list[_Outline],
) -> None:
    """Add up the tiles of finished segments, each on one worker, and commit."""
    holders: dict[TileIndex, list[Future]] = {}
    for future, outline in zip(ready, outlines, strict=True):
        for index in outline.tiles:
            holders.setdefault(index, []).append(future)

    def write(fork: Any) -> list[Any]:
        submit = partial(client.submit, priority=_AT_ONCE)
        tasks = [
            submit(_add_tile, fork, index, *[submit(_seen_cells, part, index) for part in parts])
            for index, parts in sorted(holders.items())
        ]
        return list(client.gather(tasks))

    semantic_map.add_by_workers(
        write,
        drive_id,
        num_frames=sum(outline.num_frames for outline in outlines),
        segments=sorted(outline.number for outline in outlines),
    )


def _seen_cells(counts: SegmentCounts, index: TileIndex) -> SeenCells:
    return counts.tiles[index]


def _add_tile(fork: Any, index: TileIndex, *parts: SeenCells) -> Any:
    add_to_tile(fork, index, (part.tile() for part in parts))
    return fork
