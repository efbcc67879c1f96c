"""Who may import whom: read from the source, and tried in a fresh interpreter."""

import ast
import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {"hdmap_tools": ROOT / "hdmap_tools", "hdmap_plugins": ROOT / "plugins/hdmap_plugins"}
HEAVY = ("torch", "open3d", "cv2")

# What a package of ours may import of ours; a name stands for all below it.
LAYERS = {
    "hdmap_tools.types": (),
    "hdmap_tools.errors": (),
    "hdmap_tools.geometry": ("types", "errors", "geometry"),
    "hdmap_tools.labels": ("types", "errors", "labels"),
    "hdmap_tools.map_model": ("geometry", "errors", "types", "map_model"),
    "hdmap_tools.readers": ("geometry", "errors", "types", "readers", "labels"),
    "hdmap_tools.plugin_api": ("geometry", "errors", "types", "labels", "map_model"),
}


def modules() -> dict[str, Path]:
    found = {}
    for package, folder in FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            parts = [package, *path.relative_to(folder).with_suffix("").parts]
            found[".".join(parts).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def imports(module: str, *, run_time_only: bool = False) -> set[str]:
    """Names that a module imports, anywhere in it, as absolute dotted names.

    ``from a import b`` counts as ``a.b`` where that is a module of ours, else as ``a``.
    With run_time_only: only what importing the module executes.
    """
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    is_package = MODULES[module].name == "__init__.py"
    found: set[str] = set()
    for node in executed(tree) if run_time_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                kept = len(parts) - node.level + is_package
                base = ".".join([*parts[:kept], *([base] if base else [])])
            for alias in node.names:
                dotted = f"{base}.{alias.name}"
                found.add(dotted if dotted in MODULES else base)
    return found


def executed(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that run when the module is imported: not function bodies, not TYPE_CHECKING."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            for other in child.orelse:
                yield other
                yield from executed(other)
            continue
        yield child
        yield from executed(child)


def is_within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def ours(module: str) -> set[str]:
    return {n for n in imports(module) if any(is_within(n, package) for package in FOLDERS)}


def test_the_source_is_read() -> None:
    assert len(MODULES) > 25
    assert "hdmap_tools.types" in imports("hdmap_tools.geometry.se3")
    assert "scipy.spatial.transform" in imports("hdmap_tools.geometry.se3")
    # Lazy and type-only imports are imports, but not at run time.
    assert "pyproj" in imports("hdmap_tools.geometry.map_frame")
    assert "pyproj" not in imports("hdmap_tools.geometry.map_frame", run_time_only=True)
    assert "xarray" in imports("hdmap_tools.plugin_api")
    assert "xarray" not in imports("hdmap_tools.plugin_api", run_time_only=True)
    assert "hdmap_tools.geometry.grid" in imports("hdmap_tools.plugin_api", run_time_only=True)


def test_relative_imports_and_modules_taken_from_packages_are_resolved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "one.py"
    path.write_text(
        "from . import other\nfrom ..cli import main\nfrom hdmap_tools import errors\n"
        "def f():\n    import hdmap_plugins.x as x\n"
    )
    monkeypatch.setitem(MODULES, "hdmap_tools.geometry.one", path)
    monkeypatch.setitem(MODULES, "hdmap_tools.geometry.other", path)
    assert imports("hdmap_tools.geometry.one") == {
        "hdmap_tools.geometry.other",
        "hdmap_tools.cli" if "hdmap_tools.cli.main" not in MODULES else "hdmap_tools.cli.main",
        "hdmap_tools.errors",
        "hdmap_plugins.x",
    }


@pytest.mark.parametrize("module", sorted(m for m in MODULES if is_within(m, "hdmap_tools")))
def test_the_core_never_imports_the_built_in_vectorizers(module: str) -> None:
    assert not {n for n in imports(module) if is_within(n, "hdmap_plugins")}


@pytest.mark.parametrize("module", sorted(m for m in MODULES if is_within(m, "hdmap_plugins")))
def test_built_in_vectorizers_use_the_open_door_only(module: str) -> None:
    # The array aliases of `types` belong to the signatures of `plugin_api` and `geometry`.
    allowed = (
        "hdmap_tools.plugin_api",
        "hdmap_tools.geometry",
        "hdmap_tools.types",
        "hdmap_plugins",
    )
    assert not {n for n in ours(module) if not any(is_within(n, a) for a in allowed)}


@pytest.mark.parametrize("package", LAYERS)
def test_layers_import_downwards(package: str) -> None:
    allowed = [f"hdmap_tools.{name}" for name in LAYERS[package]]
    members = [m for m in MODULES if is_within(m, package)]
    assert members
    for module in members:
        wrong = {n for n in ours(module) if not any(is_within(n, a) for a in allowed)}
        assert not wrong, f"{module} imports {sorted(wrong)}; allowed is {allowed}"


def test_nothing_but_the_command_line_imports_the_command_line() -> None:
    for module in MODULES:
        if not is_within(module, "hdmap_tools.cli"):
            wrong = {n for n in imports(module) if is_within(n, "hdmap_tools.cli")}
            assert not wrong, f"{module} imports {sorted(wrong)}"


def test_only_the_command_line_runs_the_pipeline() -> None:
    for module in MODULES:
        if not is_within(module, "hdmap_tools.cli"):
            wrong = {n for n in imports(module) if is_within(n, "hdmap_tools.pipeline")}
            assert not wrong, f"{module} imports {sorted(wrong)}"


def closure(module: str) -> set[str]:
    """All modules that importing one executes, ours followed, others by name."""
    seen: set[str] = set()
    queue = [module]
    while queue:
        name = queue.pop()
        if name in seen:
            continue
        seen.add(name)
        parents = [name.rsplit(".", k)[0] for k in range(1, name.count(".") + 1)]
        queue += [p for p in parents if p in MODULES]
        if name in MODULES:
            queue += sorted(imports(name, run_time_only=True))
    return seen


def test_the_plugin_contract_is_light_as_written() -> None:
    reached = closure("hdmap_tools.plugin_api")
    assert {"hdmap_tools.geometry.grid", "hdmap_tools.map_model.elements", "numpy"} < reached
    assert not {n for n in reached if n.split(".")[0] in HEAVY}


def test_the_plugin_contract_is_light_when_imported() -> None:
    code = "import json, sys; import hdmap_tools.plugin_api; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert "hdmap_tools.plugin_api" in loaded
    installed = [name for name in HEAVY if importlib.util.find_spec(name)]
    assert "cv2" in installed, "the test needs a heavy library that could have been loaded"
    assert not loaded & set(HEAVY)


def calls(module: str) -> set[str]:
    """Everything a module calls, as written without a leading ``importlib.``."""
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    functions = [ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return {name.removeprefix("importlib.") for name in functions}


def test_only_the_registry_looks_for_plugins() -> None:
    look = {
        f"{prefix}{name}"
        for prefix in ("metadata.", "")
        for name in ("entry_points", "distributions")
    }
    looking = {m for m in MODULES if calls(m) & look}
    assert looking == {"hdmap_tools.registry"}
