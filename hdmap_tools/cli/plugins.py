"""`hdmap plugins`: list, describe and check vectorizers."""

from __future__ import annotations

from pathlib import Path

import click

from hdmap_tools.cli import options


@click.group("plugins")
def command() -> None:
    """List, describe and check vectorizer plugins.

    \b
    Examples:
      hdmap plugins list
      hdmap plugins check lane_mark_skeleton
    """


@command.command("list")
@options.overwrite_option
@options.json_option
def list_plugins(json_path: Path | None, overwrite: bool) -> None:
    """List installed vectorizers: name, version, distribution, status.

    \b
    Examples:
      hdmap plugins list
      hdmap plugins list --json plugins.json
    """
    from hdmap_tools import registry

    rows = []
    for entry in registry.discover():
        status = registry.status(entry.name)
        rows.append(
            {
                "name": entry.name,
                "version": entry.version,
                "distribution": entry.distribution,
                "status": str(status.state),
                "reason": status.reason,
            }
        )
    options.write_json(json_path, rows, overwrite=overwrite)
    if not rows:
        click.echo("No vectorizers are installed.")
        return
    columns = ("name", "version", "distribution", "status")
    widths = [max(len(c), *(len(row[c]) for row in rows)) for c in columns]
    click.echo("  ".join(c.ljust(w) for c, w in zip(columns, widths, strict=True)).rstrip())
    for row in rows:
        line = "  ".join(row[c].ljust(w) for c, w in zip(columns, widths, strict=True)).rstrip()
        click.echo(f"{line}  {row['reason']}".rstrip())


@command.command("info")
@click.argument("name")
def info(name: str) -> None:
    """Describe a vectorizer: what it emits, what it requires, its options.

    \b
    Examples:
      hdmap plugins info crosswalk_polygon
      hdmap plugins info road_boundary
    """
    from hdmap_tools.plugin_info import describe

    plugin = describe(name)
    click.echo(plugin.entry.describe())
    click.echo(f"\n{plugin.description}\n")
    click.echo(f"API version:  {plugin.api_version}")
    click.echo(f"Emits:        {', '.join(plugin.element_types)}")
    click.echo(f"Requires:     {', '.join(plugin.requires) or 'nothing'}")
    click.echo(f"Context:      {plugin.halo_m} m beyond a window")
    if not plugin.options:
        click.echo("Options:      none")
        return
    click.echo("Options (hdmap.yaml: vectorize.options, or --set):")
    for option in plugin.options:
        click.echo(f"  {option.name} ({option.kind}) = {option.default}")
        if option.meaning:
            click.echo(f"      {option.meaning}")


@command.command("check")
@click.argument("name")
@options.overwrite_option
@options.json_option
def check(name: str, json_path: Path | None, overwrite: bool) -> int:
    """Run the conformance checks on an installed vectorizer.

    \b
    Examples:
      hdmap plugins check crosswalk_polygon
      hdmap plugins check my_vectorizer --json checks.json

    Exit code 1 if a required check fails.
    """
    from hdmap_tools.testing.conformance import check_vectorizer

    results = check_vectorizer(name)
    options.write_json(
        json_path,
        [
            {
                "name": r.name,
                "passed": r.passed,
                "required": r.is_required,
                "message": r.message,
            }
            for r in results
        ],
        overwrite=overwrite,
    )
    for result in results:
        word = "ok  " if result.passed else ("FAIL" if result.is_required else "note")
        click.echo(f"{word}  {result.name}" + (f": {result.message}" if result.message else ""))
    failed = [r for r in results if r.is_required and not r.passed]
    click.echo(f"{len(results) - len(failed)} of {len(results)} checks passed")
    return 1 if failed else 0
