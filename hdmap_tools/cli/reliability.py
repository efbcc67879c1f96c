"""`hdmap reliability`: whether a map's probabilities mean what they say."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("semantic_map", type=options.MAP)
@click.option(
    "--truth",
    type=options.PATH,
    required=True,
    help="Truth raster of a simulated drive (truth/raster), mask PNG with its JSON, or vector map.",
)
@click.option("-o", "--out", type=options.PATH, required=True, help="Folder to make.")
@click.option(
    "--paint-share",
    type=click.FloatRange(0.0, 1.0),
    default=0.35,
    show_default=True,
    help="Truth raster: share of a cell that must be paint for it to be lane mark; 0: any.",
)
@click.option(
    "--block-m",
    type=click.FloatRange(0.0, min_open=True),
    default=20.0,
    show_default=True,
    help="Side of the squares that are fitted on or tried on in turn, metres.",
)
@options.confusion_option
@options.overwrite_option
@options.json_option
@options.config_options
def command(**given: Any) -> None:
    """Hold a map's probabilities against truth, and fit the temperature that makes them true.

    \b
    Examples:
      hdmap reliability map --truth simulated/truth/raster -o reliability
      hdmap reliability map --truth drivable_mask.png -o reliability --confusion confusion.json

    The temperature is fitted on half of the area and tried on the other half. The folder
    holds the figures (JSON) and a diagram (PNG).
    """
    from hdmap_tools.map_reliability import PICTURE_NAME, reliability_alone

    config = options.resolve_config(given)
    report = reliability_alone(
        given["semantic_map"],
        given["truth"],
        given["out"],
        config,
        paint_share=given["paint_share"],
        block_m=given["block_m"],
        overwrite=given["overwrite"],
    )
    options.write_json(given["json_path"], report.to_json(), overwrite=given["overwrite"])
    for name, curve in (("as read", report.before), ("fitted", report.after)):
        click.echo(
            f"{name}: ECE {curve.ece:.4f} (equal mass {curve.ece_equal_mass:.4f}), NLL {curve.nll:.4f}, "
            f"Brier {curve.brier:.4f}, {curve.accuracy:.3f} of {curve.num_cells} cells right"
        )
    click.echo(
        f"Temperature {report.temperature:.4g}: --set observation.temperature={report.temperature:.4g}"
    )
    shares = ", ".join(f"{name} {share:.3f}" for name, share in report.class_shares.items())
    click.echo(f"True shares where it was fitted, to hold against observation.priors: {shares}")
    click.echo(f"Diagram: {given['out'] / PICTURE_NAME}")
