"""`hdmap info`: what a drive, a semantic map or a vector map holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("path", type=options.PATH, required=False)
@options.drive_options
@click.option("--default-config", is_flag=True, help="Print hdmap.yaml with all defaults instead.")
@options.json_option
def command(path: Path | None, **given: Any) -> None:
    """Say what a drive, a semantic map or a vector file holds.

    \b
    Examples:
      hdmap info path/to/drive
      hdmap info --default-config > hdmap.yaml
    """
    from hdmap_tools.config import Config
    from hdmap_tools.describe import describe

    if given["default_config"]:
        click.echo(Config().to_yaml(), nl=False)
        return
    if path is None:
        raise click.UsageError("Give a PATH, or --default-config.")
    facts = describe(path, given["layout"] or "auto", given["scene"], given["cameras"])
    options.write_json(given["json_path"], facts)
    _show(facts)


def _show(facts: dict[str, Any], indent: str = "") -> None:
    for name, value in facts.items():
        # Below the first level stand names: of cameras, drives, element types.
        label = indent + name if indent else name.replace("_", " ")
        if isinstance(value, dict):
            click.echo(f"{label}:")
            _show(value, indent + "  ")
        elif isinstance(value, list):
            click.echo(f"{label}:" + (" none" if not value else ""))
            for item in value:
                click.echo(f"{indent}  {item}")
        else:
            click.echo(f"{label}: {value}")
