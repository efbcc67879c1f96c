"""`hdmap merge`: add semantic maps, or take one out of another."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from hdmap_tools.cli import options

if TYPE_CHECKING:
    from hdmap_tools.fusion.map_location import MapLocation


@click.command()
@click.argument("maps", type=options.MAP, nargs=-1, required=True)
@click.option(
    "-o",
    "--out",
    type=options.MAP,
    required=True,
    help="Semantic map to make: a folder, or s3://BUCKET/PREFIX.",
)
@click.option("--subtract", type=options.MAP, multiple=True, help="Take this map out; repeatable.")
@click.option("--force", is_flag=True, help="Add a drive that is in the sum already once more.")
@options.overwrite_option
def command(
    maps: tuple[MapLocation, ...],
    out: MapLocation,
    subtract: tuple[MapLocation, ...],
    **given: Any,
) -> None:
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
