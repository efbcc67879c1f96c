"""`hdmap build`: a drive into a semantic map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from hdmap_tools.cli import options

if TYPE_CHECKING:
    from hdmap_tools.config import Config
    from hdmap_tools.memory_budget import MemoryBudget
    from hdmap_tools.segmentation.cache import LabelCache


@click.command()
@click.argument("drive", type=options.PATH)
@click.option(
    "-o",
    "--out",
    type=options.MAP,
    required=True,
    help="Semantic map to make: a folder, or s3://BUCKET/PREFIX.",
)
@options.drive_options
@options.segmentation_options
@click.option(
    "--like", type=options.MAP, help="Take this map's settings over, so that both can be merged."
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
@click.option(
    "--repair",
    is_flag=True,
    help="Count the damaged tiles of the map at OUT again, given the options that it was built with.",
)
@click.option(
    "--memory",
    metavar="SIZE",
    help="Keep no more than that in memory, for example 2GB; the rest is put aside on disk.",
)
@options.worker_options(
    "drive, network, point map and OUT", "; OUT in S3 with the same environment"
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
      hdmap build path/to/drive -o map --workers 8
      hdmap build path/to/drive -o s3://bucket/maps/monday

    A build that was killed goes on after its last commit when the same command is given
    again, and ends with the same map. The map is a versioned repository of counts; read it with `hdmap vectorize`,
    `hdmap compare` and `hdmap info`, add maps with `hdmap merge`.
    """
    from hdmap_tools.building import build_alone
    from hdmap_tools.steps import Steps

    config = options.resolve_config(given, association__also=[], export__formats=[])
    cache = options.label_cache(given["cache_folder"], given["no_cache"])
    if given["repair"]:
        _repair(ctx, given, config, cache)
        return
    with options.ImageProgress(ctx.obj["progress"]) as segmented:
        report = build_alone(
            given["drive"],
            given["out"],
            config,
            like=given["like"],
            cache=cache,
            overwrite=given["overwrite"],
            resume=given["resume"],
            workers=options.workers_of(given),
            memory=_memory(given),
            steps=Steps(segmented),
        )
    options.write_json(given["json_path"], report, overwrite=given["overwrite"])
    click.echo(
        f"{report['drive']}: {report['num_images']} images fused into {report['num_tiles']} tiles at "
        f"{given['out']} in {sum(report['seconds'].values()):.1f} s"
    )


def _repair(
    ctx: click.Context, given: dict[str, Any], config: Config, cache: LabelCache | None
) -> None:
    from hdmap_tools.repair import repair_map
    from hdmap_tools.steps import Steps

    with options.ImageProgress(ctx.obj["progress"]) as segmented:
        report = repair_map(
            given["drive"], given["out"], config, cache=cache, steps=Steps(segmented)
        )
    options.write_json(given["json_path"], report, overwrite=given["overwrite"])
    number = len(report["damaged"])
    click.echo(
        f"{given['out']}: {report['num_tiles']} tiles, {number} damaged"
        + (f", counted again from {report['num_images']} images" if number else "")
    )


def _memory(given: dict[str, Any]) -> MemoryBudget | None:
    from hdmap_tools.memory_budget import MemoryBudget

    if given["memory"] is None:
        return None
    if given["workers"] is not None or given["scheduler"] is not None:
        raise click.UsageError("--memory is of one process; with --workers give --worker-memory.")
    return MemoryBudget(options.parse_bytes("--memory", given["memory"]))
