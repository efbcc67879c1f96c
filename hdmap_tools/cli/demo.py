"""`hdmap demo`: everything once, on a drive that is simulated for it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import click

from hdmap_tools.cli import options
from hdmap_tools.cli.simulation import SimulationProgressBars, settings_of, world_path

WORLD: Final = "demo_town"
DRIVE: Final = "drive"
MAP: Final = "map"


@click.command()
@click.option(
    "-o",
    "--out",
    type=options.PATH,
    default=Path("demo"),
    show_default=True,
    help="Folder to make.",
)
@click.option(
    "--length-m", type=float, default=300.0, show_default=True, help="Length of the drive."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of all that is random.")
@options.overwrite_option
@click.pass_context
def command(ctx: click.Context, /, out: Path, length_m: float, seed: int, overwrite: bool) -> int:
    """Simulate a short drive, map it, and hold the map against the truth.

    \b
    Examples:
      hdmap demo
      hdmap demo -o demo --length-m 100

    Writes OUT/drive (images, sweeps, poses, truth) and OUT/map (what `hdmap run` writes);
    labels come from the network that ships, or else from true ones with errors.
    """
    from hdmap_tools.cli.main import EXIT_PLUGIN_FAILED
    from hdmap_tools.cli.run import summary
    from hdmap_tools.config import load_config
    from hdmap_tools.output_folder import is_result_of, require_free
    from hdmap_tools.pipeline import run
    from hdmap_tools.segmentation.shipped import network_for_simulated_drives
    from hdmap_tools.simulate.drive import simulate_drive
    from hdmap_tools.steps import Steps

    settings = settings_of({"length_m": length_m, "seed": seed})
    config = load_config(
        None, {"segmentation.model": network_for_simulated_drives(), "association.method": "dense"}
    )
    # Two results in one folder: the map's hdmap.yaml names the drive by its final place.
    for name, made_by in ((DRIVE, "simulate"), (MAP, "run")):
        require_free(out / name, overwrite, is_result_of(made_by))
    with SimulationProgressBars(ctx.obj["progress"]) as told:
        drive = simulate_drive(
            world_path(Path(WORLD)), out / DRIVE, settings, overwrite=overwrite, progress=told
        )
    with options.ImageProgress(ctx.obj["progress"]) as segmented:
        result = run(drive, out / MAP, config, overwrite=overwrite, steps=Steps(segmented))
    click.echo(summary(result.metrics, out / MAP))
    click.echo(
        f"SIMULATED data. The drive is in {out / DRIVE}, its truth in {out / DRIVE / 'truth'};"
    )
    click.echo(f"the Lanelet2 file is {out / MAP / 'lanelet2_map.osm'}, pictures are beside it.")
    for failure in result.failures:
        click.echo(f"Error: {failure.describe()}", err=True)
    return EXIT_PLUGIN_FAILED if result.failures else 0
