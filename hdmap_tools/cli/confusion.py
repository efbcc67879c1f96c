"""`hdmap confusion`: how often a network takes one thing for another."""

from __future__ import annotations

from typing import Any

import click

from hdmap_tools.cli import options


@click.command()
@click.argument("images", type=options.PATH)
@click.argument("masks", type=options.PATH)
@click.option(
    "-o", "--out", type=options.PATH, required=True, help="Confusion matrix (JSON) to make."
)
@click.option("--model", type=options.PATH, required=True, help="ONNX or OpenVINO model.")
@click.option("--profile", help="How to feed the model, where it is not known: name or JSON file.")
@click.option("--mask-labels", required=True, help="Label set of the masks: a name or a JSON file.")
@click.option("--mask-suffix", default="", help="What mask names have more than image names.")
@click.option(
    "--mask-divisor", default=1, show_default=True, help="Mask value divided by this is the id."
)
@click.option("--ignore", multiple=True, help="Label of the masks that says nothing; repeatable.")
@click.option("--source", default="", help="Where images and masks come from; kept in the file.")
@options.overwrite_option
def command(**given: Any) -> None:
    """Measure a network's confusion matrix on annotated images.

    \b
    Examples:
      hdmap confusion images masks -o confusion.json --model m.xml --mask-labels cityscapes
      hdmap confusion waymo waymo -o c.json --model m.xml --mask-labels waymo-panoptic \\
          --mask-suffix _panoptic --mask-divisor 1000
    """
    from hdmap_tools.formats.atomic import atomic_output
    from hdmap_tools.labels.label_set import load_label_set
    from hdmap_tools.segmentation.measure_confusion import confusion_from_folders
    from hdmap_tools.segmentation.open_segmenter import open_model

    with atomic_output(given["out"], given["overwrite"]) as temporary:
        matrix = confusion_from_folders(
            given["images"],
            given["masks"],
            open_model(given["model"], given["profile"], {}),
            load_label_set(given["mask_labels"]),
            mask_suffix=given["mask_suffix"],
            divisor=given["mask_divisor"],
            ignore=given["ignore"],
            source=given["source"],
        )
        temporary.write_text(matrix.to_json(), encoding="utf-8")
    for map_class, agreement in matrix.class_agreement().items():
        click.echo(
            f"{map_class}: IoU {agreement.iou:.3f}, recall {agreement.recall:.3f}, "
            f"precision {agreement.precision:.3f}"
        )
