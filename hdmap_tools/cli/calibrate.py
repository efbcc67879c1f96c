"""`hdmap calibrate`: intrinsics from a chessboard, extrinsics from pairs, and a look at both."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from hdmap_tools.cli import options


@click.group()
def command() -> None:
    """Find a camera's lens and mount, and check them by eye.

    \b
    Examples:
      hdmap calibrate intrinsics photos --board 9x6 --square-m 0.1 -o lens
      hdmap calibrate extrinsics pairs.csv --camera lens -o mount
      hdmap calibrate check path/to/drive --calibration mount -o check.png

    Results hold `calibration/` as an Argoverse 2 log has it, and report.json.
    """


@command.command(short_help="Focal length and distortion from photos of a chessboard.")
@click.argument("images", metavar="IMAGES...", type=options.PATH, nargs=-1, required=True)
@click.option("--board", required=True, metavar="COLSxROWS", help="Inner corners, for example 9x6.")
@click.option("--square-m", type=float, required=True, help="Side of a square, metres.")
@click.option("-o", "--out", type=options.PATH, required=True, help="Folder to make.")
@click.option("--name", default="camera", show_default=True, help="Name of the camera.")
@click.option(
    "--add-to", type=options.PATH, help="Calibration or drive whose other sensors are kept."
)
@options.overwrite_option
@click.pass_context
def intrinsics(ctx: click.Context, /, **given: Any) -> None:
    """Find focal length, principal point and distortion from pictures of a chessboard.

    \b
    Examples:
      hdmap calibrate intrinsics photos --board 9x6 --square-m 0.1 -o lens
      hdmap calibrate intrinsics a.png b.png c.png d.png --board 9x6 --square-m 0.1 -o lens

    IMAGES are pictures as the camera gives them, or folders of them; 10 to 20, with the board
    tilted by 20 to 45 degrees to several sides, and all over the picture. A board of 9x6 inner
    corners has 10 by 7 squares. OUT gets calibration/, report.json and coverage.png.
    """
    from hdmap_tools.calibration.chessboard import Board
    from hdmap_tools.calibration.make import make_intrinsics

    board = Board.from_text(given["board"], given["square_m"])
    with options.ImageProgress(ctx.obj["progress"]) as told:
        report = make_intrinsics(
            given["images"],
            board,
            given["out"],
            name=given["name"],
            add_to=given["add_to"],
            overwrite=given["overwrite"],
            progress=told,
        )
    click.echo(_intrinsics_summary(report, given["out"]))


@command.command(short_help="Where a camera sits, from pairs of lidar points and pixels.")
@click.argument("pairs", metavar="PAIRS.csv", type=options.PATH)
@click.option(
    "--camera",
    "camera_path",
    type=options.PATH,
    required=True,
    help="Its intrinsics: an earlier result, a calibration folder, or a drive.",
)
@click.option("-o", "--out", type=options.PATH, required=True, help="Folder to make.")
@click.option("--name", help="Which camera, where there are several.")
@click.option(
    "--lidar", help="Sensor in whose frame the points are [default: the vehicle's frame]."
)
@click.option(
    "--max-error-px",
    type=float,
    default=5.0,
    show_default=True,
    help="Pairs further off are wrong.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the random samples.")
@options.overwrite_option
def extrinsics(**given: Any) -> None:
    """Find where a camera sits from pairs of lidar points and pixels.

    \b
    Examples:
      hdmap calibrate extrinsics pairs.csv --camera lens -o mount
      hdmap calibrate extrinsics pairs.csv --camera path/to/log --name ring_front_center --lidar up_lidar -o mount

    PAIRS.csv has the columns x_m,y_m,z_m,u_px,v_px, a pair a line; at least 6, better 15 or
    more, not all on one plane. Some may be wrong. OUT gets calibration/ and report.json.
    """
    from hdmap_tools.calibration.make import make_extrinsics

    report = make_extrinsics(
        given["pairs"],
        given["camera_path"],
        given["out"],
        name=given["name"],
        lidar=given["lidar"],
        max_error_px=given["max_error_px"],
        seed=given["seed"],
        overwrite=given["overwrite"],
    )
    click.echo(_extrinsics_summary(report, given["out"]))


@command.command(short_help="Draw the lidar into an image, for the eye.")
@click.argument("drive", type=options.PATH, required=False)
@click.option("-o", "--out", type=options.PATH, required=True, help="PNG to write.")
@click.option("--camera", help="Camera [default: the first by name that has images].")
@click.option(
    "--index", type=int, default=0, show_default=True, help="Which of its images, from 0."
)
@click.option(
    "--calibration",
    type=options.PATH,
    help="Take the camera from this result instead of the drive.",
)
@click.option("--image", type=options.PATH, help="Picture, where there is no drive.")
@click.option(
    "--points", type=options.PATH, help="Point cloud in the vehicle's frame, for --image."
)
@click.option(
    "--max-range-m", type=float, default=60.0, show_default=True, help="Furthest point drawn."
)
@click.option("--layout", default="auto", help="Layout of the drive, where it is not recognized.")
@click.option("--scene", help="Which drive of a data root: nuScenes scene, AV2 log.")
@options.overwrite_option
def check(**given: Any) -> None:
    """Draw the lidar into an image, coloured by range: edges must lie on edges.

    \b
    Examples:
      hdmap calibrate check path/to/drive --camera CAM_FRONT -o check.png
      hdmap calibrate check path/to/drive --calibration mount -o check.png
      hdmap calibrate check --image a.png --points a.pcd --calibration mount -o check.png

    Where the lidar sits higher than the camera it sees over things: points behind them show
    through, which is no error of the calibration.
    """
    from hdmap_tools.calibration.make import make_check, make_check_of_files

    of_files = [given["image"], given["points"]]
    if given["drive"] is not None and of_files == [None, None]:
        drawn = make_check(
            given["drive"],
            given["out"],
            name=given["camera"],
            calibration=given["calibration"],
            index=given["index"],
            scene=given["scene"],
            layout=given["layout"],
            max_range_m=given["max_range_m"],
            overwrite=given["overwrite"],
        )
    elif given["drive"] is None and None not in (*of_files, given["calibration"]):
        drawn = make_check_of_files(
            given["image"],
            given["points"],
            given["out"],
            given["calibration"],
            name=given["camera"],
            max_range_m=given["max_range_m"],
            overwrite=given["overwrite"],
        )
    else:
        raise click.UsageError("Give a DRIVE, or --image, --points and --calibration together.")
    click.echo(
        f"{drawn['camera']}: {drawn['num_drawn']} of {drawn['num_points']} points drawn into "
        f"{drawn['image']} at {given['out']}"
    )


def _intrinsics_summary(report: dict[str, Any], out: Path) -> str:
    camera, sigma = report["camera"], report["sigma"]
    held_out = report["held_out_rms_px"]
    lines = [
        f"{camera['name']}: {report['num_views']} views, {report['rms_px']:.3f} px RMS"
        + ("" if held_out is None else f", {held_out:.3f} px on views held out"),
        "  ".join(
            f"{key} {camera[f'{key}_px']:.2f} ± {sigma[key]:.2f} px"
            for key in ("fx", "fy", "cx", "cy")
        ),
        "  ".join(
            f"{key} {value:.5f} ± {sigma[key]:.5f}" for key, value in camera["distortion"].items()
        ),
    ]
    if lost := len(report["images_without_board"]):
        lines.append(f"no board found in {lost} images")
    return "\n".join([*lines, f"written to {out}"])


def _extrinsics_summary(report: dict[str, Any], out: Path) -> str:
    position = report["ego_SE3_cam"]["translation_m"]
    shifts = ", ".join(
        f"{axis} {value:.3f} ± {sigma:.3f}"
        for axis, value, sigma in zip("xyz", position, report["sigma_position_m"], strict=True)
    )
    turns = ", ".join(f"{sigma:.3f}" for sigma in report["sigma_rotation_deg"])
    return "\n".join(
        [
            f"{report['camera']['name']}: {report['num_used']} of {report['num_pairs']} pairs agree, "
            f"{report['rms_px']:.2f} px RMS",
            f"position m: {shifts}",
            f"turn about the camera's axes: ± {turns} degrees",
            f"written to {out}",
        ]
    )
