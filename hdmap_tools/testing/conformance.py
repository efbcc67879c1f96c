"""What every vectorizer must keep, as checks that authors run on their own.

In a plugin's tests, with pytest::

    class TestMyCrosswalks(VectorizerConformance):
        vectorizer = MyCrosswalks

and on an installed plugin, without pytest, `check_vectorizer` (``hdmap plugins check``).
Both run the same functions; each takes a `Case` and raises `CheckFailedError`.
"""

from __future__ import annotations

import functools
import math
import random
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from hdmap_tools import registry
from hdmap_tools.errors import ConfigError, PluginError, PluginFailedError
from hdmap_tools.map_model.elements import MapElement
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.plugin_api import MapWindow, Vectorizer
from hdmap_tools.registry import PluginEntry
from hdmap_tools.testing.scenes import street_scene
from hdmap_tools.testing.transforms import copied, cropped, moved, rotated, with_layers
from hdmap_tools.vectorization import (
    LoadedPlugin,
    check_elements,
    check_options,
    choose,
    generator,
    read_only,
    run,
)

MOVE_TOLERANCE_M: Final = 1e-3
"""Sub-cell arithmetic in float32 far from the origin may lose this much, not more."""


@functools.cache
def _street() -> MapWindow:
    return read_only(street_scene(stop_line=True))


def default_scene() -> MapWindow:
    """`street_scene` with a stop line; drawn once, handed out with a dataset of its own each time."""
    return read_only(_street())


class CheckFailedError(AssertionError):
    """A vectorizer does not keep what the contract promises."""


@dataclass(frozen=True, eq=False)
class Case:
    """A vectorizer with what it is tried on.

    Attributes:
        vectorizer: The class.
        options: Its options as in hdmap.yaml.
        scene: A window that holds what it looks for.
        rotation_tolerance_m: How far a result may move when the scene is turned by 90
            degrees and back; None is one cell.
    """

    vectorizer: type[Vectorizer]
    options: Mapping[str, Any] = field(default_factory=dict)
    scene: MapWindow = field(default_factory=default_scene)
    rotation_tolerance_m: float | None = None

    @property
    def plugin(self) -> LoadedPlugin:
        """The vectorizer as the runner takes it."""
        name = self.vectorizer.name
        entry = PluginEntry(name, "under-test", "0", self.vectorizer.__qualname__)
        return LoadedPlugin(
            entry, self.vectorizer, check_options(name, self.vectorizer.Options, self.options)
        )

    def upstream(self, window: MapWindow) -> VectorMap:
        """Elements of the required vectorizers in that window; those not installed give none."""
        installed = {entry.name for entry in registry.discover()}
        required = tuple(name for name in self.vectorizer.requires if name in installed)
        if not required:
            return VectorMap(window.frame)
        from hdmap_tools.config import VectorizeConfig

        plugins, _ = choose(VectorizeConfig(vectorizers=required))
        made = run(window, plugins).vector_map
        return VectorMap(window.frame, tuple(e for e in made if e.plugin in required))

    def run(
        self,
        window: MapWindow,
        *,
        instance: Vectorizer | None = None,
        upstream: VectorMap | None = None,
    ) -> list[MapElement]:
        """What the vectorizer returns there, checked as the runner checks it."""
        plugin = self.plugin
        returned = (instance or self.vectorizer()).vectorize(
            window,
            self.upstream(window) if upstream is None else upstream,
            plugin.options,
            rng=generator(0, plugin.entry.name),
        )
        try:
            return check_elements(returned, self.vectorizer, window.grid)
        except PluginFailedError as error:
            raise CheckFailedError(str(error)) from error


def check_contract(case: Case) -> None:
    """The class has the attributes, options and method that the contract asks for."""
    name = getattr(case.vectorizer, "name", "")
    try:
        registry.check_class(case.vectorizer, PluginEntry(name, "under-test", "0", ""))
    except PluginError as error:
        raise CheckFailedError(str(error)) from error


def check_name_equals_entry_point(case: Case) -> None:
    """The class is registered, under its own name."""
    name = case.vectorizer.name
    try:
        loaded = registry.load(name)
    except PluginError as error:
        raise CheckFailedError(
            f"{error} (Register the class in pyproject.toml and install the distribution.)"
        ) from error
    if loaded is not case.vectorizer:
        raise CheckFailedError(
            f"Entry point {name!r} names {loaded.__module__}.{loaded.__qualname__}, not "
            f"{case.vectorizer.__module__}.{case.vectorizer.__qualname__}."
        )


def check_finds_something(case: Case) -> None:
    """The scene gives elements; without any, the other checks would show nothing."""
    if not case.run(case.scene):
        raise CheckFailedError(
            "The scene gave no element; give a scene that holds what the vectorizer looks for."
        )


def check_input_unchanged(case: Case) -> None:
    """Window and upstream are the same afterwards, byte for byte."""
    # Not the runner's sealed copy: here a plugin can unlock the arrays, and is caught.
    window = copied(case.scene)
    upstream = case.upstream(window)
    before = _fingerprint(window)
    elements_before = _contents(list(upstream))
    case.run(window, upstream=upstream)
    after = _fingerprint(window)
    changed = sorted(n for n in before.keys() | after.keys() if before.get(n) != after.get(n))
    if changed:
        raise CheckFailedError(f"vectorize changed {', '.join(changed)} of its window.")
    if _contents(list(upstream)) != elements_before:
        raise CheckFailedError("vectorize changed the elements of upstream.")


def check_works_on_sealed_window(case: Case) -> None:
    """It runs on the runner's window, whose arrays cannot be written."""
    try:
        case.run(read_only(case.scene))
    except ValueError as error:
        if "read-only" in str(error) or "WRITEABLE" in str(error):
            raise CheckFailedError(
                f"vectorize writes into its window ({error}); work on a copy."
            ) from error
        raise


def check_repeatable(case: Case) -> None:
    """The same input gives the same bytes: again, after another scene, in a new instance."""
    instance = case.vectorizer()
    first = _contents(case.run(case.scene, instance=instance))
    # Global generators move on in between; only the one handed in may be used.
    np.random.random()
    random.random()
    second = _contents(case.run(case.scene, instance=instance))
    if first != second:
        raise CheckFailedError(
            "A second run on the same window gave another result; use no randomness but rng, "
            "and keep no state."
        )
    case.run(moved(case.scene, 50, 50), instance=instance)
    if first != _contents(case.run(case.scene, instance=instance)):
        raise CheckFailedError("A run on another window changed the next result; keep no state.")
    if first != _contents(case.run(case.scene)):
        raise CheckFailedError("A new instance gave another result; keep no state.")


def check_empty_in_empty_out(case: Case) -> None:
    """A window without evidence gives nothing."""
    unknown = with_layers(
        case.scene,
        posterior=np.full_like(case.scene.dataset["posterior"].values, np.nan),
        entropy=np.full(case.scene.grid.shape, np.nan, dtype=np.float32),
        observations=np.zeros(case.scene.grid.shape, dtype=np.float32),
        intensity=np.full(case.scene.grid.shape, np.nan, dtype=np.float32),
        height=np.full(case.scene.grid.shape, np.nan, dtype=np.float32),
    )
    made = case.run(unknown, upstream=VectorMap(unknown.frame))
    if made:
        raise CheckFailedError(f"A window of unknown cells gave {len(made)} elements.")


def check_valid_inside_grid(case: Case) -> None:
    """Geometry is valid, declared and inside the grid, also where the window cuts things."""
    case.run(case.scene)
    for part in _parts(case.scene):
        case.run(part)


def check_tiny_windows(case: Case) -> None:
    """Windows of one cell, one row and one column do not make it raise."""
    rows, cols = case.scene.grid.shape
    row, col = rows // 2, cols // 2
    for y, x in (
        (slice(row, row + 1), slice(col, col + 1)),
        (slice(row, row + 1), slice(0, cols)),
        (slice(0, rows), slice(col, col + 1)),
    ):
        case.run(cropped(case.scene, y, x))


def check_missing_layers(case: Case) -> None:
    """Without intensity and heights (a map made from cameras alone) it does not raise."""
    nothing = np.full(case.scene.grid.shape, np.nan, dtype=np.float32)
    case.run(with_layers(case.scene, intensity=nothing, height=nothing))


def check_moves_with_grid(case: Case) -> None:
    """Moving the grid by 10 m, and by kilometres, moves the result by as much."""
    original = case.run(case.scene)
    x0, y0, x1, y1 = case.scene.grid.bounds_m
    # The second runs the axes through the scene: truncated cells fold there.
    onto_axes = (-(x0 + x1) / 2, -(y0 + y1) / 2)
    for east_m, north_m in ((10.0, 0.0), onto_axes, (-5000.0, 3000.0)):
        cells_east, cells_north = _cells(case.scene, east_m), _cells(case.scene, north_m)
        window = moved(case.scene, cells_east, cells_north)
        east_m = cells_east * window.grid.resolution_m
        north_m = cells_north * window.grid.resolution_m
        expected = [(e, affinity.translate(e.geometry, east_m, north_m)) for e in original]
        _require_same(expected, case.run(window), f"Moving the grid by ({east_m:g}, {north_m:g}) m")


def check_rises_with_ground(case: Case) -> None:
    """Raising the ground by 100 m raises the result by 100 m."""
    height = np.asarray(case.scene.dataset["height"].values)
    raised = case.run(with_layers(case.scene, height=height + np.float32(100.0)))
    expected = [(e, affinity.translate(e.geometry, 0.0, 0.0, 100.0)) for e in case.run(case.scene)]
    _require_same(expected, raised, "Raising the ground by 100 m")


def check_options_refuse_unknown(case: Case) -> None:
    """An option that does not exist is refused by name."""
    unknown = "no_such_option"
    try:
        check_options(case.vectorizer.name, case.vectorizer.Options, {**case.options, unknown: 1})
    except ConfigError as error:
        if unknown in str(error):
            return
        raise CheckFailedError(f"The refusal does not name {unknown!r}: {error}") from error
    raise CheckFailedError(f"Options took {unknown!r}; derive them from VectorizerOptions.")


def check_upstream_empty(case: Case) -> None:
    """It does not raise when the vectorizers that it requires found nothing."""
    case.run(case.scene, upstream=VectorMap(case.scene.frame))


def check_rotates_with_scene(case: Case) -> None:
    """Turning the scene by 90 degrees turns the result, to a tolerance."""
    tolerance_m = case.rotation_tolerance_m
    if tolerance_m is None:
        tolerance_m = case.scene.grid.resolution_m
    straight, turned = case.run(case.scene), case.run(rotated(case.scene))
    for kind in case.vectorizer.element_types:
        expected = _outlines(
            affinity.rotate(e.geometry, 90.0, origin=(0.0, 0.0))
            for e in straight
            if type(e) is kind
        )
        found = _outlines(e.geometry for e in turned if type(e) is kind)
        stray_m = max(
            expected.difference(found.buffer(tolerance_m)).length,
            found.difference(expected.buffer(tolerance_m)).length,
        )
        if stray_m > 0.02 * max(expected.length, found.length):
            raise CheckFailedError(
                f"Turning the scene by 90 degrees moved {stray_m:.2f} m of "
                f"{expected.length:.2f} m of {kind.__name__} by more than {tolerance_m:g} m."
            )


Check = Callable[[Case], None]

REQUIRED_CHECKS: Final[tuple[Check, ...]] = (
    check_contract,
    check_name_equals_entry_point,
    check_options_refuse_unknown,
    check_empty_in_empty_out,
    check_upstream_empty,
    check_works_on_sealed_window,
    check_input_unchanged,
    check_repeatable,
    check_valid_inside_grid,
    check_tiny_windows,
    check_missing_layers,
    check_moves_with_grid,
    check_rises_with_ground,
)
"""What every vectorizer must pass."""

ADVISORY_CHECKS: Final[tuple[Check, ...]] = (check_finds_something, check_rotates_with_scene)
"""What may have a good reason: our scene lacks what a vectorizer looks for, or it has
a direction of its own."""


@dataclass(frozen=True)
class CheckResult:
    """How one check went.

    Attributes:
        name: For example ``repeatable``.
        meaning: What it checks, one sentence.
        passed: Whether the vectorizer keeps it.
        is_required: A failed check that is not required is a remark.
        message: Why it failed, one line; empty if it passed.
        traceback: If the vectorizer raised something of its own.
    """

    name: str
    meaning: str
    passed: bool
    is_required: bool = True
    message: str = ""
    traceback: str = ""


def check_vectorizer(
    name: str, *, options: Mapping[str, Any] | None = None, scene: MapWindow | None = None
) -> list[CheckResult]:
    """Run all checks on an installed vectorizer.

    Args:
        name: As users choose it.
        options: As in hdmap.yaml; the defaults if None.
        scene: What it is tried on; `street_scene` with a stop line if None.

    Raises:
        PluginError: If it is unknown or cannot be loaded.
        ConfigError: If the options are wrong.
    """
    case = Case(registry.load(name), options or {})
    if scene is not None:
        case = replace(case, scene=scene)
    check_options(name, case.vectorizer.Options, case.options)
    required = [_run_check(check, case, is_required=True) for check in REQUIRED_CHECKS]
    return required + [_run_check(check, case, is_required=False) for check in ADVISORY_CHECKS]


def _run_check(check: Check, case: Case, *, is_required: bool) -> CheckResult:
    name = check.__name__.removeprefix("check_")
    meaning = (check.__doc__ or "").strip()
    try:
        check(case)
    except CheckFailedError as error:
        return CheckResult(name, meaning, False, is_required, str(error))
    except (Exception, SystemExit) as error:
        message = " ".join(f"It raised {type(error).__name__}: {error}".split())
        return CheckResult(name, meaning, False, is_required, message, traceback.format_exc())
    return CheckResult(name, meaning, True, is_required)


class VectorizerConformance:
    """Derive a test class from this, name your vectorizer, and pytest runs every check.

    Attributes:
        vectorizer: The class under test.
        options: Its options as in hdmap.yaml.
        rotation_tolerance_m: As in `Case`.
        turns_with_scene: Set to False for a vectorizer with a direction of its own.
    """

    vectorizer: ClassVar[type[Vectorizer]]
    options: ClassVar[Mapping[str, Any]] = {}
    rotation_tolerance_m: ClassVar[float | None] = None
    turns_with_scene: ClassVar[bool] = True

    def scene(self) -> MapWindow:
        """A window that holds what the vectorizer looks for; override it where ours does not."""
        return default_scene()

    def case(self) -> Case:
        """The vectorizer with what it is tried on."""
        return Case(self.vectorizer, self.options, self.scene(), self.rotation_tolerance_m)

    def test_contract(self) -> None:
        """See `check_contract`."""
        check_contract(self.case())

    def test_name_equals_entry_point(self) -> None:
        """See `check_name_equals_entry_point`."""
        check_name_equals_entry_point(self.case())

    def test_options_refuse_unknown(self) -> None:
        """See `check_options_refuse_unknown`."""
        check_options_refuse_unknown(self.case())

    def test_finds_something(self) -> None:
        """See `check_finds_something`."""
        check_finds_something(self.case())

    def test_empty_in_empty_out(self) -> None:
        """See `check_empty_in_empty_out`."""
        check_empty_in_empty_out(self.case())

    def test_upstream_empty(self) -> None:
        """See `check_upstream_empty`."""
        check_upstream_empty(self.case())

    def test_works_on_sealed_window(self) -> None:
        """See `check_works_on_sealed_window`."""
        check_works_on_sealed_window(self.case())

    def test_input_unchanged(self) -> None:
        """See `check_input_unchanged`."""
        check_input_unchanged(self.case())

    def test_repeatable(self) -> None:
        """See `check_repeatable`."""
        check_repeatable(self.case())

    def test_valid_inside_grid(self) -> None:
        """See `check_valid_inside_grid`."""
        check_valid_inside_grid(self.case())

    def test_tiny_windows(self) -> None:
        """See `check_tiny_windows`."""
        check_tiny_windows(self.case())

    def test_missing_layers(self) -> None:
        """See `check_missing_layers`."""
        check_missing_layers(self.case())

    def test_moves_with_grid(self) -> None:
        """See `check_moves_with_grid`."""
        check_moves_with_grid(self.case())

    def test_rises_with_ground(self) -> None:
        """See `check_rises_with_ground`."""
        check_rises_with_ground(self.case())

    def test_rotates_with_scene(self) -> None:
        """See `check_rotates_with_scene`."""
        if self.turns_with_scene:
            check_rotates_with_scene(self.case())


def _parts(window: MapWindow) -> list[MapWindow]:
    """Four quarters cut at odd places, so that edges run through what the scene holds."""
    rows, cols = window.grid.shape
    row, col = round(rows * 0.47), round(cols * 0.63)
    return [
        cropped(window, y, x)
        for y in (slice(0, row), slice(row, rows))
        for x in (slice(0, col), slice(col, cols))
    ]


def _cells(window: MapWindow, distance_m: float) -> int:
    """Whole cells that make up at least that distance."""
    cells = distance_m / window.grid.resolution_m
    return int(math.copysign(math.ceil(abs(cells) - 1e-9), cells))


def _fingerprint(window: MapWindow) -> dict[str, Any]:
    found: dict[str, Any] = {
        str(name): (variable.dims, variable.dtype.str, np.asarray(variable.values).tobytes())
        for name, variable in window.dataset.variables.items()
    }
    found["attributes"] = repr(window.dataset.attrs)
    return found


def _contents(elements: list[MapElement]) -> list[tuple[str, bytes, str]]:
    return [(e.element_type, e.geometry.wkb, e.model_dump_json()) for e in elements]


def _require_same(
    expected: list[tuple[MapElement, BaseGeometry]], found: list[MapElement], what: str
) -> None:
    """Each expected element has one of its type in its place, and none is left over."""
    if len(expected) != len(found):
        raise CheckFailedError(
            f"{what} gave {len(found)} elements, {len(expected)} without it; measure from "
            "window.grid, not from the origin."
        )
    left = list(found)
    for element, geometry in expected:
        distances = [
            _distance_m(geometry, other.geometry) if type(other) is type(element) else math.inf
            for other in left
        ]
        nearest = int(np.argmin(distances))
        if not distances[nearest] <= MOVE_TOLERANCE_M:
            raise CheckFailedError(
                f"{what} should bring a {element.element_type} to {geometry.centroid.wkt}; the "
                f"nearest one found is {distances[nearest]:g} m off."
            )
        left.pop(nearest)


def _distance_m(one: BaseGeometry, other: BaseGeometry) -> float:
    """Hausdorff distance in x and y, or the difference of the lowest and highest z."""
    z = [shapely.get_coordinates(g, include_z=True)[:, 2] for g in (one, other)]
    return max(
        float(shapely.hausdorff_distance(one, other)),
        abs(float(z[0].min() - z[1].min())),
        abs(float(z[0].max() - z[1].max())),
    )


def _outlines(geometries: Any) -> BaseGeometry:
    lines = [shapely.force_2d(g.boundary if g.geom_type == "Polygon" else g) for g in geometries]
    return shapely.union_all(lines) if lines else shapely.GeometryCollection()
