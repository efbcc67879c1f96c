"""`hdmap confusion`: how often a network takes one thing for another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hdmap_tools.cli import options

if TYPE_CHECKING:
    from hdmap_tools.segmentation.confusion import Agreement, ConfusionMatrix


@click.command()
@click.argument("images", type=options.PATH, required=False)
@click.argument("masks", type=options.PATH, required=False)
@click.option(
    "-o", "--out", type=options.PATH, required=True, help="Confusion matrix (JSON) to make."
)
@click.option("--model", type=options.PATH, help="ONNX or OpenVINO model.")
@click.option("--profile", help="How to feed the model, where it is not known: name or JSON file.")
@click.option("--mask-labels", help="Label set of the masks: a name or a JSON file.")
@click.option("--mask-suffix", default="", help="What mask names have more than image names.")
@click.option(
    "--mask-divisor", default=1, show_default=True, help="Mask value divided by this is the id."
)
@click.option("--ignore", multiple=True, help="Label of the masks that says nothing; repeatable.")
@click.option(
    "--drive",
    "drives",
    type=options.PATH,
    multiple=True,
    help="Measure on the images of this drive instead; repeatable, the counts add up.",
)
@click.option(
    "--truth",
    type=options.PATH,
    help="With --drive: true label PNGs, CAMERA/TIMESTAMP_NS.png [default: truth/label_images].",
)
@click.option(
    "--labels",
    "predictions",
    type=options.PATH,
    multiple=True,
    help="With --drive: predicted label PNGs, instead of a model; one for each drive.",
)
@click.option(
    "--label-set",
    help="What the ids in those predictions mean [default: label_set.json there].",
)
@click.option(
    "--range-bands",
    metavar="M,M,...",
    help="With --drive: also count by distance over level ground, for example 0,10,20,40.",
)
@click.option("--source", default="", help="Where images and masks come from; kept in the file.")
@options.drive_options
@options.overwrite_option
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Measure a network's confusion matrix on annotated images.

    \b
    Examples:
      hdmap confusion images masks -o confusion.json --model m.xml --mask-labels cityscapes
      hdmap confusion waymo waymo -o c.json --model m.xml --mask-labels waymo-panoptic \\
          --mask-suffix _panoptic --mask-divisor 1000
      hdmap confusion --drive simulated --labels predicted -o c.json --range-bands 0,10,20,40

    IMAGES and MASKS are folders. A simulated drive needs neither: its true labels lie in it.
    """
    from hdmap_tools.formats.atomic import atomic_output

    _check_usage(given)
    with atomic_output(given["out"], given["overwrite"]) as temporary:
        matrix = _of_drives(given, ctx) if given["drives"] else _of_folders(given)
        temporary.write_text(matrix.to_json(), encoding="utf-8")
    for map_class, agreement in matrix.class_agreement().items():
        click.echo(f"{map_class}: IoU {agreement.iou:.3f}, {_recall_and_precision(agreement)}")
    for name, agreement in matrix.label_agreement().items():
        click.echo(f"label {name}: {_recall_and_precision(agreement)}")
    for number, band in enumerate(matrix.bands):
        for map_class, agreement in matrix.of_band(number).class_agreement().items():
            click.echo(f"{band.name}, {map_class}: {_recall_and_precision(agreement)}")


def _recall_and_precision(agreement: Agreement) -> str:
    return f"recall {agreement.recall:.3f}, precision {agreement.precision:.3f}"


def _check_usage(given: dict[str, Any]) -> None:
    drives, predictions = given["drives"], given["predictions"]
    if not drives:
        missing = [
            what
            for what, is_there in (
                ("IMAGES and MASKS", given["images"] is not None and given["masks"] is not None),
                ("--model", given["model"] is not None),
                ("--mask-labels", given["mask_labels"] is not None),
            )
            if not is_there
        ]
        if missing:
            raise click.UsageError(f"Give {', '.join(missing)}; or a drive, with --drive.")
        idle = [name for name in ("truth", "range_bands", "label_set") if given[name] is not None]
        idle += ["labels"] if predictions else []
        if idle:
            raise click.UsageError(f"--{idle[0].replace('_', '-')} needs --drive.")
        return
    if given["images"] is not None:
        raise click.UsageError("IMAGES and MASKS or --drive, not both.")
    if (given["model"] is None) == (not predictions):
        raise click.UsageError("With --drive give either --model or --labels.")
    if predictions and len(predictions) != len(drives):
        raise click.UsageError(
            f"{len(drives)} drives need as many folders of --labels, found {len(predictions)}."
        )
    if given["truth"] is not None and len(drives) > 1:
        raise click.UsageError("--truth goes with one drive; others have theirs in truth/.")


def _of_folders(given: dict[str, Any]) -> ConfusionMatrix:
    from hdmap_tools.labels.label_set import load_label_set
    from hdmap_tools.segmentation.measure_confusion import confusion_from_folders
    from hdmap_tools.segmentation.open_segmenter import open_model

    return confusion_from_folders(
        given["images"],
        given["masks"],
        open_model(given["model"], given["profile"], {}),
        load_label_set(given["mask_labels"]),
        mask_suffix=given["mask_suffix"],
        divisor=given["mask_divisor"],
        ignore=given["ignore"],
        source=given["source"],
    )


def _of_drives(given: dict[str, Any], ctx: click.Context) -> ConfusionMatrix:
    from hdmap_tools.config import SegmentationConfig
    from hdmap_tools.drive_confusion import confusion_of_drive
    from hdmap_tools.labels.label_set import load_label_set
    from hdmap_tools.readers.open_drive import open_drive
    from hdmap_tools.segmentation.open_segmenter import open_segmenter

    edges = _edges_of(given["range_bands"])
    true_set = load_label_set(given["mask_labels"]) if given["mask_labels"] else None
    folders: tuple[Path | None, ...] = given["predictions"] or (None,) * len(given["drives"])
    total: ConfusionMatrix | None = None
    for path, labels in zip(given["drives"], folders, strict=True):
        drive = open_drive(path, given["layout"] or "auto", given["scene"], given["cameras"])
        config = SegmentationConfig(
            model=given["model"],
            profile=given["profile"],
            labels=labels,
            label_set=given["label_set"],
        )
        with options.ImageProgress(ctx.obj["progress"]) as told:
            one = confusion_of_drive(
                drive,
                open_segmenter(config, drive),
                truth=given["truth"],
                true_set=true_set,
                range_edges_m=edges,
                source=given["source"],
                told=told,
            )
        total = one if total is None else total + one
    assert total is not None
    return total


def _edges_of(text: str | None) -> tuple[float, ...]:
    from hdmap_tools.errors import ConfigError
    from hdmap_tools.segmentation.range_bands import check_edges

    if text is None:
        return ()
    try:
        edges = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"--range-bands {text!r}: expected distances in metres such as 0,10,20,40."
        ) from error
    check_edges(edges)
    return edges
