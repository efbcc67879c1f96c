"""Every conformance check catches the fault that it is there for, and passes a good vectorizer."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shapely import affinity
from shapely.geometry import LineString

from hdmap_tools.errors import ConfigError, UnknownPluginError
from hdmap_tools.plugin_api import LaneMark, MapWindow, StopLine, Vectorizer, VectorizerOptions
from hdmap_tools.testing import conformance, transforms
from hdmap_tools.testing.conformance import Case, CheckFailedError
from hdmap_tools.testing.fake_plugins import DEFAULT_BODY, FakePlugins
from hdmap_tools.testing.scenes import argmax_classes, street_scene


def outline_of_crosswalk(window: MapWindow) -> list[Any]:
    """A line through the crosswalk, found from the window's own grid: keeps every promise."""
    mask = window.probability("crosswalk") > 0.5
    if not mask.any():
        return []
    rows_cols = np.argwhere(mask)
    corners = window.grid.to_city(np.array([rows_cols.min(axis=0), rows_cols.max(axis=0)]))
    if np.array_equal(*corners):
        return []
    heights = window.layer("height")[mask]
    z = float(np.nanmean(heights)) if np.isfinite(heights).any() else 0.0
    x0, y0, x1, y1 = corners.ravel()
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    half = np.array([0.0, (y1 - y0) / 2]) if y1 - y0 > x1 - x0 else np.array([(x1 - x0) / 2, 0.0])
    ends = [(*(middle - half), z), (*(middle + half), z)]
    return [LaneMark(geometry=LineString(ends))]


class Good(Vectorizer):
    name = "good"
    element_types = (LaneMark,)

    def vectorize(self, window: MapWindow, upstream: Any, options: Any, *, rng: Any) -> list[Any]:
        return outline_of_crosswalk(window)


def shifted(elements: list[Any], x: float = 0.0, y: float = 0.0, z: float = 0.0) -> list[Any]:
    return [
        e.model_copy(update={"geometry": affinity.translate(e.geometry, x, y, z)}) for e in elements
    ]


class WritesDirectly(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        window.dataset["height"].values[0, 0] = 3.0
        return super().vectorize(window, *args, **kwargs)


class Unlocks(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        height = window.dataset["height"].values
        try:
            height.setflags(write=True)
        except ValueError:
            return super().vectorize(window, *args, **kwargs)
        height[0, 0] = 3.0
        return super().vectorize(window, *args, **kwargs)


class Adds(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        window.dataset["mine"] = window.dataset["height"] * 2
        return super().vectorize(window, *args, **kwargs)


class UsesGlobalRandomness(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        return shifted(super().vectorize(window, *args, **kwargs), x=np.random.random() * 0.1)


class KeepsState(Good):
    def __init__(self) -> None:
        self.seen: set[tuple[float, ...]] = set()

    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        self.seen.add(window.grid.bounds_m)
        return shifted(super().vectorize(window, *args, **kwargs), x=0.01 * (len(self.seen) - 1))


class SeesThingsInTheDark(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        x0, y0, x1, y1 = window.grid.bounds_m
        return [LaneMark(geometry=LineString([(x0, y0, 0), (x1, y1, 0)]))]


class NeedsUpstream(Good):
    requires = ("road_boundary_nowhere",)

    def vectorize(self, window: MapWindow, upstream: Any, *args: Any, **kwargs: Any) -> list[Any]:
        upstream.elements[0]
        return []


class ReachesOut(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        # Only where the window cuts the crosswalk.
        made = super().vectorize(window, *args, **kwargs)
        y0, y1 = (window.grid.bounds_m[i] for i in (1, 3))
        bounds = [e.geometry.bounds for e in made]
        is_cut = any(b[1] - y0 < 0.3 or y1 - b[3] < 0.3 for b in bounds)
        return (
            shifted(made, y=2.0 if bounds and y1 - bounds[0][3] < 0.3 else -2.0) if is_cut else made
        )


class EmitsAnother(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        made = super().vectorize(window, *args, **kwargs)
        return [StopLine(geometry=e.geometry) for e in made]


class NeedsRoom(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        np.gradient(window.probability("road"))
        return super().vectorize(window, *args, **kwargs)


class NeedsHeights(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        made = super().vectorize(window, *args, **kwargs)
        lowest = np.min(window.layer("height")[np.isfinite(window.layer("height"))])
        return made if np.isfinite(lowest) else []


class MeasuresFromTheOrigin(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        made = super().vectorize(window, *args, **kwargs)
        return shifted(made, x=-window.grid.bounds_m[0])


class TruncatesCells(Good):
    """The bug of the reference implementation: int() instead of floor."""

    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        made = super().vectorize(window, *args, **kwargs)
        return [
            LaneMark(
                geometry=LineString(
                    [(float(int(x)), float(int(y)), z) for x, y, z in e.geometry.coords]
                )
            )
            for e in made
        ]


class LiesFlat(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        made = super().vectorize(window, *args, **kwargs)
        return [
            LaneMark(geometry=LineString([(x, y, 0.0) for x, y, _ in e.geometry.coords]))
            for e in made
        ]


class TakesAnything(Good):
    class Options(VectorizerOptions):
        model_config = {"extra": "ignore"}  # noqa: RUF012


class LooksEastOnly(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        made = super().vectorize(window, *args, **kwargs)
        return [e for e in made if np.ptp(np.array(e.geometry.coords)[:, 1]) > 1.0]


class FindsNothing(Good):
    def vectorize(self, window: MapWindow, *args: Any, **kwargs: Any) -> list[Any]:
        return []


class WrongAttributes(Good):
    element_types = ()


FAULTS: list[tuple[type[Vectorizer], Any]] = [
    (WrongAttributes, conformance.check_contract),
    (TakesAnything, conformance.check_contract),
    (TakesAnything, conformance.check_options_refuse_unknown),
    (FindsNothing, conformance.check_finds_something),
    (WritesDirectly, conformance.check_works_on_sealed_window),
    (Unlocks, conformance.check_input_unchanged),
    (Adds, conformance.check_input_unchanged),
    (UsesGlobalRandomness, conformance.check_repeatable),
    (KeepsState, conformance.check_repeatable),
    (SeesThingsInTheDark, conformance.check_empty_in_empty_out),
    (ReachesOut, conformance.check_valid_inside_grid),
    (EmitsAnother, conformance.check_valid_inside_grid),
    (MeasuresFromTheOrigin, conformance.check_moves_with_grid),
    (TruncatesCells, conformance.check_moves_with_grid),
    (LiesFlat, conformance.check_rises_with_ground),
    (LooksEastOnly, conformance.check_rotates_with_scene),
]
RAISES: list[tuple[type[Vectorizer], Any]] = [
    (NeedsUpstream, conformance.check_upstream_empty),
    (NeedsRoom, conformance.check_tiny_windows),
    (NeedsHeights, conformance.check_missing_layers),
]
ALL_CHECKS = (*conformance.REQUIRED_CHECKS, *conformance.ADVISORY_CHECKS)


@pytest.mark.parametrize(
    "check",
    [c for c in ALL_CHECKS if c is not conformance.check_name_equals_entry_point],
    ids=lambda check: check.__name__,
)
def test_a_good_vectorizer_passes(check: conformance.Check) -> None:
    check(Case(Good))


@pytest.mark.parametrize(("vectorizer", "check"), FAULTS, ids=lambda value: value.__name__)
def test_each_fault_is_caught(vectorizer: type[Vectorizer], check: conformance.Check) -> None:
    with pytest.raises(CheckFailedError):
        check(Case(vectorizer))


@pytest.mark.parametrize(("vectorizer", "check"), RAISES, ids=lambda value: value.__name__)
def test_what_raises_is_caught(vectorizer: type[Vectorizer], check: conformance.Check) -> None:
    with pytest.raises((IndexError, ValueError)):
        check(Case(vectorizer))


def test_every_check_has_a_fault_that_it_catches() -> None:
    tried = {check for _, check in FAULTS + RAISES} | {conformance.check_name_equals_entry_point}
    assert tried == set(ALL_CHECKS)


def test_the_pytest_class_runs_every_check() -> None:
    methods = {n for n in vars(conformance.VectorizerConformance) if n.startswith("test_")}
    assert methods == {c.__name__.replace("check_", "test_", 1) for c in ALL_CHECKS}


@pytest.fixture
def fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakePlugins:
    made = FakePlugins(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("importlib.metadata.entry_points", made.entry_points)
    return made


def test_name_equals_entry_point(fakes: FakePlugins) -> None:
    with pytest.raises(CheckFailedError, match="Register the class"):
        conformance.check_name_equals_entry_point(Case(Good))
    fakes.add("some-dist", {"good": DEFAULT_BODY})
    with pytest.raises(CheckFailedError, match="Entry point 'good' names fake_plugin"):
        conformance.check_name_equals_entry_point(Case(Good))


def test_check_vectorizer_reports_what_failed_and_what_is_a_remark(fakes: FakePlugins) -> None:
    fakes.add("some-dist", {"marks": DEFAULT_BODY})
    results = {r.name: r for r in conformance.check_vectorizer("marks")}
    assert len(results) == len(ALL_CHECKS)
    assert not results["empty_in_empty_out"].passed
    assert results["empty_in_empty_out"].is_required
    assert "unknown cells gave 1 elements" in results["empty_in_empty_out"].message
    assert results["name_equals_entry_point"].passed
    assert not results["rotates_with_scene"].is_required
    assert all(r.meaning for r in results.values())


def test_check_vectorizer_keeps_the_traceback_of_what_it_raised(fakes: FakePlugins) -> None:
    fakes.add(
        "some-dist",
        {"marks": "def vectorize(self, window, upstream, options, *, rng):\n    return 1 / 0"},
    )
    results = {r.name: r for r in conformance.check_vectorizer("marks")}
    assert results["contract"].passed
    assert results["repeatable"].message == "It raised ZeroDivisionError: division by zero"
    assert "return 1 / 0" in results["repeatable"].traceback


def test_check_vectorizer_of_unknown_name_or_option(fakes: FakePlugins) -> None:
    fakes.add("some-dist", {"marks": DEFAULT_BODY})
    with pytest.raises(UnknownPluginError, match="marks"):
        conformance.check_vectorizer("mark")
    with pytest.raises(ConfigError, match=r"vectorize\.options\.marks\.width"):
        conformance.check_vectorizer("marks", options={"width": 3})


def test_required_ones_feed_upstream(fakes: FakePlugins) -> None:
    echo = (
        'requires = ("base",)\n'
        "def vectorize(self, window, upstream, options, *, rng):\n"
        "    return [e.model_copy(update={'id': ''}) for e in upstream]"
    )
    fakes.add("some-dist", {"base": DEFAULT_BODY, "echo": echo})
    results = {r.name: r for r in conformance.check_vectorizer("echo")}
    assert results["finds_something"].passed
    assert results["moves_with_grid"].passed


def test_transforms_keep_what_lies_where() -> None:
    scene = street_scene(stop_line=True)
    classes = argmax_classes(scene)
    rng = np.random.default_rng(3)
    x0, y0, x1, y1 = scene.grid.bounds_m
    points = rng.uniform((x0, y0), (x1, y1), (500, 2))

    def seen(window: MapWindow, xy: Any) -> Any:
        return argmax_classes(window)[tuple(window.grid.rows_cols_of(xy).T)]

    truth = seen(scene, points)
    assert len(set(truth)) == 6
    moved = transforms.moved(scene, -7, 1000)
    r = scene.grid.resolution_m
    assert (seen(moved, points + (-7 * r, 1000 * r)) == truth).all()
    turned = transforms.rotated(scene)
    assert (seen(turned, np.column_stack([-points[:, 1], points[:, 0]])) == truth).all()
    part = transforms.cropped(scene, slice(10, 90), slice(20, 250))
    inside = part.grid.contains(part.grid.rows_cols_of(points))
    assert (seen(part, points[inside]) == truth[inside]).all()
    assert (argmax_classes(scene) == classes).all()
    for window in (moved, turned, part):
        np.testing.assert_allclose(window.dataset["x"], window.grid.x_centres_m)
        np.testing.assert_allclose(window.dataset["y"], window.grid.y_centres_m)
