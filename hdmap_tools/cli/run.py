"""`hdmap run`: all steps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hdmap_tools.cli import options

if TYPE_CHECKING:
    from hdmap_tools.run_metrics import RunMetrics


@click.command()
@click.argument("drive", type=options.PATH)
@click.option("-o", "--out", type=options.PATH, required=True, help="Folder to make.")
@options.drive_options
@options.segmentation_options
@options.association_option
@click.option(
    "--also",
    multiple=True,
    type=click.Choice(options.METHODS),
    help="Build this method's map too, to compare with; repeatable [default: sparse and planar].",
)
@options.resolution_option
@options.confusion_option
@options.vectorizer_option
@click.option(
    "--reference", type=options.PATH, help="Mask PNG (with JSON) or vector map to compare with."
)
@options.origin_option
@options.overwrite_option
@options.json_option
@options.config_options
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> int:
    """Turn a drive into a map.

    \b
    Examples:
      hdmap run path/to/nuscenes -o out --model road-segmentation-adas-0001.xml
      hdmap run path/to/av2/log -o out --labels labels --label-set cityscapes

    Writes semantic_map, features.gpkg, lanelet2_map.osm, overview.png, metrics.json
    and hdmap.yaml (the configuration used) into the folder OUT.
    """
    from hdmap_tools.cli.main import EXIT_PLUGIN_FAILED
    from hdmap_tools.pipeline import run
    from hdmap_tools.steps import Steps

    config = options.resolve_config(given)
    with options.ImageProgress(ctx.obj["progress"]) as segmented:
        result = run(
            given["drive"],
            given["out"],
            config,
            cache=options.label_cache(given["cache_folder"], given["no_cache"]),
            overwrite=given["overwrite"],
            steps=Steps(segmented),
        )
    options.write_json(given["json_path"], result.metrics.to_json(), overwrite=given["overwrite"])
    click.echo(summary(result.metrics, given["out"]))
    for failure in result.failures:
        click.echo(f"Error: {failure.describe()}", err=True)
    return EXIT_PLUGIN_FAILED if result.failures else 0


def summary(metrics: RunMetrics, out: Path) -> str:
    """A few lines for people."""
    elements = ", ".join(f"{n} {name}" for name, n in metrics.num_elements.items()) or "no elements"
    lines = [
        f"{metrics.drive}: {metrics.num_images} images, {metrics.num_tiles} tiles, {elements}",
    ]
    for method, comparison in metrics.comparisons.items():
        for name, score in comparison.groups.items():
            if score.iou is not None:
                lines.append(
                    f"{method}: {name} IoU {score.iou:.3f}, precision {score.precision or 0.0:.3f}, "
                    f"recall {score.recall or 0.0:.3f} over {comparison.num_cells} cells "
                    f"({comparison.reference})"
                )
    lines.append(f"{sum(metrics.seconds.values()):.1f} s; look at {out / 'overview.png'}")
    return "\n".join(lines)
