"""The runner, with good, bad and hostile vectorizers made on the spot."""

import json
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools import vectorization
from hdmap_tools.config import VectorizeConfig
from hdmap_tools.errors import (
    ConfigError,
    PluginError,
    PluginLoadError,
    PluginVersionError,
    ShapeError,
    UnknownPluginError,
)
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import API_VERSION, MapWindow
from hdmap_tools.testing.fake_plugins import DEFAULT_BODY, FakePlugins
from hdmap_tools.testing.scenes import window_from_shapes
from hdmap_tools.vectorization import VectorizationResult, vectorize


@pytest.fixture
def fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakePlugins:
    made = FakePlugins(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("importlib.metadata.entry_points", made.entry_points)
    return made


@pytest.fixture
def window() -> MapWindow:
    return window_from_shapes({}, BevGrid(0.5, -10, 4, 30, 24))


def returns(expression: str, attributes: str = "") -> str:
    """A plugin body that returns an expression of window, upstream, options and rng."""
    return (
        f"{attributes}\n"
        "def vectorize(self, window, upstream, options, *, rng):\n"
        "    x0, y0, x1, y1 = window.grid.bounds_m\n"
        # Making broken geometry warns; here that is wanted.
        "    with np.errstate(all='ignore'):\n"
        f"        return {expression}\n"
    )


def failure(result: VectorizationResult, name: str) -> vectorization.PluginFailure:
    (found,) = (f for f in result.failures if f.name == name)
    return found


LINE = "LaneMark(geometry=LineString([(x0, y0 + {0}, 0), (x1, y0 + {0}, 0)]))"


def test_elements_are_signed_and_given_ids(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add(
        "some-dist", {"marks": returns(f"[{LINE.format(1)}, {LINE.format(3)}]")}, version="4.2"
    )
    result = vectorize(window)
    assert result.failures == ()
    assert [(e.plugin, e.plugin_version) for e in result.vector_map] == [("marks", "4.2")] * 2
    assert len({e.id for e in result.vector_map}) == 2
    assert all(e.id for e in result.vector_map)
    assert result.vector_map.frame == window.frame


def test_provenance_names_plugin_distribution_version_and_options(
    fakes: FakePlugins, window: MapWindow
) -> None:
    options = "class Options(VectorizerOptions):\n    width_m: float = 0.5\n    color: MarkColor = MarkColor.WHITE"
    fakes.add("some-dist", {"marks": f"{options}\n{DEFAULT_BODY}"}, version="4.2")
    fakes.add("bad-dist", {"worse": returns("1 / 0")})
    config = VectorizeConfig(options={"marks": {"width_m": 0.25}}, seed=7)
    provenance = vectorize(window, config).vector_map.provenance
    assert provenance == {
        "plugin_api": API_VERSION,
        "seed": 7,
        "plugins": [
            {
                "name": "marks",
                "distribution": "some-dist",
                "version": "4.2",
                "api_version": API_VERSION,
                "options": {"width_m": 0.25, "color": "white"},
            }
        ],
        "failed": [{"name": "worse", "message": "ZeroDivisionError: division by zero"}],
    }
    assert json.loads(json.dumps(provenance)) == provenance


def test_nothing_installed_gives_an_empty_map(fakes: FakePlugins, window: MapWindow) -> None:
    result = vectorize(window)
    assert (len(result.vector_map), result.failures) == (0, ())


def test_only_the_named_ones_run(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add("some-dist", {"a_marks": DEFAULT_BODY, "b_marks": returns("1 / 0")})
    result = vectorize(window, VectorizeConfig(vectorizers=("a_marks",)))
    assert {e.plugin for e in result.vector_map} == {"a_marks"}
    assert result.failures == ()


# What it requires


def test_required_ones_run_first_and_only_their_elements_are_handed_on(
    fakes: FakePlugins, window: MapWindow
) -> None:
    fakes.add(
        "some-dist",
        {
            # Sorted by name the dependant would come first.
            "a_last": returns(
                "seen.append([(id(e), e.id, e.plugin) for e in upstream]) or []",
                'requires = ("z_first",)\nimport builtins as _b\nglobals()["seen"] = _b.__dict__.setdefault("_seen", [])',
            ),
            "m_other": returns(f"[{LINE.format(5)}]"),
            "z_first": returns(f"[{LINE.format(1)}, {LINE.format(3)}]"),
        },
    )
    import builtins

    builtins.__dict__["_seen"] = seen = []
    result = vectorize(window)
    del builtins.__dict__["_seen"]
    assert result.failures == ()
    (handed_on,) = seen
    assert {plugin for _, _, plugin in handed_on} == {"z_first"}
    in_map = {id(e): e for e in result.vector_map}
    assert all(in_map[key].id == element_id for key, element_id, _ in handed_on)
    assert len(handed_on) == 2


def test_upstream_does_not_hold_what_is_required_indirectly(
    fakes: FakePlugins, window: MapWindow
) -> None:
    echo = "[e.model_copy(update={'id': ''}) for e in upstream if e.plugin == 'a_base']"
    fakes.add(
        "some-dist",
        {
            "a_base": DEFAULT_BODY,
            "b_middle": returns("[]", 'requires = ("a_base",)'),
            "c_top": returns(echo, 'requires = ("b_middle",)'),
        },
    )
    assert {e.plugin for e in vectorize(window).vector_map} == {"a_base"}


def test_a_required_one_is_pulled_in(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add("some-dist", {"top": returns("list(upstream)[:0]", 'requires = ("base",)')})
    fakes.add("other-dist", {"base": DEFAULT_BODY, "unrelated": DEFAULT_BODY})
    result = vectorize(window, VectorizeConfig(vectorizers=("top",)))
    assert [p["name"] for p in result.vector_map.provenance["plugins"]] == ["base", "top"]


def test_a_missing_requirement(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add("some-dist", {"top": returns("[]", 'requires = ("absent",)'), "good": DEFAULT_BODY})
    with pytest.raises(PluginError, match="'top' requires 'absent': No vectorizer 'absent'"):
        vectorize(window, VectorizeConfig(vectorizers=("top",)))
    result = vectorize(window)
    assert "requires 'absent'" in failure(result, "top").message
    assert {e.plugin for e in result.vector_map} == {"good"}


def test_a_circle_is_named(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add(
        "some-dist",
        {
            "one": returns("[]", 'requires = ("two",)'),
            "two": returns("[]", 'requires = ("three",)'),
            "three": returns("[]", 'requires = ("one",)'),
            "onlooker": returns("[]", 'requires = ("two",)'),
            "selfish": returns("[]", 'requires = ("selfish",)'),
            "good": DEFAULT_BODY,
        },
    )
    with pytest.raises(PluginError, match="one requires two requires three requires one"):
        vectorize(window, VectorizeConfig(vectorizers=("two",)))
    with pytest.raises(PluginError, match="selfish requires selfish"):
        vectorize(window, VectorizeConfig(vectorizers=("selfish",)))
    result = vectorize(window)
    assert [f.name for f in result.failures] == ["one", "onlooker", "selfish", "three", "two"]
    assert failure(result, "onlooker").is_skipped
    assert {e.plugin for e in result.vector_map} == {"good"}


def test_a_failure_skips_dependants_and_nobody_else(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add(
        "bad-dist",
        {
            "base": returns("1 / 0"),
            "middle": returns("[]", 'requires = ("base",)'),
            "top": returns("[]", 'requires = ("middle",)'),
        },
        version="0.3",
    )
    fakes.add("good-dist", {"good": DEFAULT_BODY})
    result = vectorize(window)
    base = failure(result, "base")
    assert (base.distribution, base.version, base.is_skipped) == ("bad-dist", "0.3", False)
    assert base.message == "ZeroDivisionError: division by zero"
    assert "1 / 0" in base.traceback
    assert base.describe() == (
        "vectorizer base (bad-dist 0.3) gave nothing: "
        "ZeroDivisionError: division by zero. Its elements are missing."
    )
    assert "requires base, which failed" in failure(result, "middle").message
    assert "requires middle, which failed" in failure(result, "top").message
    assert failure(result, "top").is_skipped
    assert {e.plugin for e in result.vector_map} == {"good"}


# Named or merely installed


@pytest.mark.parametrize(
    ("body", "error"),
    [
        ("module:import no_such_module_anywhere\n", PluginLoadError),
        (f'api_version = "99.0"\n{DEFAULT_BODY}', PluginVersionError),
    ],
)
def test_unusable_plugins(
    fakes: FakePlugins, window: MapWindow, body: str, error: type[PluginError]
) -> None:
    fakes.add("bad-dist", {"bad": body}, version="6.6")
    fakes.add("good-dist", {"good": DEFAULT_BODY})
    with pytest.raises(error):
        vectorize(window, VectorizeConfig(vectorizers=("good", "bad")))
    result = vectorize(window)
    assert {e.plugin for e in result.vector_map} == {"good"}
    found = failure(result, "bad")
    assert (found.distribution, found.version) == ("bad-dist", "6.6")


def test_two_distributions_with_one_name(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add("first-dist", {"marks": DEFAULT_BODY, "good": DEFAULT_BODY})
    fakes.add("second-dist", {"marks": DEFAULT_BODY})
    with pytest.raises(PluginError, match=r"first-dist .* and second-dist"):
        vectorize(window, VectorizeConfig(vectorizers=("marks",)))
    result = vectorize(window)
    assert failure(result, "marks").distribution == "first-dist and second-dist"
    assert {e.plugin for e in result.vector_map} == {"good"}


def test_an_unknown_name(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add("some-dist", {"marks": DEFAULT_BODY})
    with pytest.raises(UnknownPluginError, match="Did you mean marks"):
        vectorize(window, VectorizeConfig(vectorizers=("mark",)))


# Options


OPTIONS = """
class Options(VectorizerOptions):
    width_m: Annotated[float, Field(gt=0)] = 0.5
    height_m: float = 0.1
"""


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (
            {"marks": {"widht_m": 1}},
            ["vectorize.options.marks.widht_m", "no such option", "width_m, height_m"],
        ),
        ({"marks": {"width_m": -1}}, ["vectorize.options.marks.width_m", "greater than 0", "-1"]),
        (
            {"marks": {"width_m": "wide", "height_m": []}},
            ["options.marks.width_m", "'wide'", "options.marks.height_m"],
        ),
        ({"mark": {}}, ["vectorize.options.mark", "No vectorizer 'mark'", "Did you mean marks"]),
    ],
)
def test_wrong_options_name_plugin_and_field(
    fakes: FakePlugins, window: MapWindow, options: dict[str, dict[str, object]], parts: list[str]
) -> None:
    fakes.add("some-dist", {"marks": OPTIONS + DEFAULT_BODY})
    for vectorizers in ((), ("marks",)):
        with pytest.raises(ConfigError) as caught:
            vectorize(window, VectorizeConfig(vectorizers=vectorizers, options=options))
        for part in parts:
            assert part in str(caught.value)


def test_options_of_an_installed_one_that_is_not_chosen_are_let_be(
    fakes: FakePlugins, window: MapWindow
) -> None:
    fakes.add("some-dist", {"marks": OPTIONS + DEFAULT_BODY, "others": DEFAULT_BODY})
    config = VectorizeConfig(vectorizers=("others",), options={"marks": {"width_m": 1}})
    assert vectorize(window, config).failures == ()


def test_options_reach_the_plugin(fakes: FakePlugins, window: MapWindow) -> None:
    body = OPTIONS + returns(f"[{LINE.format('options.height_m')}]")
    fakes.add("some-dist", {"marks": body})
    config = VectorizeConfig(options={"marks": {"height_m": 2.5}})
    (element,) = vectorize(window, config).vector_map
    assert element.geometry.coords[0][1] == window.grid.bounds_m[1] + 2.5


def test_a_fault_in_an_authors_own_check_is_the_plugins(
    fakes: FakePlugins, window: MapWindow
) -> None:
    checks = (
        "class Options(VectorizerOptions):\n"
        "    width_m: float = 0.5\n"
        "    @field_validator('width_m')\n"
        "    def check(cls, value): raise KeyError('oops')\n"
    )
    fakes.add("bad-dist", {"bad": checks + DEFAULT_BODY})
    fakes.add("good-dist", {"good": DEFAULT_BODY})
    result = vectorize(window, VectorizeConfig(options={"bad": {"width_m": 1}}))
    assert "oops" in failure(result, "bad").message
    assert {e.plugin for e in result.vector_map} == {"good"}


# Randomness


def test_the_generator_depends_on_seed_and_name_alone(
    fakes: FakePlugins, window: MapWindow
) -> None:
    random_line = returns(f"[{LINE.format('rng.uniform(0, 5)')}]")
    fakes.add("some-dist", {"a_marks": random_line, "b_marks": random_line})

    def heights(*names: str, seed: int = 0) -> dict[str, float]:
        made = vectorize(window, VectorizeConfig(vectorizers=names, seed=seed)).vector_map
        return {e.plugin: e.geometry.coords[0][1] for e in made}

    both = heights("a_marks", "b_marks")
    assert both == heights("b_marks", "a_marks") == {**heights("a_marks"), **heights("b_marks")}
    assert both["a_marks"] != both["b_marks"]
    assert both["a_marks"] != heights("a_marks", seed=1)["a_marks"]
    assert heights("a_marks", seed=-1) == heights("a_marks", seed=-1)


# What comes back


GARBAGE = {
    "nothing": ("None", "returned NoneType; expected a list"),
    "a tuple": (f"({LINE.format(1)},)", "returned tuple"),
    "a generator": (f"({LINE.format(1)} for _ in range(2))", "returned generator"),
    "no element": ("[5]", "Element 0 is a int; element_types declares LaneMark"),
    "an undeclared type": (
        "[StopLine(geometry=LineString([(x0, y0, 0), (x1, y1, 0)]))]",
        "Element 0 is a StopLine; element_types declares LaneMark",
    ),
    "NaN": ("[LaneMark(geometry=LineString([(x0, y0, 0), (x1, np.nan, 0)]))]", "NaN or infinite"),
    "infinite height": (
        "[LaneMark.model_construct(geometry=LineString([(x0, y0, 0), (x1, y1, np.inf)]), id='',"
        " confidence=1.0)]",
        "not valid",
    ),
    "NaN past the checks": (
        f"[{LINE.format(1)}.model_copy(update={{'geometry': LineString([(x0, y0, 0), (x1, np.nan, 0)])}})]",
        "NaN or infinite",
    ),
    "2D past the checks": (
        f"[{LINE.format(1)}.model_copy(update={{'geometry': LineString([(x0, y0), (x1, y1)])}})]",
        "needs 3D coordinates",
    ),
    "polygon for a line": (
        f"[{LINE.format(1)}.model_copy(update={{'geometry': Polygon([(x0, y0, 0), (x1, y1, 0), (x1, y0, 0)])}})]",
        "needs a LineString",
    ),
    "no geometry": (f"[{LINE.format(1)}.model_copy(update={{'geometry': None}})]", "not valid"),
    "confidence past the checks": (
        f"[{LINE.format(1)}.model_copy(update={{'confidence': float('nan')}})]",
        "confidence",
    ),
    "half made": ("[LaneMark.model_construct()]", "not valid"),
    "a line of one place": (
        "[LaneMark(geometry=LineString([(x0, y0, 0), (x0, y0, 0)]))]",
        "not a valid geometry",
    ),
    "outside": (
        "[LaneMark(geometry=LineString([(x0, y0, 0), (x1 + 5, y1, 0)]))]",
        "clip to window.grid.bounds_m",
    ),
    "outside in the south": (f"[{LINE.format(-0.51)}]", "clip to window.grid.bounds_m"),
    "ids twice": (
        f"[{LINE.format(1)}.model_copy(update={{'id': 'a'}}), {LINE.format(2)}.model_copy(update={{'id': 'a'}})]",
        "leave id empty",
    ),
    "writing": (
        "window.dataset['posterior'].values.__setitem__(0, 0.5)",
        "ValueError: assignment destination is read-only",
    ),
    "unlocking": (
        "window.dataset['height'].values.setflags(write=True)",
        "ValueError: cannot set WRITEABLE flag",
    ),
    "unlocking the memory behind": (
        "window.dataset['height'].values.base.setflags(write=True)",
        "ValueError: cannot set WRITEABLE flag",
    ),
    "leaving": ("__import__('sys').exit(0)", "SystemExit: 0"),
    "running out of stack": (
        "self.vectorize(window, upstream, options, rng=rng)",
        "RecursionError",
    ),
    "asking for too much memory": ("np.empty(1 << 45)", "MemoryError"),
}


@pytest.mark.parametrize(("expression", "message"), GARBAGE.values(), ids=GARBAGE.keys())
def test_garbage_costs_only_its_own_elements(
    fakes: FakePlugins, window: MapWindow, expression: str, message: str
) -> None:
    before = window.dataset.copy(deep=True)
    fakes.add("bad-dist", {"bad": returns(expression)}, version="6.6")
    fakes.add("good-dist", {"a_good": DEFAULT_BODY, "z_good": DEFAULT_BODY})
    result = vectorize(window, VectorizeConfig(vectorizers=("a_good", "bad", "z_good")))
    (found,) = result.failures
    assert message in found.message
    assert "\n" not in found.message
    assert (found.name, found.distribution, found.version) == ("bad", "bad-dist", "6.6")
    assert {e.plugin for e in result.vector_map} == {"a_good", "z_good"}
    assert window.dataset.identical(before)


def test_a_vertex_within_the_tolerance_is_let_be(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add("some-dist", {"marks": returns(f"[{LINE.format(-0.49)}]")})
    assert vectorize(window).failures == ()


def test_ids_of_another_plugin_are_refused(fakes: FakePlugins, window: MapWindow) -> None:
    named = returns(f"[{LINE.format(1)}.model_copy(update={{'id': 'mine'}})]")
    fakes.add("some-dist", {"a_first": named, "b_second": named})
    result = vectorize(window)
    assert [(e.plugin, e.id) for e in result.vector_map] == [("a_first", "mine")]
    assert "belong to elements of another vectorizer" in failure(result, "b_second").message


def test_a_plugin_cannot_sign_for_another(fakes: FakePlugins, window: MapWindow) -> None:
    signed = f"[{LINE.format(1)}.model_copy(update={{'plugin': 'other', 'plugin_version': '9'}})]"
    fakes.add("some-dist", {"marks": returns(signed)}, version="1.5")
    (element,) = vectorize(window).vector_map
    assert (element.plugin, element.plugin_version) == ("marks", "1.5")


def test_one_plugin_cannot_change_what_the_next_sees(fakes: FakePlugins, window: MapWindow) -> None:
    swap = "window.dataset.__setitem__('height', window.dataset['height'] + 100) or []"
    look = f"[{LINE.format(1)}] if window.layer('height').max() > 50 else []"
    move = "window.dataset['x'].values.setflags(write=True) or window.dataset['x'].values.fill(0) or []"
    see = f"[{LINE.format(2)}] if (window.dataset['x'].values == 0).all() else []"
    fakes.add(
        "some-dist",
        {"a": returns(swap), "b": returns(look), "c": returns(move), "d": returns(see)},
    )
    before = window.dataset.copy(deep=True)
    assert len(vectorize(window).vector_map) == 0
    assert window.dataset.identical(before)


def test_keyboard_interrupt_passes_through(fakes: FakePlugins, window: MapWindow) -> None:
    body = "def vectorize(self, window, upstream, options, *, rng):\n    raise KeyboardInterrupt"
    fakes.add("some-dist", {"marks": body})
    with pytest.raises(KeyboardInterrupt):
        vectorize(window)


# Windows


def test_a_window_without_cells_gives_an_empty_map(fakes: FakePlugins) -> None:
    fakes.add("some-dist", {"marks": returns("1 / 0")})
    empty = window_from_shapes({}, BevGrid(0.5, 3, 3, 3, 3))
    result = vectorize(empty)
    assert (len(result.vector_map), result.failures) == (0, ())


def test_a_window_that_does_not_fit_its_grid_is_refused(
    fakes: FakePlugins, window: MapWindow
) -> None:
    wrong = MapWindow(window.dataset, window.grid.expand(1))
    with pytest.raises(ShapeError, match=r"\(20, 40\) cells .* grid \(22, 42\)"):
        vectorize(wrong)


def test_arrays_over_writeable_memory_are_sealed(fakes: FakePlugins, window: MapWindow) -> None:
    # A view into a larger, writeable array, as cutting a window out of a map gives.
    larger = np.zeros((100, 100), dtype=np.float32)
    dataset = window.dataset.copy(deep=False)
    dataset["height"] = (("y", "x"), larger[:20, :40])
    fakes.add("some-dist", {"marks": returns("window.layer('height').setflags(write=True)")})
    result = vectorize(MapWindow(dataset, window.grid))
    assert "WRITEABLE" in failure(result, "marks").message


def test_the_same_run_gives_the_same_map(fakes: FakePlugins, window: MapWindow) -> None:
    fakes.add(
        "some-dist",
        {
            "a_marks": returns(f"[{LINE.format('rng.uniform(0, 5)')} for _ in range(5)]"),
            "b_marks": returns(f"[{LINE.format(1)}] * 3"),
        },
    )
    first, second = vectorize(window).vector_map, vectorize(window).vector_map
    assert [e.model_dump() for e in first] == [e.model_dump() for e in second]
    assert [e.geometry.wkb for e in first] == [e.geometry.wkb for e in second]
    assert first.provenance == second.provenance
