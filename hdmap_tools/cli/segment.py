"""`hdmap segment`: label images of a drive."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("drive", type=options.PATH)
@click.option("-o", "--out", type=options.PATH, required=True, help="Folder to make.")
@options.drive_options
@options.segmentation_options
@options.network_options
@click.option("--overlays", is_flag=True, help="Also write pictures with the labels' colours.")
@options.overwrite_option
@options.json_option
@options.config_options
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Write label images of a drive's images.

    \b
    Examples:
      hdmap segment path/to/drive -o labels --model street-small --overlays
      hdmap segment path/to/drive -o labels --model net.onnx --label-set labels.json
      hdmap run path/to/drive -o out --labels labels

    Writes OUT/CAMERA/TIMESTAMP_NS.png (uint8 ids), OUT/label_set.json (what the ids
    mean), OUT/model.json (what made them), OUT/confusion.json (where it came with the
    model) and with --overlays OUT/overlays/CAMERA/TIMESTAMP_NS.jpg.

    Label images belong to the images as recorded. Of a camera with distortion the network
    sees the rectified image, and each recorded pixel takes the label of the rectified pixel
    in its direction; 255 where that shows nothing.
    """
    from hdmap_tools.label_folder import write_label_folder
    from hdmap_tools.opening import open_configured, require_images
    from hdmap_tools.segmentation.open_segmenter import open_segmenter

    config = options.resolve_config(given)
    drive = open_configured(config, given["drive"])
    require_images(drive)
    segmenter = open_segmenter(config.segmentation, drive)
    with options.ImageProgress(ctx.obj["progress"]) as segmented:
        report = write_label_folder(
            drive,
            segmenter,
            given["out"],
            config,
            cache=options.label_cache(given["cache_folder"], given["no_cache"]),
            overwrite=given["overwrite"],
            overlays=given["overlays"],
            progress=segmented,
        )
    options.write_json(given["json_path"], report, overwrite=given["overwrite"])
    shares = ", ".join(f"{name} {share:.1%}" for name, share in report["pixel_share"].items())
    click.echo(
        f"{report['num_images']} label images of {segmenter.name} ({segmenter.label_set.name}) in "
        f"{given['out']}, {report['ms_per_image']:.0f} ms an image: {shares}"
    )
