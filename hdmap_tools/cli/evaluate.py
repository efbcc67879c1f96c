"""`hdmap evaluate`: the paper's experiment on simulated drives."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options
from hdmap_tools.cli.simulation import SimulationProgressBars, settings_of, world_path


@click.command()
@click.argument("worlds", metavar="WORLD...", nargs=-1, required=True, type=options.PATH)
@click.option("-o", "--out", type=options.PATH, required=True, help="Folder to make.")
@click.option(
    "--preset", type=click.Choice(["paz2020"]), default="paz2020", help="Experiment to repeat."
)
@click.option(
    "--calibration",
    multiple=True,
    type=options.PATH,
    help="Simulated drive to measure confusion, intensity and temperature on; repeatable.",
)
@click.option(
    "--length-m", type=float, help="Length of the simulated drive [default: the preset's]."
)
@click.option("--start", help="Lane id, or X,Y, where the simulated drive starts.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the simulated drives.")
@click.option(
    "--difficulty", type=click.Choice(["easy", "default", "hard"]), help="Of the simulated drives."
)
@click.option("--pose-noise-m", type=float, help="Noise of the given positions, one sigma an axis.")
@click.option("--pose-noise-deg", type=float, help="Noise of the given attitudes.")
@options.segmentation_options
@options.resolution_option
@options.overwrite_option
@options.config_options
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Measure the paper's methods and ours on simulated drives with exact truth.

    \b
    Examples:
      hdmap evaluate demo_town -o evaluated --length-m 300
      hdmap evaluate map.osm -o evaluated --model simulated
      hdmap evaluate drive -o evaluated --calibration other_drive

    WORLD is a map to simulate drives in (as for `hdmap simulate`) or a simulated drive; of
    several the figures over all their cells are printed too. Labels come from --model, by
    default from the network that ships, or else from `simulated`: true ones with errors. The
    confusion is measured on other drives than the evaluated one. OUT holds the tables
    (evaluation.txt, .json, .csv), the measured confusion matrix and pictures.
    """
    from hdmap_tools.evaluate.run import PRESETS, evaluate_all, pooled_text
    from hdmap_tools.segmentation.shipped import network_for_simulated_drives
    from hdmap_tools.steps import Steps

    preset = PRESETS[given["preset"]]
    fixed: dict[str, Any] = {}
    if given["resolution"] is None:
        fixed["fusion__resolution_m"] = preset.resolution_m
    if given["model"] is None:
        fixed["segmentation__model"] = network_for_simulated_drives()
    config = options.resolve_config(given, **fixed)
    settings = settings_of(
        {
            "seed": given["seed"],
            "length_m": preset.length_m if given["length_m"] is None else given["length_m"],
            "start": given["start"],
            "difficulty": given["difficulty"],
            "pose_errors": {"noise_m": given["pose_noise_m"], "noise_deg": given["pose_noise_deg"]},
        },
    )
    with (
        options.ImageProgress(ctx.obj["progress"]) as segmented,
        SimulationProgressBars(ctx.obj["progress"]) as simulated,
    ):
        evaluations = evaluate_all(
            [world_path(world) for world in given["worlds"]],
            given["out"],
            config,
            preset,
            settings,
            calibration=given["calibration"],
            cache=options.label_cache(given["cache_folder"], given["no_cache"]),
            overwrite=given["overwrite"],
            steps=Steps(segmented),
            progress=simulated,
        )
    for evaluation in evaluations:
        click.echo(evaluation.to_text())
    if len(evaluations) > 1:
        click.echo(pooled_text(evaluations))
    click.echo(f"Pictures and tables are in {given['out']}.")
