"""`hdmap merge`: add semantic maps, or take one out of another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("maps", type=options.PATH, nargs=-1, required=True)
@click.option("-o", "--out", type=options.PATH, required=True, help="Semantic map to make.")
@click.option("--subtract", type=options.PATH, multiple=True, help="Take this map out; repeatable.")
@click.option("--force", is_flag=True, help="Add a drive that is in the sum already once more.")
@options.overwrite_option
def command(maps: tuple[Path, ...], out: Path, subtract: tuple[Path, ...], **given: Any) -> None:
    """Add semantic maps: the sum equals the map built from all drives at once.

    \b
    Examples:
      hdmap merge monday tuesday -o week
      hdmap merge week -o without_monday --subtract monday
    """
    from hdmap_tools.single_steps import merge_maps

    merged = merge_maps(
        maps, subtract, out, allow_repeats=given["force"], overwrite=given["overwrite"]
    )
    drives = ", ".join(
        f"{name} ({entry['num_frames']} images)" for name, entry in merged.drives.items()
    )
    click.echo(f"{out} holds {drives or 'no drive'} in {len(merged.tile_indices())} tiles")
