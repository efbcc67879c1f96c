"""`hdmap info`: what a drive, a semantic map, a point map, a vector map or a mask holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final

import click

from hdmap_tools.cli import options

if TYPE_CHECKING:
    from hdmap_tools.fusion.map_location import MapLocation


@click.command()
@click.argument("path", type=options.MAP, required=False)
@options.drive_options
@click.option("--default-config", is_flag=True, help="Print hdmap.yaml with all defaults instead.")
@options.overwrite_option
@options.json_option
def command(path: MapLocation | None, **given: Any) -> None:
    """Say what a drive, a semantic map, a point map or a vector file holds.

    \b
    Examples:
      hdmap info path/to/drive
      hdmap info --default-config > hdmap.yaml

    PATH is a drive, a semantic map (also s3://BUCKET/PREFIX) or the folder of a run, a point map or cloud, a vector
    map, or a mask PNG with its JSON. A vector map's provenance is shortened; --json has all of it.
    """
    from hdmap_tools.config import Config
    from hdmap_tools.describe import describe

    if given["default_config"]:
        click.echo(Config().to_yaml(), nl=False)
        return
    if path is None:
        raise click.UsageError("Give a PATH, or --default-config.")
    facts = describe(path, given["layout"] or "auto", given["scene"], given["cameras"])
    options.write_json(given["json_path"], facts, overwrite=given["overwrite"])
    _show(facts)


def _show(facts: dict[str, Any], indent: str = "") -> None:
    for name, value in facts.items():
        # Below the first level stand names: of cameras, drives, element types.
        label = indent + name if indent else name.replace("_", " ")
        if not indent and name in _BRIEF:
            for line in _BRIEF[name](value):
                click.echo(line)
        elif isinstance(value, dict):
            click.echo(f"{label}:")
            _show(value, indent + "  ")
        elif isinstance(value, list):
            click.echo(f"{label}:" + (" none" if not value else ""))
            for item in value:
                click.echo(f"{indent}  {item}")
        else:
            click.echo(f"{label}: {value}")


def _bounds(value: dict[str, float]) -> Iterator[str]:
    yield "bounds m: " + (", ".join(f"{side} {b}" for side, b in value.items()) or "none")


def _reference_maps(value: list[dict[str, Any]]) -> Iterator[str]:
    yield "reference maps:" + ("" if value else " none")
    for one in value:
        yield f"  {one['path']}" + ("" if one["is_readable"] else " (not readable yet)")


def _provenance(value: dict[str, Any]) -> Iterator[str]:
    """A line a plugin, and a line each for whatever else is known; --json has it whole."""
    from hdmap_tools.formats.records import brief_counts

    for plugin in value.get("plugins", ()):
        # A file of someone else may say anything there.
        if isinstance(plugin, dict):
            yield f"plugin: {_short(plugin.get('name'))} {_short(plugin.get('version', ''))}".rstrip()
    for name, one in value.items():
        if name in ("plugins", "skipped_ids") or one in ([], {}, None, ""):
            continue
        is_counts = isinstance(one, dict) and all(isinstance(n, int) for n in one.values())
        if name == "skipped" and is_counts:
            yield f"skipped: {brief_counts(one, _LINE)} (--json lists them)"
        elif is_counts:
            yield _short(f"{_label(name)}: " + ", ".join(f"{n} {kind}" for kind, n in one.items()))
        elif isinstance(one, dict):
            yield _short(f"{_label(name)}: " + ", ".join(f"{k} {v}" for k, v in one.items()))
        else:
            yield _short(f"{_label(name)}: {one}")


def _label(name: str) -> str:
    return name.replace("_", " ")


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= _LINE else text[: _LINE - 3] + "..."


_LINE: Final = 120
_BRIEF: Final[dict[str, Callable[[Any], Iterator[str]]]] = {
    "bounds_m": _bounds,
    "reference_maps": _reference_maps,
    "provenance": _provenance,
}
"""Facts that people are told in fewer words than the JSON file."""
