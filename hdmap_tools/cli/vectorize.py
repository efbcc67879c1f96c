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
@options.overwrite_option
@options.json_option
@options.config_options
def command(**given: Any) -> int:
    """Run vectorizer plugins over a semantic map.

    \b
    Examples:
      hdmap vectorize out/semantic_map -o features.gpkg
      hdmap vectorize map -o marks.gpkg --vectorizer lane_mark_skeleton
    """
    from hdmap_tools.cli.main import EXIT_PLUGIN_FAILED
    from hdmap_tools.single_steps import vectorize_alone

    config = options.resolve_config(given)
    result = vectorize_alone(
        given["semantic_map"], given["out"], config, overwrite=given["overwrite"]
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
