"""plugins/README.md documents the whole contract, its example runs, its tables are current.

Run as a script it writes the generated parts anew.
"""

import ast
import dataclasses
import importlib.util
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from hdmap_tools import plugin_api, plugin_info, registry
from hdmap_tools.config import Config
from hdmap_tools.map_model.elements import ELEMENT_TYPES, MapElement
from hdmap_tools.registry import ENTRY_POINT_GROUP, PluginState
from hdmap_tools.testing import conformance
from hdmap_tools.testing.fake_plugins import FakePlugins
from hdmap_tools.testing.scenes import street_scene
from hdmap_tools.vectorization import vectorize

REPOSITORY = Path(__file__).resolve().parents[2]
README = REPOSITORY / "plugins" / "README.md"
OURS = "hdmap-tools"
GENERATED = re.compile(r"(<!-- generated: (\w+)[^>]*-->\n)(.*?)(<!-- end -->)", re.DOTALL)


def text() -> str:
    return README.read_text(encoding="utf-8")


def first_cells() -> set[str]:
    """Every `name` in the first cell of a table row."""
    rows = re.findall(r"^\| (`[^|]+`) \|", text(), re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row)}


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text(), re.MULTILINE | re.DOTALL)


# Generated parts


def vectorizers_part() -> str:
    names = [entry.name for entry in registry.discover() if entry.distribution == OURS]
    infos = [plugin_info.describe(name) for name in names]
    lines = ["| name | emits | requires | what it does |", "|---|---|---|---|"]
    for info in infos:
        kinds = ", ".join(f"`{kind}`" for kind in info.element_types)
        requires = ", ".join(f"`{name}`" for name in info.requires) or "none"
        lines.append(f"| `{info.entry.name}` | {kinds} | {requires} | {info.summary} |")
    for info in infos:
        table = plugin_info.options_table(registry.load(info.entry.name))
        lines += ["", f"Options of `{info.entry.name}`:", "", table]
    return "\n".join(lines) + "\n"


def checks_part() -> str:
    lines = ["| check | what it checks |", "|---|---|"]
    for check in (*conformance.REQUIRED_CHECKS, *conformance.ADVISORY_CHECKS):
        is_required = check in conformance.REQUIRED_CHECKS
        remark = "" if is_required else " (a remark in `hdmap plugins check`)"
        name = check.__name__.removeprefix("check_")
        lines.append(f"| `{name}` | {check.__doc__}{remark} |")
    return "\n".join(lines) + "\n"


PARTS = {"vectorizers": vectorizers_part, "checks": checks_part}


def rewritten() -> str:
    return GENERATED.sub(lambda m: m[1] + PARTS[m[2]]() + m[4], text())


def test_generated_parts_are_current() -> None:
    assert set(PARTS) == {found[2] for found in GENERATED.finditer(text())}
    assert text() == rewritten(), "run `python tests/plugins/test_readme.py`"


def test_every_built_in_vectorizer_has_a_row_and_every_option_a_meaning() -> None:
    ours = [entry.name for entry in registry.discover() if entry.distribution == OURS]
    assert ours
    assert set(ours) <= first_cells()
    for name in ours:
        for option in plugin_info.option_infos(registry.load(name)):
            assert option.meaning, f"{name}.{option.name} has no meaning in its docstring"


# The contract


def test_every_public_name_is_documented() -> None:
    assert sorted(set(plugin_api.__all__) - first_cells()) == []


def public_members(kind: type) -> set[str]:
    members = {name for name in vars(kind) if not name.startswith("_")}
    if dataclasses.is_dataclass(kind):
        members |= {field.name for field in dataclasses.fields(kind)}
    return members | {name for name in vars(kind).get("__annotations__", {}) if name[0] != "_"}


@pytest.mark.parametrize("kind", ["Vectorizer", "MapWindow", "VectorMap"])
def test_every_member_is_documented(kind: str) -> None:
    section = text().partition(f"### `{kind}`\n")[2].partition("\n### ")[0]
    assert section
    named = set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))
    assert sorted(public_members(getattr(plugin_api, kind)) - named) == []


def test_every_layer_of_a_window_is_documented() -> None:
    assert {str(name) for name in street_scene().dataset.variables} <= first_cells()


def test_every_field_and_value_of_elements_is_documented() -> None:
    rows = re.findall(
        r"^\| ((?:`\w+`(?:, )?)+) \| (all|(?:`\w+`(?:, )?)+) \| (.+) \|$", text(), re.MULTILINE
    )
    documented = {
        (owner.strip("`"), field)
        for fields, owners, _ in rows
        for field in re.findall(r"`(\w+)`", fields)
        for owner in owners.split(", ")
    }
    expected = {("all", field) for field in MapElement.model_fields}
    for kind in ELEMENT_TYPES:
        own = set(kind.model_fields) - set(MapElement.model_fields)
        expected |= {(kind.__name__, field) for field in own}
    assert expected - documented == set()
    meanings = " ".join(meaning for _, _, meaning in rows)
    for enum in (plugin_api.MarkStyle, plugin_api.MarkColor, plugin_api.BoundaryKind):
        assert [value for value in enum if f"`{value}`" not in meanings] == []


def test_every_element_type_is_part_of_the_api() -> None:
    assert [
        kind.__name__ for kind in ELEMENT_TYPES if kind.__name__ not in plugin_api.__all__
    ] == []


# The example


def write_example(folder: Path) -> None:
    """Every file that the text shows."""
    for source in blocks("python"):
        name = re.match(r"# (\w+\.py)\n", source)
        assert name, "a python block begins with a comment that names its file"
        (folder / name[1]).write_text(source, encoding="utf-8")
    (toml,) = blocks("toml")
    (folder / "pyproject.toml").write_text(toml, encoding="utf-8")


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The example's files, registered as its pyproject.toml says, beside what is installed here."""
    write_example(tmp_path)
    document = tomllib.loads((tmp_path / "pyproject.toml").read_text("utf-8"))["project"]
    lines = [f"{k} = {v}" for k, v in document["entry-points"][ENTRY_POINT_GROUP].items()]
    made = FakePlugins(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    made.register(document["name"], lines, version=document["version"])
    for module in tmp_path.glob("*.py"):
        monkeypatch.delitem(sys.modules, module.stem, raising=False)
    return tmp_path


def test_the_example_is_found(project: Path) -> None:
    for name in ("sidewalk_cells", "sidewalk_beside_crosswalks"):
        assert registry.entry_of(name).distribution == "my-sidewalks"
        assert registry.status(name) == registry.PluginStatus(PluginState.OK)


def test_the_examples_own_tests_pass(project: Path) -> None:
    module = ModuleType("test_my_sidewalks")
    source = (project / "test_my_sidewalks.py").read_text(encoding="utf-8")
    exec(compile(source, "test_my_sidewalks.py", "exec"), module.__dict__)
    ran = []
    for name, found in list(vars(module).items()):
        if name.startswith("test_"):
            found()
            ran.append(name)
        elif name.startswith("Test"):
            for method in (m for m in dir(found) if m.startswith("test_")):
                getattr(found(), method)()
                ran.append(f"{name}.{method}")
    checks = len(conformance.REQUIRED_CHECKS) + len(conformance.ADVISORY_CHECKS)
    assert len(ran) == 2 * checks + 1


def test_the_example_followed_to_the_letter_passes(tmp_path: Path) -> None:
    """Its files as they stand, built, installed and tested in a process of their own; no network."""
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    write_example(source)
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    install += ["--no-build-isolation", "--disable-pip-version-check", "--target", str(site)]
    done = subprocess.run([*install, str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # The tests alone: the modules must come from what was installed.
    tests = tmp_path / "tests"
    tests.mkdir()
    (source / "test_my_sidewalks.py").rename(tests / "test_my_sidewalks.py")
    path = os.pathsep.join(x for x in (str(site), os.environ.get("PYTHONPATH")) if x)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tests)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tests,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_how_to_install_is_said_as_it_is() -> None:
    example = REPOSITORY / "examples" / "third_party_vectorizer" / "README.md"
    for document in (text(), example.read_text(encoding="utf-8")):
        steps = re.findall(r"^    (pip install .*)$", document, re.MULTILINE)
        # From a checkout: no index has it.
        assert steps[:2] == ["pip install -e path/to/hdmap-tools", "pip install pytest"]


def imports_of(path: Path) -> set[str]:
    """Modules of the core that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name.split(".")[0] == "hdmap_tools"}


def test_plugins_import_only_what_is_documented() -> None:
    section = text().partition("A plugin may import these modules")[2].partition("\nEverything")[0]
    modules = re.findall(r"^\| `(hdmap_tools\.\w+)` \|", section, re.MULTILINE)
    assert len(modules) == 4
    assert [name for name in modules if importlib.util.find_spec(name) is None] == []
    outside = REPOSITORY / "examples" / "third_party_vectorizer"
    for path in [*(REPOSITORY / "plugins").rglob("*.py"), *outside.rglob("*.py")]:
        # The tests of a plugin are the only place for hdmap_tools.testing.
        is_test = path.is_relative_to(outside / "tests")
        allowed = [m for m in modules if is_test or m != "hdmap_tools.testing"]
        strange = [
            name
            for name in sorted(imports_of(path))
            if not any(name == m or name.startswith(f"{m}.") for m in allowed)
        ]
        assert strange == [], path


def test_the_configuration_shown_runs_it(project: Path) -> None:
    (document,) = blocks("yaml")
    config = Config.model_validate(yaml.safe_load(document)).vectorize
    result = vectorize(street_scene(), config)
    assert result.failures == ()
    (record,) = result.vector_map.provenance["plugins"]
    assert (record["name"], record["distribution"]) == ("sidewalk_cells", "my-sidewalks")
    assert record["options"]["min_area_m2"] == 10.0
    # Two sidewalks of 60 m by 3 m; the disc that nobody saw bites into the northern one.
    areas = sorted(element.geometry.area for element in result.vector_map)
    assert areas[1] == pytest.approx(180.0, rel=1e-6)
    assert areas[0] == pytest.approx(180.0 - 2.0 * 3.14159, rel=0.01)


def test_required_elements_reach_the_second_example(project: Path) -> None:
    pytest.importorskip("hdmap_plugins.crosswalk_polygon")
    from shapely.geometry import box

    from hdmap_tools.config import VectorizeConfig
    from hdmap_tools.geometry.grid import BevGrid
    from hdmap_tools.testing.scenes import window_from_shapes

    scene = window_from_shapes(
        {"sidewalk": box(0, 0, 20, 20), "crosswalk": box(6, 4, 10, 16)},
        BevGrid.from_bounds((0, 0, 20, 20), 0.2),
    )
    made: Any = vectorize(scene, VectorizeConfig(vectorizers=("sidewalk_beside_crosswalks",)))
    assert made.failures == ()
    assert {e.plugin for e in made.vector_map} == {
        "crosswalk_polygon",
        "sidewalk_beside_crosswalks",
    }
    (crossing,) = (e for e in made.vector_map if e.plugin == "crosswalk_polygon")
    (rest,) = (e for e in made.vector_map if e.plugin == "sidewalk_beside_crosswalks")
    assert rest.geometry.intersection(crossing.geometry).area < 1e-6
    assert rest.geometry.area == pytest.approx(400.0 - 48.0, rel=0.01)


if __name__ == "__main__":
    README.write_text(rewritten(), encoding="utf-8")
