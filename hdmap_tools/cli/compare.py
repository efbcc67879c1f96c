"""`hdmap compare`: a semantic map against a reference."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("candidate", type=options.MAP)
@click.argument("reference", type=options.PATH)
@click.option("--picture", type=options.PATH, help="PNG of agreement, misses and false alarms.")
@click.option(
    "--drive", type=options.PATH, help="The drive; only cells near its path are compared (40 m)."
)
@click.option(
    "--max-range",
    type=float,
    help="How near to the driven path, metres; needs --drive [default: 40].",
)
@click.option("--confusion", type=options.PATH, help="Confusion matrix to read the map with.")
@options.drive_options
@options.overwrite_option
@options.json_option
@options.config_options
def command(**given: Any) -> None:
    """Hold a semantic map against a reference, where the map has evidence.

    \b
    Examples:
      hdmap compare out/semantic_map drivable_mask.png --picture agreement.png
      hdmap compare map reference.osm --json scores.json --drive path/to/drive --max-range 25

    CANDIDATE is a semantic map; REFERENCE a mask PNG with its JSON, or a vector map.
    """
    if given["max_range"] is not None and given["drive"] is None:
        raise click.UsageError(
            "--max-range counts from the driven path: give the drive too, with --drive."
        )
    from hdmap_tools.single_steps import compare_alone

    config = options.resolve_config(given)
    comparison = compare_alone(
        given["candidate"],
        given["reference"],
        config,
        drive_path=given["drive"],
        picture=given["picture"],
        overwrite=given["overwrite"],
    )
    options.write_json(given["json_path"], comparison.to_json(), overwrite=given["overwrite"])
    click.echo(
        f"{comparison.num_cells} cells ({comparison.area_m2:.0f} m2) against {comparison.reference}"
    )
    for name, score in comparison.groups.items():
        figures = {"IoU": score.iou, "recall": score.recall, "precision": score.precision}
        shown = ", ".join(f"{k} {'-' if v is None else f'{v:.3f}'}" for k, v in figures.items())
        click.echo(f"{name}: {shown}")
    if comparison.miou is not None:
        click.echo(f"mIoU {comparison.miou:.3f}")
