"""`hdmap simulate`: a drive through a map, with exact truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from hdmap_tools.cli import options
from hdmap_tools.cli.simulation import SimulationProgressBars, settings_of, world_path

if TYPE_CHECKING:
    from hdmap_tools.simulate.settings import SimulationSettings


class _ImageSize(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    name = "WxH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        width, _, height = str(value).lower().partition("x")
        if not (width.isascii() and width.isdecimal() and height.isascii() and height.isdecimal()):
            self.fail(f"{value!r} is not WIDTHxHEIGHT in pixels, for example 960x600.", param, ctx)
        return int(width), int(height)


@click.command()
@click.argument("world", type=options.PATH)
@click.option("-o", "--out", type=options.PATH, required=True, help="Folder to make.")
@click.option("--seed", type=int, help="Everything random follows from it [default: 0].")
@click.option(
    "--world-seed", type=int, help="Same place for drives of other seeds [default: the seed]."
)
@click.option("--length-m", type=float, help="Length of the route [default: 300].")
@click.option("--start", help="Lane id, or X,Y in the city frame [default: chosen by the seed].")
@click.option(
    "--weather",
    type=click.Choice(["clear", "overcast", "haze", "wet", "dusk"]),
    help="Light and air [default: clear].",
)
@click.option(
    "--difficulty",
    type=click.Choice(["easy", "default", "hard"]),
    help="Wear of paint, traffic, dirt, image noise [default: default].",
)
@click.option(
    "--camera-rig",
    type=click.Choice(["front", "front3", "ring6"]),
    help="Cameras: one ahead, three ahead, six around [default: front].",
)
@click.option(
    "--lidar",
    type=click.Choice(["none", "vlp16", "rings32", "rings64"]),
    help="Ring geometry [default: rings32].",
)
@click.option("--camera-hz", type=float, help="Images a second of each camera [default: 5].")
@click.option("--lidar-hz", type=float, help="Sweeps a second [default: 10].")
@click.option(
    "--camera-height-m", type=float, help="Cameras' height over the ground [default: 1.55]."
)
@click.option("--speed", type=float, help="m/s on straight roads [default: 8].")
@click.option("--image-size", type=_ImageSize(), help="Pixels of each camera [default: 960x600].")
@click.option("--pose-noise-m", type=float, help="Noise of given positions, one sigma an axis.")
@click.option("--pose-noise-deg", type=float, help="Noise of given attitudes.")
@click.option("--pose-drift-m", type=float, help="Slow drift of given positions after 100 m.")
@click.option("--pose-drift-deg", type=float, help="Slow drift of given attitudes after 100 m.")
@click.option("--calibration-error-m", type=float, help="Error of given mounts, one sigma an axis.")
@click.option("--calibration-error-deg", type=float, help="Error of given mounts' attitudes.")
@click.option(
    "--true-map/--no-true-map",
    default=None,
    help="Write truth's raster and vector map, or its label images alone [default: write].",
)
@options.origin_option
@options.overwrite_option
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Drive through a map: images, lidar sweeps, poses, and their exact truth.

    \b
    Examples:
      hdmap simulate demo_town -o drive
      hdmap simulate map.osm -o drive --length-m 500 --weather wet --camera-rig front3
      hdmap simulate demo_town -o images --lidar none --no-true-map --camera-hz 1
      hdmap run drive -o out --labels drive/truth/label_images

    WORLD is a Lanelet2 file (.osm), an Argoverse 2 map (log_map_archive_*.json or the
    folder that holds one), or the name of a world that comes with the package. DRIVE has
    the layout of an Argoverse 2 sensor log; DRIVE/truth holds label images, a raster and
    a vector map, and the poses without the errors that the --pose and --calibration
    options put on those that are given. Who wants pictures to train a network on leaves
    lidar and true map out and saves half of the time.
    """
    settings = _settings(given)
    origin = None
    if given["origin"] is not None:
        lat, lon, alt = options.parse_origin(given["origin"])
        origin = (lat, lon, alt)
    from hdmap_tools.readers.av2 import read_av2
    from hdmap_tools.simulate.drive import simulate_drive

    world = world_path(given["world"])
    with SimulationProgressBars(ctx.obj["progress"]) as told:
        out = simulate_drive(
            world,
            given["out"],
            settings,
            origin=origin,
            overwrite=given["overwrite"],
            progress=told,
        )
    drive = read_av2(out)
    click.echo(
        f"{drive.trajectory.length_m:.0f} m through {world.name}: {len(drive.images)} images, "
        f"{len(drive.sweeps)} sweeps in {out}; true labels in {out / 'truth' / 'label_images'}"
    )


_FIELD_OF_OPTION = {
    "seed": "seed",
    "world_seed": "world_seed",
    "length_m": "length_m",
    "start": "start",
    "weather": "weather",
    "difficulty": "difficulty",
    "camera_rig": "camera_rig",
    "lidar": "lidar",
    "camera_height_m": "camera_height_m",
    "true_map": "true_map",
    "camera_hz": "camera_hz",
    "lidar_hz": "lidar_hz",
    "speed": "speed_mps",
    "calibration_error_m": "calibration_error_m",
    "calibration_error_deg": "calibration_error_deg",
}
_POSE_OPTIONS = ("noise_m", "noise_deg", "drift_m", "drift_deg")


def _settings(given: dict[str, Any]) -> SimulationSettings:
    document: dict[str, Any] = {field: given[name] for name, field in _FIELD_OF_OPTION.items()}
    if given["image_size"] is not None:
        document["image_width_px"], document["image_height_px"] = given["image_size"]
    document["pose_errors"] = {name: given[f"pose_{name}"] for name in _POSE_OPTIONS}
    return settings_of(document)
