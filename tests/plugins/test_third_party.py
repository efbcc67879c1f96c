"""The outside plugin in examples/ is built, installed and run as a stranger's would be."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hdmap_tools.testing.fake_plugins import DEFAULT_BODY, FakePlugins

PROJECT = Path(__file__).resolve().parents[2] / "examples" / "third_party_vectorizer"
NAME = "stop_line_example"
DISTRIBUTION = "hdmap-stop-line-example"


def declared_version() -> str:
    found = re.search(r'^version = "(.+)"$', (PROJECT / "pyproject.toml").read_text(), re.MULTILINE)
    assert found
    return found[1]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the example's wheel installed in it, as site-packages has it; no network."""
    folder = tmp_path_factory.mktemp("outside")
    source = folder / "source"
    shutil.copytree(PROJECT, source, ignore=shutil.ignore_patterns("__pycache__", ".*", "dist"))
    target = folder / "site"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    command += ["--no-build-isolation", "--disable-pip-version-check", "--target", str(target)]
    done = subprocess.run([*command, str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


def python(*folders: Path, arguments: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """An interpreter that has those folders on its path."""
    path = os.pathsep.join(str(folder) for folder in folders)
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        cwd=cwd,
    )


def answer(*folders: Path, script: str) -> Any:
    """What a script prints as JSON."""
    done = python(*folders, arguments=["-c", script], cwd=folders[0])
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_it_is_not_installed_here() -> None:
    # Else the tests below would prove nothing about the folder.
    done = python(arguments=["-c", "import hdmap_stop_line_example"], cwd=PROJECT)
    assert "ModuleNotFoundError" in done.stderr


def test_it_is_listed_with_distribution_and_version(site: Path) -> None:
    listed = answer(
        site,
        script="import json, sys; from hdmap_tools import registry\n"
        "entries = [(e.name, e.distribution, e.version) for e in registry.discover()]\n"
        "imported = 'hdmap_stop_line_example' in sys.modules\n"
        f"print(json.dumps([entries, imported, registry.status('{NAME}').state]))",
    )
    entries, was_imported, state = listed
    assert [NAME, DISTRIBUTION, declared_version()] in entries
    assert entries == sorted(entries)
    assert not was_imported
    assert state == "ok"


def test_it_finds_the_stop_line(site: Path) -> None:
    made = answer(
        site,
        script="import json\n"
        "from hdmap_tools.config import VectorizeConfig\n"
        "from hdmap_tools.testing.scenes import street_scene\n"
        "from hdmap_tools.vectorization import vectorize\n"
        f"config = VectorizeConfig(vectorizers=('{NAME}',), options={{'{NAME}': {{'min_width_m': 0.25}}}})\n"
        "result = vectorize(street_scene(stop_line=True), config)\n"
        "print(json.dumps({'failures': len(result.failures), 'provenance': result.vector_map.provenance,\n"
        "  'elements': [[e.element_type, e.plugin, e.plugin_version, list(e.geometry.coords)]\n"
        "               for e in result.vector_map]}))",
    )
    assert made["failures"] == 0
    ((element_type, plugin, version, coords),) = made["elements"]
    assert (element_type, plugin, version) == ("stop_line", NAME, declared_version())
    assert sorted(coords)[0][0] == pytest.approx(33.25, abs=0.1)
    (record,) = made["provenance"]["plugins"]
    assert (record["name"], record["distribution"], record["version"]) == (
        NAME,
        DISTRIBUTION,
        declared_version(),
    )
    assert record["options"]["min_width_m"] == 0.25


def test_check_vectorizer_passes_without_pytest(site: Path) -> None:
    results = answer(
        site,
        script="import json, sys; sys.modules['pytest'] = None\n"
        "from hdmap_tools.testing.conformance import check_vectorizer\n"
        f"print(json.dumps([[r.name, r.passed, r.message] for r in check_vectorizer('{NAME}')]))",
    )
    assert len(results) > 10
    assert [r for r in results if not r[1]] == []


def test_its_own_tests_pass(site: Path) -> None:
    source = site.parent / "source"
    arguments = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:dash", str(source)]
    done = python(site, arguments=arguments, cwd=source)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\b2\d passed", done.stdout), done.stdout


def test_the_readme_names_every_option(site: Path) -> None:
    names = answer(
        site,
        script="import json; from hdmap_tools import registry\n"
        f"print(json.dumps(list(registry.load('{NAME}').Options.model_fields)))",
    )
    text = (PROJECT / "README.md").read_text(encoding="utf-8")
    assert [name for name in names if f"`{name}`" not in text] == []


def test_a_second_distribution_of_that_name_is_a_conflict(site: Path, tmp_path: Path) -> None:
    FakePlugins(tmp_path).add("copycat-dist", {NAME: DEFAULT_BODY}, version="9.9")
    owners, state, reason = answer(
        site,
        tmp_path,
        script="import json; from hdmap_tools import registry\n"
        f"owners = [e.distribution for e in registry.discover() if e.name == '{NAME}']\n"
        f"found = registry.status('{NAME}')\n"
        "print(json.dumps([owners, found.state, found.reason]))",
    )
    assert owners == ["copycat-dist", DISTRIBUTION]
    assert state == "conflict"
    assert "copycat-dist 9.9" in reason
    assert DISTRIBUTION in reason
