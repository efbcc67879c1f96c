"""Vectorizing a whole map: in one piece if it is small, else window by window.

Each window is read, vectorized and let go, so that memory does not grow with the map; what it
hands over (`pieces`) is put together at the end, in the order of the windows, whoever made
which of them and when.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hdmap_tools.ahead import made_ahead
from hdmap_tools.config import VectorizeConfig
from hdmap_tools.fusion.map_location import MapLocation
from hdmap_tools.fusion.observation_model import ObservationModel
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.map_model.vector_map import with_stable_ids
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayFloat
from hdmap_tools.vectorization import (
    LoadedPlugin,
    PluginFailure,
    PluginRuns,
    VectorizationResult,
    choose,
    read_only,
    result_of,
    run,
    run_plugins,
)
from hdmap_tools.windowed.join_areas import join_areas
from hdmap_tools.windowed.join_lines import join_lines
from hdmap_tools.windowed.pieces import Piece, pieces_of
from hdmap_tools.windowed.windows import Window, margin_of, windows_of

if TYPE_CHECKING:
    from hdmap_tools.segmentation.cache import SegmentProgress

_LOG = logging.getLogger(__name__)

_NAMED: Final = (
    "An element has an id of its own ({id!r}), which would not hold across the windows of a large "
    "map; leave id empty, or declare scope = 'map'."
)


@dataclass(frozen=True)
class WindowsTask:
    """What it takes to vectorize any window of a map: small, and the same on each machine.

    Attributes:
        location: Of the map, where every worker finds it.
        version: Of the map, so that all see the same one.
        model: How it is read.
        fill_radius_cells: How far unknown cells are filled.
        config: Of the vectorizers (a JSON document).
    """

    location: MapLocation
    version: str
    model: ObservationModel
    fill_radius_cells: int
    config: str


@dataclass(frozen=True)
class WindowPieces:
    """What one window hands over.

    Attributes:
        pieces: By vectorizer, in the order in which they ran.
        records: What the provenance says of each.
        failures: Of those that failed here.
    """

    pieces: dict[str, list[Piece]]
    records: tuple[dict[str, Any], ...]
    failures: tuple[PluginFailure, ...]


Crew = Callable[[WindowsTask, Sequence[Window]], Iterable[tuple[int, WindowPieces]]]
"""Vectorizes windows, and gives each one's number and pieces, in any order."""


def vectorize_map(
    semantic_map: SemanticMap,
    model: ObservationModel,
    config: VectorizeConfig,
    *,
    fill_radius_cells: int = 0,
    whole: MapWindow | None = None,
    crew: Crew | None = None,
    told: SegmentProgress | None = None,
) -> VectorizationResult:
    """Run vectorizers over all of a map.

    Args:
        semantic_map: The map.
        model: How it is read.
        config: Which plugins run, and in windows of which size.
        fill_radius_cells: See `read_window`.
        whole: The map, if it was read in one piece already.
        crew: Who does windows of a map that has several; None: this process.
        told: After each window.

    Raises:
        ConfigError, PluginError: As `vectorization.vectorize`.
    """
    plugins, failures = choose(config)
    local, of_map = _by_scope(plugins)
    windows = windows_of(
        semantic_map.tile_indices(),
        semantic_map.meta,
        window_m=config.window_m,
        margin_m=margin_of(plugin.vectorizer for plugin in local),
        fill_cells=fill_radius_cells,
    )

    def all_of_it() -> MapWindow:
        return whole or read_window(semantic_map, _whole_grid(semantic_map, windows), model, fill_radius_cells)  # fmt: skip

    if windows[0].core is None or not local:
        return run(all_of_it(), plugins, seed=config.seed, failures=failures)
    crew = crew or partial(_in_this_process, semantic_map, local, config.seed)
    place = semantic_map.location
    task = WindowsTask(
        place.absolute() if isinstance(place, Path) else place,
        semantic_map.history()[0].id,
        model,
        fill_radius_cells,
        config.model_dump_json(),
    )
    _LOG.info("Vectorizing in %d windows.", len(windows))
    found: dict[int, WindowPieces] = {}
    for number, pieces in crew(task, windows):
        found[number] = pieces
        if told is not None:
            told(len(found), len(windows))
    runs = joined([found[k] for k in range(len(windows))], windows, local, failures)
    if of_map:
        later = run_plugins(
            all_of_it(), of_map, seed=config.seed, failures=runs.failures, before=runs.elements
        )
        runs = replace(later, records=runs.records + later.records)
    more = {"windows": {"number": len(windows), "window_m": config.window_m}}
    return result_of(runs, semantic_map.meta.frame, config.seed, more)


def vectorize_window(task: WindowsTask, window: Window) -> WindowPieces:
    """Vectorize one window; for a worker, which keeps map and plugins for the next one."""
    semantic_map, plugins, seed = _opened(task.location, task.version, task.config)
    return pieces_of_window(_read(semantic_map, task, window), window, plugins, seed)


@lru_cache(maxsize=1)
def _opened(
    location: MapLocation, version: str, document: str
) -> tuple[SemanticMap, tuple[LoadedPlugin, ...], int]:
    config = VectorizeConfig.model_validate_json(document)
    local, _ = _by_scope(choose(config)[0])
    return SemanticMap.open(location, version), local, config.seed


def _in_this_process(
    semantic_map: SemanticMap,
    plugins: Sequence[LoadedPlugin],
    seed: int,
    task: WindowsTask,
    windows: Sequence[Window],
) -> Iterator[tuple[int, WindowPieces]]:
    # The next window is read while one is vectorized.
    ahead = made_ahead(windows, lambda window: _read(semantic_map, task, window), number=2)
    for number, window in enumerate(windows):
        yield number, pieces_of_window(next(ahead), window, plugins, seed)


def _read(semantic_map: SemanticMap, task: WindowsTask, window: Window) -> MapWindow:
    # Sealed at once, so that the arrays are there only once.
    return read_only(read_window(semantic_map, window.grid, task.model, task.fill_radius_cells))


def pieces_of_window(
    read: MapWindow, window: Window, plugins: Sequence[LoadedPlugin], seed: int
) -> WindowPieces:
    """Vectorize a window that was read, and cut what was found to what it answers for."""
    runs = run_plugins(read, plugins, seed=seed)
    failures = {failure.name: failure for failure in runs.failures}
    x0, y0, x1, y1 = read.grid.bounds_m
    where = f"In the window x {x0:.1f}..{x1:.1f}, y {y0:.1f}..{y1:.1f} m: "
    pieces = {}
    for plugin in plugins:
        name = plugin.entry.name
        named = next((element for element in runs.returned.get(name, ()) if element.id), None)
        if named is not None:
            entry = plugin.entry
            failures[name] = PluginFailure(
                name, entry.distribution, entry.version, _NAMED.format(id=named.id)
            )
        elif name in runs.returned:
            pieces[name] = pieces_of(runs.returned[name], window)
    return WindowPieces(
        pieces,
        runs.records,
        tuple(
            failure if failure.is_skipped else replace(failure, message=where + failure.message)
            for failure in failures.values()
        ),
    )


def joined(
    found: Sequence[WindowPieces],
    windows: Sequence[Window],
    plugins: Sequence[LoadedPlugin],
    failures: Sequence[PluginFailure],
) -> PluginRuns:
    """All windows' pieces as elements of the map; a plugin that failed in one window lost them all.

    Args:
        found: Of each window, in their order.
        windows: These.
        plugins: That ran in them, required ones first.
        failures: What failed before.
    """
    failed = {failure.name: failure for failure in failures}
    for one in found:
        for failure in one.failures:
            # Of those that it cannot run without the cause is told, wherever it arose.
            if failure.name not in failed or (
                failed[failure.name].is_skipped and not failure.is_skipped
            ):
                failed[failure.name] = failure
    seams = _seams(windows)
    made: dict[str, tuple[MapElement, ...]] = {}
    taken: set[str] = set()
    for plugin in plugins:
        name = plugin.entry.name
        lost = [required for required in plugin.vectorizer.requires if required in failed]
        if lost and name not in failed:
            entry = plugin.entry
            reason = f"Skipped: it requires {', '.join(lost)}, which failed."
            failed[name] = PluginFailure(
                name, entry.distribution, entry.version, reason, is_skipped=True
            )
        if name in failed:
            continue
        elements: list[MapElement] = []
        for kind in plugin.vectorizer.element_types:
            of_kind = [
                [piece for piece in one.pieces[name] if type(piece.element) is kind]
                for one in found
            ]
            is_line = kind.geometry_type == "LineString"
            elements += join_lines(of_kind) if is_line else join_areas(of_kind, seams)
        made[name] = with_stable_ids(elements, taken=taken)
        taken.update(element.id for element in made[name])
    records = tuple(record for record in found[0].records if record["name"] in made)
    return PluginRuns(made, {}, records, tuple(failed[name] for name in sorted(failed)))


def _seams(windows: Sequence[Window]) -> tuple[NDArrayFloat, NDArrayFloat]:
    bounds = np.array([window.core.bounds_m for window in windows if window.core is not None])
    return np.unique(bounds[:, [0, 2]]), np.unique(bounds[:, [1, 3]])


def _whole_grid(semantic_map: SemanticMap, windows: Sequence[Window]) -> Any:
    return semantic_map.grid or windows[0].grid


def _by_scope(
    plugins: Sequence[LoadedPlugin],
) -> tuple[tuple[LoadedPlugin, ...], tuple[LoadedPlugin, ...]]:
    """Those that run in windows, and those that need the whole map or what needs it."""
    of_map: set[str] = set()
    for plugin in plugins:
        needs = of_map.intersection(plugin.vectorizer.requires)
        if plugin.vectorizer.scope == "map" or needs:
            of_map.add(plugin.entry.name)
    return (
        tuple(plugin for plugin in plugins if plugin.entry.name not in of_map),
        tuple(plugin for plugin in plugins if plugin.entry.name in of_map),
    )
