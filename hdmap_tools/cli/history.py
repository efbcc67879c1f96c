"""`hdmap history`: the versions of a semantic map, and going back to one."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from hdmap_tools.cli import options

if TYPE_CHECKING:
    from hdmap_tools.fusion.map_location import MapLocation


@click.command()
@click.argument("semantic_map", type=options.MAP)
@click.option("--diff", nargs=2, metavar="BEFORE AFTER", help="Say what differs of two versions.")
@click.option("--roll-back", metavar="VERSION", help="Make a new version that equals this one.")
@click.option("--take-out", metavar="DRIVE", help="Subtract what a drive added, in a new version.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    semantic_map: MapLocation,
    diff: tuple[str, str] | None,
    roll_back: str | None,
    take_out: str | None,
    as_json: bool,
) -> None:
    """List the versions of a semantic map, compare them, go back to one.

    \b
    Examples:
      hdmap history map
      hdmap history map --diff 1 0
      hdmap history map --roll-back 3FA9
      hdmap history map --take-out nuscenes:scene-0001

    A version is named by its id, the beginning of it, or how many commits ago it was; 0 is
    the newest. Nothing is ever lost: going back, and taking a drive out, are new versions.
    """
    from hdmap_tools.errors import ConfigError
    from hdmap_tools.fusion import map_history
    from hdmap_tools.fusion.semantic_map import SemanticMap

    if sum(given is not None for given in (diff or None, roll_back, take_out)) > 1:
        raise ConfigError("Give one of --diff, --roll-back and --take-out.")
    opened = SemanticMap.open(semantic_map)
    if diff:
        before, after = (map_history.find_version(opened, name) for name in diff)
        changes = map_history.changes_between(opened, before, after)
        document = {
            "before": before.id,
            "after": after.id,
            "frames": changes.frames,
            "votes": changes.votes,
            "cells": changes.num_cells,
            "tiles": [[*index, cells] for index, cells in sorted(changes.tiles.items())],
        }
        if as_json:
            click.echo(json.dumps(document, indent=2))
            return
        click.echo(f"{before.id} ({before.message}) -> {after.id} ({after.message})")
        for drive, frames in changes.frames.items():
            click.echo(f"  {drive}: {frames:+d} images")
        click.echo(
            f"  {changes.votes:+d} votes, {changes.num_cells} cells of {len(changes.tiles)} tiles differ"
        )
        return
    if roll_back is not None:
        version = map_history.find_version(opened, roll_back)
        made = map_history.roll_back(opened, version)
        click.echo(
            f"{semantic_map} is as it was at {version.id} ({version.message}): version {made}"
        )
        return
    if take_out is not None:
        made = map_history.take_out(opened, take_out)
        click.echo(f"{take_out} is taken out of {semantic_map}: version {made}")
        return
    versions = opened.history()
    if as_json:
        listed = [
            {"id": v.id, "time": v.time.isoformat(), "message": v.message, "metadata": v.metadata}
            for v in versions
        ]
        click.echo(json.dumps(listed, indent=2))
        return
    for number, version in enumerate(versions):
        click.echo(
            f"{number:4d}  {version.id}  {version.time:%Y-%m-%d %H:%M:%S}  {version.message}"
        )
