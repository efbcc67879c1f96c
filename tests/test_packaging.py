"""What is built from the sources holds what users need, and importing it stays cheap."""

import ast
import configparser
import email
import email.message
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

import hdmap_tools

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
VERSION: str = PYPROJECT["project"]["version"]

# Slow to import, or absent where only the plugin API is wanted.
HEAVY = (
    "av2",
    "cv2",
    "icechunk",
    "lxml",
    "matplotlib",
    "numba",
    "onnxruntime",
    "open3d",
    "openvino",
    "pandas",
    "pyarrow",
    "pyogrio",
    "scipy",
    "skimage",
    "torch",
    "xarray",
    "zarr",
)


def _build(target: str, folder: Path) -> Path:
    """Build with the installed hatchling; a proxy that leads nowhere keeps it offline."""
    dead = dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"), "http://127.0.0.1:9")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)],
        cwd=ROOT,
        env={**os.environ, **dead},
        check=True,
        capture_output=True,
    )
    (built,) = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build("wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        assert archive.testzip() is None
        return set(archive.namelist())


def _dist_info(wheel: Path, name: str) -> str:
    with zipfile.ZipFile(wheel) as archive:
        return archive.read(f"hdmap_tools-{VERSION}.dist-info/{name}").decode()


def _metadata(wheel: Path) -> email.message.Message:
    return email.message_from_string(_dist_info(wheel, "METADATA"))


def _entry_points(wheel: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(delimiters=("=",))
    parser.read_string(_dist_info(wheel, "entry_points.txt"))
    return parser


def _in_sources(package: Path, prefix: str) -> set[str]:
    return {
        f"{prefix}/{path.relative_to(package).as_posix()}"
        for path in package.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_wheel_holds_both_packages_completely_and_nothing_else(names: set[str]) -> None:
    expected = _in_sources(ROOT / "hdmap_tools", "hdmap_tools")
    expected |= _in_sources(ROOT / "plugins" / "hdmap_plugins", "hdmap_plugins")
    packed = {name for name in names if ".dist-info/" not in name}
    assert packed == expected


def test_wheel_holds_data_and_type_markers(names: set[str]) -> None:
    assert {"hdmap_tools/py.typed", "hdmap_plugins/py.typed"} <= names
    for folder, at_least in (("labels/sets", 5), ("segmentation/profiles", 1)):
        found = [n for n in names if re.fullmatch(rf"hdmap_tools/{folder}/[^/]+\.json", n)]
        assert len(found) >= at_least, folder


def test_wheel_carries_the_licence(wheel: Path) -> None:
    assert _dist_info(wheel, "licenses/LICENSE") == (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert _metadata(wheel)["License-Expression"] == "Apache-2.0"


def test_console_script_is_declared(wheel: Path) -> None:
    assert dict(_entry_points(wheel)["console_scripts"]) == {"hdmap": "hdmap_tools.cli.main:main"}


@pytest.mark.parametrize("group", ["console_scripts", "hdmap_tools.vectorizers"])
def test_entry_points_lead_to_objects_in_the_wheel(
    wheel: Path, names: set[str], group: str
) -> None:
    # Read, not imported: an import would find the sources, not what is in the wheel.
    targets = dict(_entry_points(wheel)[group])
    assert targets
    for name, target in targets.items():
        module, _, attribute = target.partition(":")
        path = f"{module.replace('.', '/')}.py"
        assert path in names, f"{name} leads to {module}, which is not in the wheel"
        with zipfile.ZipFile(wheel) as archive:
            body = ast.parse(archive.read(path)).body
        defined = {n.name for n in body if isinstance(n, ast.ClassDef | ast.FunctionDef)}
        assert attribute in defined, f"{module} does not define {attribute}"


def test_versions_agree(wheel: Path) -> None:
    found = {
        "pyproject.toml": VERSION,
        "hdmap_tools.__version__": hdmap_tools.__version__,
        "wheel": _metadata(wheel)["Version"],
        "installed": metadata.version("hdmap-tools"),
    }
    assert set(found.values()) == {VERSION}, found


def test_two_builds_of_a_wheel_are_equal(wheel: Path, tmp_path: Path) -> None:
    assert _build("wheel", tmp_path).read_bytes() == wheel.read_bytes()


def test_sdist_builds_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    sdist = _build("sdist", tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        # Python 3.11 has filters from 3.11.4 on, Python 3.12 warns without one.
        safe = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
        archive.extractall(tmp_path / "unpacked", **safe)
    (source,) = (tmp_path / "unpacked").iterdir()
    # What `make test` needs, so that packagers can run it.
    for needed in ("Makefile", "constraints.txt", "pyproject.toml", "tests", "schemas", "examples"):
        assert (source / needed).exists(), needed
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path / "again")],
        cwd=source,
        check=True,
        capture_output=True,
    )
    (rebuilt,) = (tmp_path / "again").iterdir()
    assert rebuilt.read_bytes() == wheel.read_bytes()


def test_console_script_starts() -> None:
    script = Path(sys.executable).parent / "hdmap"
    assert script.is_file() or shutil.which("hdmap"), "the console script is not installed"
    done = subprocess.run([script, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Usage: hdmap" in done.stdout


def test_installed_vectorizers_are_those_declared() -> None:
    # They differ after an edit of pyproject.toml without a reinstall.
    declared = PYPROJECT["project"]["entry-points"]["hdmap_tools.vectorizers"]
    installed = {
        point.name: point.value
        for point in metadata.distribution("hdmap-tools").entry_points
        if point.group == "hdmap_tools.vectorizers"
    }
    assert installed == declared


@pytest.mark.parametrize("module", ["hdmap_tools.plugin_api", "hdmap_tools.cli.main"])
def test_import_stays_light(module: str) -> None:
    """`hdmap --help` and every plugin's import pay for what these modules load."""
    code = f"import sys, {module}; print(*sorted({set(HEAVY)!r} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


# constraints.txt


def _pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = {}
    for line in lines:
        match = re.fullmatch(r"([A-Za-z0-9._-]+)==([0-9][A-Za-z0-9.]*)", line)
        assert match, f"expected a bare name==version, found {line!r}"
        pins[_normal(match[1])] = match[2]
    assert len(pins) == len(lines), "a name is pinned twice"
    return pins


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _direct(*groups: str) -> list[Requirement]:
    project = PYPROJECT["project"]
    listed = [*project["dependencies"], *project["optional-dependencies"]["openvino"]]
    listed += [entry for group in groups for entry in PYPROJECT["dependency-groups"][group]]
    return [Requirement(entry) for entry in listed]


def test_constraints_pin_every_direct_dependency() -> None:
    pins = _pins()
    for requirement in _direct("dev", "av2"):
        assert pins.get(_normal(requirement.name), "none") in requirement.specifier, requirement


def test_constraints_pin_everything_that_make_installs() -> None:
    """Walks the requirements of what is installed, as pip would; av2 comes without its own."""
    pins = _pins()
    todo = [(requirement, "") for requirement in _direct("dev")]
    seen: set[tuple[str, str]] = set()
    while todo:
        requirement, asked_by = todo.pop()
        name = _normal(requirement.name)
        assert pins.get(name, "none") in requirement.specifier, f"{requirement} of {asked_by}"
        for extra in {"", *requirement.extras}:
            if (name, extra) in seen:
                continue
            seen.add((name, extra))
            for further in map(Requirement, metadata.requires(name) or []):
                if further.marker is None or further.marker.evaluate({"extra": extra}):
                    todo.append((further, name))
    assert len(seen) > 80
