"""Discovery, loading and refusing of vectorizers, on distributions made on the spot."""

import ast
import logging
import sys
from pathlib import Path

import pytest

import hdmap_tools
from hdmap_tools import plugin_info, registry
from hdmap_tools.errors import (
    PluginError,
    PluginLoadError,
    PluginVersionError,
    UnknownPluginError,
)
from hdmap_tools.plugin_api import API_VERSION, LaneMark, Vectorizer
from hdmap_tools.registry import PluginState
from hdmap_tools.testing.fake_plugins import DEFAULT_BODY, FakePlugins

MAJOR, MINOR = (int(part) for part in API_VERSION.split("."))


@pytest.fixture
def fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakePlugins:
    made = FakePlugins(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("importlib.metadata.entry_points", made.entry_points)
    monkeypatch.setattr("importlib.metadata.distributions", made.distributions)
    return made


def test_nothing_installed(fakes: FakePlugins) -> None:
    assert registry.discover() == ()
    with pytest.raises(UnknownPluginError, match="none; install a distribution"):
        registry.load("lane_marks")


def test_discover_lists_sorted_with_distribution_and_version(fakes: FakePlugins) -> None:
    fakes.add("zebra-dist", {"b_marks": DEFAULT_BODY, "a_marks": DEFAULT_BODY}, version="2.1")
    fakes.add("alpha-dist", {"c_marks": DEFAULT_BODY}, version="0.9")
    found = [(e.name, e.distribution, e.version) for e in registry.discover()]
    assert found == [
        ("a_marks", "zebra-dist", "2.1"),
        ("b_marks", "zebra-dist", "2.1"),
        ("c_marks", "alpha-dist", "0.9"),
    ]


def test_discover_imports_nothing(fakes: FakePlugins) -> None:
    fakes.add("some-dist", {"marks": DEFAULT_BODY})
    (entry,) = registry.discover()
    module = entry.value.partition(":")[0]
    assert module not in sys.modules
    registry.load("marks")
    assert module in sys.modules


def test_load_gives_the_class(fakes: FakePlugins) -> None:
    fakes.add("some-dist", {"marks": DEFAULT_BODY})
    loaded = registry.load("marks")
    assert issubclass(loaded, Vectorizer)
    assert loaded.element_types == (LaneMark,)
    assert registry.status("marks") == registry.PluginStatus(PluginState.OK)


def test_unknown_name_lists_and_suggests(fakes: FakePlugins) -> None:
    fakes.add("some-dist", {"crosswalk_polygon": DEFAULT_BODY, "road_boundary": DEFAULT_BODY})
    with pytest.raises(UnknownPluginError) as caught:
        registry.load("crosswalk_poligon")
    assert "Did you mean crosswalk_polygon?" in str(caught.value)
    assert "Installed: crosswalk_polygon, road_boundary." in str(caught.value)
    with pytest.raises(UnknownPluginError):
        registry.status("crosswalk_poligon")


def test_two_distributions_with_one_name(fakes: FakePlugins) -> None:
    fakes.add("first-dist", {"marks": DEFAULT_BODY, "others": DEFAULT_BODY})
    fakes.add("second-dist", {"marks": DEFAULT_BODY}, version="7.0")
    assert [e.distribution for e in registry.discover() if e.name == "marks"] == [
        "first-dist",
        "second-dist",
    ]
    with pytest.raises(PluginError, match=r"first-dist 1\.0 .* and second-dist 7\.0 .*uninstall"):
        registry.load("marks")
    assert registry.status("marks").state is PluginState.CONFLICT
    assert "second-dist" in registry.status("marks").reason
    assert registry.load("others").name == "others"


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ("import no_such_module_anywhere", ModuleNotFoundError),
        ("from hdmap_tools.plugin_api import NotThereYet", ImportError),
        ("def (", SyntaxError),
        ("1 / 0", ZeroDivisionError),
        ("import sys; sys.exit(3)", SystemExit),
        ("Other = 1", AttributeError),
    ],
)
def test_broken_import_is_listed_and_raises_with_its_cause(
    fakes: FakePlugins, source: str, cause: type[BaseException]
) -> None:
    fakes.add("broken-dist", {"broken": f"module:{source}\n"}, version="3.2")
    fakes.add("good-dist", {"good": DEFAULT_BODY})
    assert [e.name for e in registry.discover()] == ["broken", "good"]
    with pytest.raises(PluginLoadError, match=r"broken-dist 3\.2") as caught:
        registry.load("broken")
    assert isinstance(caught.value.__cause__, cause)
    assert registry.status("broken").state is PluginState.BROKEN
    assert cause.__name__ in registry.status("broken").reason
    assert registry.status("good").state is PluginState.OK


def test_an_api_name_that_is_not_there_hints_at_versions(fakes: FakePlugins) -> None:
    fakes.add("newer-dist", {"newer": "module:from hdmap_tools.plugin_api import NotThereYet\n"})
    with pytest.raises(PluginLoadError, match="install a matching version"):
        registry.load("newer")


def test_damaged_metadata_of_one_distribution_loses_only_that(
    fakes: FakePlugins, caplog: pytest.LogCaptureFixture
) -> None:
    fakes.add("good-dist", {"good": DEFAULT_BODY})
    fakes.register("damaged-dist", ["a line without what it should have"])
    with caplog.at_level(logging.WARNING):
        found = registry.discover()
    assert [e.name for e in found] == ["good"]
    assert "damaged_dist" in caplog.text


def test_missing_metadata_file_does_not_hide_the_plugin(fakes: FakePlugins) -> None:
    fakes.add("bare-dist", {"marks": DEFAULT_BODY})
    (fakes.folder / "bare_dist-1.0.dist-info" / "METADATA").unlink()
    (entry,) = registry.discover()
    assert (entry.name, entry.distribution, entry.version) == ("marks", "unknown", "unknown")


def test_malformed_value_is_a_load_error(fakes: FakePlugins) -> None:
    fakes.register("odd-dist", ["odd = not a module!"])
    with pytest.raises(PluginLoadError, match="odd-dist"):
        registry.load("odd")


@pytest.mark.parametrize(
    ("version", "remedy"),
    [(f"{MAJOR + 1}.0", "newer hdmap-tools"), (f"{MAJOR - 1}.9", "update the plugin")],
)
def test_other_major_is_refused(fakes: FakePlugins, version: str, remedy: str) -> None:
    # Another major may look quite different: the version must be what the message names.
    fakes.add("other-dist", {"marks": f'api_version = "{version}"\nelement_types = "lines"\n'})
    with pytest.raises(PluginVersionError, match=f"plugin API {version}.*{remedy}"):
        registry.load("marks")
    assert registry.status("marks").state is PluginState.INCOMPATIBLE


def test_newer_minor_warns_and_works(fakes: FakePlugins, caplog: pytest.LogCaptureFixture) -> None:
    newer = f"{MAJOR}.{MINOR + 1}"
    fakes.add("newer-dist", {"marks": f'api_version = "{newer}"\n{DEFAULT_BODY}'})
    with caplog.at_level(logging.WARNING):
        assert registry.load("marks").api_version == newer
    assert f"written for plugin API {newer}" in caplog.text
    found = registry.status("marks")
    assert found.state is PluginState.OK
    assert newer in found.reason


def test_same_version_does_not_warn(fakes: FakePlugins, caplog: pytest.LogCaptureFixture) -> None:
    fakes.add("same-dist", {"marks": f'api_version = "{MAJOR}.0"\n{DEFAULT_BODY}'})
    registry.load("marks")
    assert caplog.text == ""


OPTIONS = """
class Options(VectorizerOptions):
    width_m: float{default}
"""


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        ("module:Plugin = 5", "names 5; expected a class derived from"),
        ("module:class Plugin: pass", "expected a class derived from"),
        ("module:from hdmap_tools.plugin_api import Vectorizer as Plugin", "abstract|vectorize"),
        ("halo_m = 1.0", "leaves ['vectorize'] undefined"),
        (f'name = "another"\n{DEFAULT_BODY}', "name is 'another'; expected the entry point's"),
        (f"api_version = 1\n{DEFAULT_BODY}", "api_version is 1"),
        (f'api_version = "one"\n{DEFAULT_BODY}', "api_version is 'one'"),
        (f"element_types = LaneMark\n{DEFAULT_BODY}", "element_types is"),
        (f"element_types = ()\n{DEFAULT_BODY}", "element_types is ()"),
        (f"element_types = (int,)\n{DEFAULT_BODY}", "element_types is"),
        (f"element_types = [LaneMark]\n{DEFAULT_BODY}", "element_types is"),
        (f"element_types = (MapElement,)\n{DEFAULT_BODY}", "element_types is"),
        (f'requires = "lane_marks"\n{DEFAULT_BODY}', "requires is 'lane_marks'"),
        (f"halo_m = -1.0\n{DEFAULT_BODY}", "halo_m is -1.0"),
        (f"halo_m = float('nan')\n{DEFAULT_BODY}", "halo_m is nan"),
        (f"halo_m = '5'\n{DEFAULT_BODY}", "halo_m is '5'"),
        (f"Options = dict\n{DEFAULT_BODY}", "Options is <class 'dict'>"),
        (OPTIONS.format(default="") + DEFAULT_BODY, "no default for width_m"),
        (
            OPTIONS.format(default="\n    model_config = {'extra': 'ignore'}") + DEFAULT_BODY,
            "extra",
        ),
        ("def vectorize(self, window):\n    return []", "cannot be called"),
        (f"def __init__(self, size):\n    pass\n{DEFAULT_BODY}", "constructor asks for arguments"),
    ],
)
def test_a_class_that_breaks_the_contract_is_refused(
    fakes: FakePlugins, body: str, complaint: str
) -> None:
    fakes.add("wrong-dist", {"marks": body})
    with pytest.raises(PluginLoadError) as caught:
        registry.load("marks")
    assert any(part in str(caught.value) for part in complaint.split("|"))
    assert "wrong-dist 1.0" in str(caught.value)
    assert registry.status("marks").state is PluginState.BROKEN


def test_entry_point_names_are_lower_case_words(fakes: FakePlugins) -> None:
    fakes.add("loud-dist", {"Lane-Marks": DEFAULT_BODY})
    with pytest.raises(PluginLoadError, match="lower case"):
        registry.load("Lane-Marks")


def test_describe_tells_options_with_limits_and_meanings(fakes: FakePlugins) -> None:
    fakes.add(
        "some-dist",
        {
            "marks": '''
            __doc__ = """Finds marks.

            More about it.
            """
            requires = ("others",)
            class Options(VectorizerOptions):
                """What a mark is.

                Attributes:
                    width_m: How wide it is,
                        at most.
                """
                width_m: float = Field(default=0.5, gt=0, le=2)
                color: MarkColor | None = None
                votes: int = Field(default=3, description="How many | at least.")
            def vectorize(self, window, upstream, options, *, rng):
                return []
            '''
        },
        version="4.5",
    )
    info = plugin_info.describe("marks")
    assert (info.entry.distribution, info.entry.version) == ("some-dist", "4.5")
    assert (info.summary, info.requires, info.element_types) == (
        "Finds marks.",
        ("others",),
        ("lane_mark",),
    )
    assert plugin_info.options_table(registry.load("marks")).splitlines()[2:] == [
        "| `width_m` | number > 0, ≤ 2 | `0.5` | How wide it is, at most. |",
        "| `color` | `white` or `yellow` or `blue` or `unknown` or null | `null` |  |",
        "| `votes` | integer | `3` | How many \\| at least. |",
    ]


def _imports(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_the_core_knows_no_vectorizer_by_name() -> None:
    package = Path(hdmap_tools.__file__).parent
    for path in package.rglob("*.py"):
        imported = _imports(path)
        assert not any(name.split(".")[0] == "hdmap_plugins" for name in imported), path
        if "importlib.metadata" in imported and path.name not in ("registry.py", "fake_plugins.py"):
            # Reading our own version is no plugin discovery.
            assert "entry_points" not in path.read_text(encoding="utf-8"), path
