"""The runner: chosen vectorizers over one window of the map, each kept from harming the others.

What the user named must work: a chosen plugin that cannot be loaded, or whose
requirements cannot be met, raises before anything runs. What merely happens to be
installed may fail: it loses its own elements and those that need them, and the
failure is part of the result.
"""

from __future__ import annotations

import hashlib
import logging
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import networkx as nx
import numpy as np
import shapely
from pydantic import ValidationError

from hdmap_tools import registry
from hdmap_tools.config import VectorizeConfig
from hdmap_tools.errors import ConfigError, PluginError, PluginFailedError, ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.plugin_api import API_VERSION, MapWindow, Vectorizer, VectorizerOptions
from hdmap_tools.registry import PluginEntry
from hdmap_tools.types import NDArrayAny

logger = logging.getLogger(__name__)

EDGE_TOLERANCE_CELLS: Final = 1.0
"""How far beyond the window a vertex may lie: sub-cell fits overshoot by less than a cell."""


@dataclass(frozen=True)
class PluginFailure:
    """A vectorizer that gave nothing, and why.

    Attributes:
        name, distribution, version: Which one; whose fault it is.
        message: One line.
        traceback: Of what it raised; empty where it raised nothing.
        is_skipped: It was not run, because one that it requires failed.
    """

    name: str
    distribution: str
    version: str
    message: str
    traceback: str = ""
    is_skipped: bool = False

    def describe(self) -> str:
        """One line for people: whose it is, what happened, what is missing."""
        return (
            f"vectorizer {self.name} ({self.distribution} {self.version}) gave nothing: "
            f"{self.message.rstrip('.')}. Its elements are missing."
        )


@dataclass(frozen=True)
class VectorizationResult:
    """The map that the vectorizers made, and which of them failed.

    Attributes:
        vector_map: Elements of all that worked; ``provenance["plugins"]`` names them with
            distribution, version, api_version and options.
        failures: Sorted by name.
    """

    vector_map: VectorMap
    failures: tuple[PluginFailure, ...] = ()


@dataclass(frozen=True)
class LoadedPlugin:
    """A vectorizer ready to run: its entry, its checked class, its checked options."""

    entry: PluginEntry
    vectorizer: type[Vectorizer]
    options: VectorizerOptions


def vectorize(window: MapWindow, config: VectorizeConfig | None = None) -> VectorizationResult:
    """Run vectorizers over one window of the map.

    Without names in the configuration all installed ones run. Those that a chosen one
    requires run too.

    Raises:
        ConfigError: If options are given for a vectorizer that is not installed, or an
            option is unknown or wrong; the message names plugin and field.
        PluginError: If a vectorizer named in the configuration cannot be used: unknown,
            broken, of another API version, or with requirements that are missing or
            go round in a circle.
    """
    config = config or VectorizeConfig()
    plugins, failures = choose(config)
    return run(window, plugins, seed=config.seed, failures=failures)


def choose(config: VectorizeConfig) -> tuple[tuple[LoadedPlugin, ...], tuple[PluginFailure, ...]]:
    """Load the configured vectorizers and what they require, in the order in which to run.

    Returns:
        Those that can run, and those that cannot although nobody asked for them by name.

    Raises:
        ConfigError, PluginError: As `vectorize`.
    """
    installed = sorted({entry.name for entry in registry.discover()})
    for section in config.options:
        if section not in installed:
            raise ConfigError(
                f"vectorize.options.{section}: {registry.unknown(section, installed)}"
            )
    is_strict = bool(config.vectorizers)
    failures: dict[str, PluginFailure] = {}
    classes: dict[str, type[Vectorizer]] = {}
    queue = list(config.vectorizers) or list(installed)
    while queue:
        name = queue.pop(0)
        if name in classes or name in failures:
            continue
        try:
            classes[name] = registry.load(name)
        except PluginError as error:
            if is_strict:
                raise
            failures[name] = _failure(name, error)
            continue
        for required in classes[name].requires:
            if required in installed:
                queue.append(required)
                continue
            missing = PluginError(
                f"Vectorizer {name!r} requires {required!r}: "
                f"{registry.unknown(required, installed)}"
            )
            if is_strict:
                raise missing
            failures[name] = _failure(name, missing)
    classes = {name: cls for name, cls in classes.items() if name not in failures}
    for cycle in _cycles(classes):
        circle = PluginError(
            f"Vectorizers require one another in a circle: {' requires '.join([*cycle, cycle[0]])}; "
            "none of them can run first."
        )
        if is_strict:
            raise circle
        for name in cycle:
            failures[name] = _failure(name, circle)
            del classes[name]
    plugins = []
    for name in _order(classes):
        try:
            options = check_options(name, classes[name].Options, config.options.get(name, {}))
        except PluginError as error:
            if is_strict:
                raise
            failures[name] = _failure(name, error)
            continue
        plugins.append(LoadedPlugin(registry.entry_of(name), classes[name], options))
    return tuple(plugins), tuple(failures.values())


def check_options(
    name: str, model: type[VectorizerOptions], given: Mapping[str, Any]
) -> VectorizerOptions:
    """Options of one vectorizer as its own model.

    Raises:
        ConfigError: Naming the plugin, each wrong field, what was found and what is known.
        PluginFailedError: If a check that the plugin's author wrote raises something else.
    """
    try:
        return model.model_validate(dict(given))
    except ValidationError as error:
        known = ", ".join(model.model_fields) or "none"
        problems = []
        for problem in error.errors():
            where = ".".join(["vectorize", "options", name, *(str(p) for p in problem["loc"])])
            what = (
                f"no such option; {name} has: {known}"
                if problem["type"] == "extra_forbidden"
                else f"{problem['msg']} (found {problem['input']!r})"
            )
            problems.append(f"{where}: {what}")
        raise ConfigError("; ".join(problems) + ".") from error
    except Exception as error:
        raise PluginFailedError(
            f"Vectorizer {name!r} failed while it checked its options: {_summary(error)}"
        ) from error


@dataclass(frozen=True)
class PluginRuns:
    """What vectorizers made of one window.

    Attributes:
        elements: By vectorizer, in the order in which they ran; each with an id.
        returned: The same, with the ids that the vectorizers themselves gave, if any.
        records: What the provenance says of each that worked.
        failures: Sorted by name.
    """

    elements: dict[str, tuple[MapElement, ...]]
    returned: dict[str, tuple[MapElement, ...]]
    records: tuple[dict[str, Any], ...]
    failures: tuple[PluginFailure, ...]


def run(
    window: MapWindow,
    plugins: Sequence[LoadedPlugin],
    *,
    seed: int = 0,
    failures: Sequence[PluginFailure] = (),
) -> VectorizationResult:
    """Run loaded vectorizers, required ones first, and gather what they make.

    Args:
        window: The map.
        plugins: In an order in which the required ones come first, as `choose` gives.
        seed: Each vectorizer's generator follows from this and its name alone, so it
            does not matter which others run.
        failures: What failed before; dependants of these are skipped.
    """
    runs = run_plugins(window, plugins, seed=seed, failures=failures)
    return result_of(runs, window.frame, seed)


def result_of(
    runs: PluginRuns, frame: MapFrame, seed: int, more: Mapping[str, Any] | None = None
) -> VectorizationResult:
    """The map of what vectorizers made.

    Args:
        runs: Of all vectorizers.
        frame: Of the elements.
        seed: That they ran with.
        more: Of the provenance.
    """
    provenance = {
        "plugin_api": API_VERSION,
        "seed": seed,
        "plugins": sorted(runs.records, key=lambda record: str(record["name"])),
        "failed": [{"name": failure.name, "message": failure.message} for failure in runs.failures],
    } | dict(more or {})
    elements = tuple(element for part in runs.elements.values() for element in part)
    return VectorizationResult(VectorMap(frame, elements, provenance), runs.failures)


def run_plugins(
    window: MapWindow,
    plugins: Sequence[LoadedPlugin],
    *,
    seed: int = 0,
    failures: Sequence[PluginFailure] = (),
    before: Mapping[str, tuple[MapElement, ...]] | None = None,
) -> PluginRuns:
    """Run loaded vectorizers, required ones first.

    Args:
        window: The map.
        plugins: In an order in which the required ones come first, as `choose` gives.
        seed: See `run`.
        failures: What failed before; dependants of these are skipped.
        before: Elements that were made before, by vectorizer.
    """
    _check_window(window)
    window = read_only(window)
    failed = {failure.name: failure for failure in failures}
    made = dict(before or {})
    returned: dict[str, tuple[MapElement, ...]] = {}
    ran: list[dict[str, Any]] = []
    taken = {element.id for elements in made.values() for element in elements}
    for plugin in plugins:
        name = plugin.entry.name
        lost = [required for required in plugin.vectorizer.requires if required not in made]
        if lost:
            reason = f"Skipped: it requires {', '.join(lost)}, which failed."
            failed[name] = _failure_of(plugin.entry, reason, is_skipped=True)
            logger.warning("Vectorizer %s: %s", name, reason)
            continue
        # Only what is declared, so that an undeclared need shows at once.
        upstream = VectorMap(
            window.frame,
            tuple(e for required in plugin.vectorizer.requires for e in made[required]),
        )
        started_s = time.perf_counter()
        try:
            record = _record(plugin)
            signed = _signed(run_one(plugin, window, upstream, seed=seed), plugin.entry, taken)
            made[name], returned[name] = with_stable_ids(signed, taken=taken), signed
        # KeyboardInterrupt passes; sys.exit() in a plugin must not end the run.
        except (Exception, SystemExit) as error:
            reason = str(error) if isinstance(error, PluginFailedError) else _summary(error)
            failed[name] = _failure_of(plugin.entry, reason, traceback.format_exc())
            logger.error("Vectorizer %s failed: %s", plugin.entry.describe(), reason)
            logger.debug("%s", failed[name].traceback)
            continue
        taken.update(element.id for element in made[name])
        ran.append(record)
        logger.info(
            "Vectorizer %s: %d elements in %.2f s",
            name,
            len(made[name]),
            time.perf_counter() - started_s,
        )
    return PluginRuns(made, returned, tuple(ran), tuple(failed[name] for name in sorted(failed)))


def run_one(
    plugin: LoadedPlugin, window: MapWindow, upstream: VectorMap, *, seed: int
) -> list[MapElement]:
    """Run one vectorizer over a window that it cannot change, and check what comes back.

    Raises:
        PluginFailedError: If it returns what the contract forbids.
        Exception: Whatever it raises.
    """
    if 0 in window.grid.shape:
        return []
    returned = plugin.vectorizer().vectorize(
        read_only(window), upstream, plugin.options, rng=generator(seed, plugin.entry.name)
    )
    return check_elements(returned, plugin.vectorizer, window.grid)


def generator(seed: int, name: str) -> np.random.Generator:
    """The generator of one vectorizer; follows from seed and name, not from the order of running."""
    digest = hashlib.sha256(f"{seed}:{name}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest, "big"))


def read_only(window: MapWindow) -> MapWindow:
    """The same window for one plugin's hands: a dataset of its own, over arrays it cannot unlock."""
    dataset = window.dataset.copy(deep=False)
    for name, variable in window.dataset.variables.items():
        if name in dataset.indexes:
            # pandas hands out the array inside its index: each plugin has a copy.
            dataset = dataset.assign_coords({name: np.array(variable.values)})
        else:
            dataset[name] = (variable.dims, _sealed(np.asarray(variable.data)))
    return MapWindow(dataset, window.grid)


def _sealed(array: NDArrayAny) -> NDArrayAny:
    root: Any = array
    while isinstance(root, np.ndarray):
        root = root.base
    if isinstance(root, bytes):
        return array
    # A flag could be turned back, on the array or on what it is a view of; bytes never change.
    return np.frombuffer(array.tobytes(), dtype=array.dtype).reshape(array.shape)


def check_elements(
    returned: object, vectorizer: type[Vectorizer], grid: BevGrid
) -> list[MapElement]:
    """Check what a vectorizer returned: a list of declared, valid elements inside the window.

    Raises:
        PluginFailedError: Naming the first element that is not, and what is wrong with it.
    """
    if not isinstance(returned, list):
        raise PluginFailedError(
            f"vectorize returned {type(returned).__name__}; expected a list of map elements."
        )
    x0, y0, x1, y1 = grid.bounds_m
    margin = EDGE_TOLERANCE_CELLS * grid.resolution_m
    for index, element in enumerate(returned):
        if type(element) not in vectorizer.element_types:
            declared = ", ".join(kind.__name__ for kind in vectorizer.element_types)
            raise PluginFailedError(
                f"Element {index} is a {type(element).__name__}; element_types declares {declared}."
            )
        try:
            # Anew from its fields: model_copy and model_construct skip the checks.
            type(element).model_validate(dict(element))
        except (ValidationError, AttributeError) as error:
            raise PluginFailedError(
                f"Element {index} ({element.element_type}) is not valid: {_first_problem(error)}."
            ) from error
        ex0, ey0, ex1, ey1 = shapely.bounds(element.geometry)
        if ex0 < x0 - margin or ey0 < y0 - margin or ex1 > x1 + margin or ey1 > y1 + margin:
            raise PluginFailedError(
                f"Element {index} ({element.element_type}) reaches x {ex0:.2f}..{ex1:.2f}, "
                f"y {ey0:.2f}..{ey1:.2f} m; the window is x {x0:.2f}..{x1:.2f}, "
                f"y {y0:.2f}..{y1:.2f} m: clip to window.grid.bounds_m."
            )
    given = [element.id for element in returned if element.id]
    if len(set(given)) != len(given):
        repeated = sorted({i for i in given if given.count(i) > 1})[:3]
        raise PluginFailedError(f"Ids {repeated} stand on several elements; leave id empty.")
    return returned


def _signed(
    returned: Sequence[MapElement], entry: PluginEntry, taken: set[str]
) -> tuple[MapElement, ...]:
    clash = sorted(element.id for element in returned if element.id in taken)[:3]
    if clash:
        raise PluginFailedError(
            f"Ids {clash} belong to elements of another vectorizer; leave id empty."
        )
    return tuple(
        element.model_copy(update={"plugin": entry.name, "plugin_version": entry.version})
        for element in returned
    )


def _record(plugin: LoadedPlugin) -> dict[str, Any]:
    return {
        "name": plugin.entry.name,
        "distribution": plugin.entry.distribution,
        "version": plugin.entry.version,
        "api_version": plugin.vectorizer.api_version,
        "options": plugin.options.model_dump(mode="json"),
    }


def _check_window(window: MapWindow) -> None:
    shape = window.dataset["posterior"].shape[1:]
    if shape != window.grid.shape:
        raise ShapeError(
            f"The window's posterior has {shape} cells (y, x), its grid {window.grid.shape}; "
            "build both from one grid."
        )


def _order(classes: Mapping[str, type[Vectorizer]]) -> list[str]:
    return list(nx.lexicographical_topological_sort(_graph(classes)))


def _cycles(classes: Mapping[str, type[Vectorizer]]) -> list[list[str]]:
    graph = _graph(classes).reverse()
    cycles = []
    for component in sorted(sorted(part) for part in nx.strongly_connected_components(graph)):
        if len(component) > 1 or graph.has_edge(component[0], component[0]):
            inside = graph.subgraph(component)
            edges = nx.find_cycle(inside, source=component[0])
            around = [source for source, _ in edges]
            # The rest of the knot cannot run either, but the shown circle stays a true one.
            cycles.append(around)
            rest = {n: classes[n] for n in component if n not in around}
            cycles.extend(_cycles(rest))
    return cycles


def _graph(classes: Mapping[str, type[Vectorizer]]) -> nx.DiGraph:
    graph = nx.DiGraph()
    graph.add_nodes_from(classes)
    for name, vectorizer in classes.items():
        graph.add_edges_from((r, name) for r in vectorizer.requires if r in classes)
    return graph


def _failure(name: str, error: PluginError) -> PluginFailure:
    entries = [entry for entry in registry.discover() if entry.name == name]
    return PluginFailure(
        name,
        " and ".join(entry.distribution for entry in entries),
        " and ".join(entry.version for entry in entries),
        str(error),
        "".join(traceback.format_exception(error)) if error.__cause__ else "",
    )


def _failure_of(
    entry: PluginEntry, message: str, trace: str = "", *, is_skipped: bool = False
) -> PluginFailure:
    return PluginFailure(
        entry.name, entry.distribution, entry.version, message, trace, is_skipped=is_skipped
    )


def _summary(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _first_problem(error: ValidationError | AttributeError) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    problem = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"])
    return f"{where}: {problem['msg']}" if where else str(problem["msg"])
