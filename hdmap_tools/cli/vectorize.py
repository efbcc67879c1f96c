"""`hdmap vectorize`: vectorizer plugins over a semantic map."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("semantic_map", type=options.MAP)
@click.option("-o", "--out", type=options.PATH, required=True, help="GeoPackage to make.")
@options.vectorizer_option
@options.confusion_option
@click.option(
    "--window",
    type=float,
    help="Side of the windows that a large map is vectorized in, metres [default: 100].",
)
@options.worker_options("the map", "; a map in S3 with the same environment")
@options.overwrite_option
@options.json_option
@options.config_options
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> int:
    """Run vectorizer plugins over a semantic map.

    \b
    Examples:
      hdmap vectorize out/semantic_map -o features.gpkg
      hdmap vectorize map -o marks.gpkg --vectorizer lane_mark_skeleton
      hdmap vectorize city -o city.gpkg --workers 8

    A map that is larger than two windows with what plugins must see around them is vectorized
    window by window, and lines and areas that cross a seam are put together again.
    """
    from hdmap_tools.cli.main import EXIT_PLUGIN_FAILED
    from hdmap_tools.single_steps import vectorize_alone

    config = options.resolve_config(given)
    with options.ImageProgress(ctx.obj["progress"], "windows") as told:
        result = vectorize_alone(
            given["semantic_map"],
            given["out"],
            config,
            overwrite=given["overwrite"],
            workers=options.workers_of(given),
            told=told,
        )
    counts = result.vector_map.counts()
    options.write_json(
        given["json_path"],
        {
            "num_elements": counts,
            "plugins": result.vector_map.provenance.get("plugins", []),
            "failures": {failure.name: failure.message for failure in result.failures},
        },
        overwrite=given["overwrite"],
    )
    click.echo(
        f"{', '.join(f'{n} {name}' for name, n in counts.items()) or 'No elements'} in {given['out']}"
    )
    for failure in result.failures:
        click.echo(f"Error: {failure.describe()}", err=True)
    return EXIT_PLUGIN_FAILED if result.failures else 0
