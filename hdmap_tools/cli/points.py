"""`hdmap points`: drives into a dense point map."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("sources", metavar="DRIVE...", type=options.PATH, nargs=-1, required=True)
@click.option("-o", "--out", type=options.PATH, required=True, help="Point map to make.")
@options.drive_options
@click.option(
    "--refine-poses/--no-refine-poses",
    default=None,
    help="Register the sweeps to the map, and several drives to one another [default: do].",
)
@click.option(
    "--export",
    "exports",
    type=options.PATH,
    multiple=True,
    help="Also write all points to this .pcd, .ply, .las or .laz file; repeatable.",
)
@options.worker_options("drives and OUT")
@options.origin_option
@options.overwrite_option
@options.json_option
@options.config_options
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Turn drives into a dense point map.

    \b
    Examples:
      hdmap points path/to/drive -o points --export points.laz
      hdmap points monday/drive friday/drive -o points
      hdmap points path/to/drive -o points --workers 8

    DRIVE may also be a point cloud of the place (.pcd, .ply, .las, .laz). The folder OUT
    holds thinned points without what moved, the ground, and the poses; `hdmap run DRIVE
    --points OUT` maps with it.
    """
    from hdmap_tools.point_map.make import make_points

    config, workers = options.resolve_config(given), options.workers_of(given)
    with options.ImageProgress(ctx.obj["progress"], "sweeps") as told:
        report = make_points(
            given["sources"],
            given["out"],
            config,
            exports=given["exports"],
            overwrite=given["overwrite"],
            workers=workers,
            progress=told,
        )
    options.write_json(given["json_path"], report, overwrite=given["overwrite"])
    click.echo(summary(report, given["out"]))


def summary(report: dict[str, Any], out: Path) -> str:
    """A few lines for people."""
    sizes = f"{report['num_points']} points in {report['num_tiles']} tiles"
    lines = [f"{', '.join(report['sources'])}: {sizes} at {out} in {report['seconds']:.1f} s"]
    for drive, moved in report["refined_poses"].items():
        lines.append(f"{drive}: poses {_refinement(moved, report['refinement'].get(drive))}")
    return "\n".join(lines)


def _refinement(is_changed: bool, found: dict[str, Any] | None) -> str:
    """What became of a drive's poses, by how much and why; `found` as `RefineReport`."""
    if found is None:
        return "as given, refinement was not asked for"
    if not is_changed:
        return f"as given: {found['reason'] or 'nothing to refine'}"
    by = f"{100 * found['correction_m']:.1f} cm and {found['correction_deg']:.3f} degrees RMS"
    sweeps = f"{found['num_registered']} of {found['num_sweeps']} sweeps registered"
    held = ", ".join(
        name if share >= _HELD else f"{name} in {share:.0%} of sweeps"
        for name, share in found["held"].items()
        if share > 0.0
    )
    because = f" ({found['reason']})" if found["reason"] else ""
    return f"refined by {by}, {sweeps}; held: {held}{because}"


_HELD: Final = 0.995
"""From this share of sweeps on, a direction is said to be held without a number."""
