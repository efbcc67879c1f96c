"""`hdmap build`: a drive into a semantic map."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("drive", type=options.PATH)
@click.option("-o", "--out", type=options.PATH, required=True, help="Semantic map to make.")
@options.drive_options
@options.segmentation_options
@click.option(
    "--like", type=options.PATH, help="Take this map's settings over, so that both can be merged."
)
@options.association_option
@options.resolution_option
@options.origin_option
@click.option(
    "--resume/--no-resume",
    default=True,
    show_default=True,
    help="Go on with a build that was killed, or throw it away.",
)
@options.overwrite_option
@options.json_option
@options.config_options
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Fuse a drive into a semantic map.

    \b
    Examples:
      hdmap build path/to/drive -o map --model road-segmentation-adas-0001.xml
      hdmap build path/to/next_drive -o map2 --like map

    A build that was killed goes on after its last commit when the same command is given
    again, and ends with the same map. The map is a versioned repository of counts; read it with `hdmap vectorize`,
    `hdmap compare` and `hdmap info`, add maps with `hdmap merge`.
    """
    from hdmap_tools.single_steps import build_alone
    from hdmap_tools.steps import Steps

    config = options.resolve_config(given, association__also=[], export__formats=[])
    with options.ImageProgress(ctx.obj["progress"]) as segmented:
        report = build_alone(
            given["drive"],
            given["out"],
            config,
            like=given["like"],
            cache=options.label_cache(given["cache_folder"], given["no_cache"]),
            overwrite=given["overwrite"],
            resume=given["resume"],
            steps=Steps(segmented),
        )
    options.write_json(given["json_path"], report, overwrite=given["overwrite"])
    click.echo(
        f"{report['drive']}: {report['num_images']} images fused into {report['num_tiles']} tiles at "
        f"{given['out']} in {sum(report['seconds'].values()):.1f} s"
    )
