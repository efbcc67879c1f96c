"""`hdmap train`: teach a network on labelled images, and export what it learned."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hdmap_tools.cli import options

if TYPE_CHECKING:
    from hdmap_tools.segmentation.training.pairs import ImagePairs
    from hdmap_tools.segmentation.training.presets import TrainPreset
    from hdmap_tools.segmentation.training.run_settings import RunSettings


@click.command()
@click.argument("data", nargs=-1)
@click.option("-o", "--out", type=options.PATH, help="Folder of the run to make.")
@click.option(
    "--val",
    "validation",
    multiple=True,
    metavar="DATA",
    help="Images to be judged on, never learned from; repeatable.",
)
@click.option(
    "--preset", default="small", show_default=True, help="Recipe: small, or paz2020 (the paper's)."
)
@click.option(
    "--label-set",
    help="What the network shall tell apart: a name or a JSON file [default: the data's own labels].",
)
@click.option(
    "--epochs",
    type=click.IntRange(1),
    help="Times that each image is seen [default: the preset's].",
)
@click.option(
    "--max-minutes",
    type=click.FloatRange(0, min_open=True),
    help="Stop after so long, the learning rate lowered in time; with --epochs whichever is first.",
)
@click.option("--batch", type=click.IntRange(1), help="Images a step, over all processes.")
@click.option("--crop", type=click.IntRange(32), help="Side of the square crops, pixels.")
@click.option("--learning-rate", type=click.FloatRange(0, min_open=True), help="At its highest.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--threads", type=click.IntRange(1), help="CPU threads a process [default: all].")
@click.option(
    "--workers",
    default=1,
    show_default=True,
    type=click.IntRange(0),
    help="Threads that read and augment images.",
)
@click.option(
    "--no-pretrained", is_flag=True, help="Start from random weights; nothing is downloaded."
)
@click.option("--resume", is_flag=True, help="Go on where the run was stopped or killed.")
@click.option(
    "--export",
    "export",
    nargs=2,
    type=options.PATH,
    metavar="RUN OUT.onnx",
    help="Instead write the best weights of a run, with labels and confusion matrix, as ONNX.",
)
@click.option("--name", help="With --export: names the model [default: as the file].")
@options.overwrite_option
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Train a segmentation network on labelled images, or export a trained one to ONNX.

    \b
    Examples:
      hdmap train drive:town1 drive:town2 --val drive:town3 -o run --label-set street
      hdmap train -o run --resume
      hdmap train --export run street.onnx
      torchrun --nproc-per-node 4 --no-python hdmap train vistas:FOLDER:training \\
          --val vistas:FOLDER:validation -o run --preset paz2020

    DATA is KIND:FOLDER or KIND:FOLDER:SPLIT; kinds are drive, vistas, cityscapes and camvid.
    Needs `pip install 'hdmap_tools[train]'`.
    """
    from hdmap_tools.segmentation.training.extra import require_training

    _check_usage(given)
    require_training()
    if given["export"]:
        from hdmap_tools.segmentation.training.export_onnx import export_run

        run, out = given["export"]
        difference = export_run(run, out, name=given["name"], overwrite=given["overwrite"])
        size = out.stat().st_size / 1e6
        click.echo(f"{out}: {size:.2f} MB, scores within {difference:.1e} of the trained network's")
        return
    _train(given, ctx.obj["progress"])


def _check_usage(given: dict[str, Any]) -> None:
    if given["export"]:
        others = [name for name in ("data", "out", "validation", "resume") if given[name]]
        if others:
            raise click.UsageError("--export goes with --name and --overwrite only.")
        return
    if given["name"] is not None:
        raise click.UsageError("--name goes with --export.")
    if given["out"] is None:
        raise click.UsageError("Missing option '-o' / '--out': the folder of the run.")
    if given["resume"]:
        fixed = ("data", "validation", "label_set", "epochs", "max_minutes", "batch", "crop")
        others = [name for name in (*fixed, "learning_rate", "threads") if given[name]]
        if others or given["no_pretrained"]:
            raise click.UsageError(
                "--resume takes the run's own settings; give only -o and --workers with it."
            )
    elif not given["data"]:
        raise click.UsageError("Give DATA to learn from, for example drive:FOLDER.")


def _train(given: dict[str, Any], show: bool) -> None:
    from hdmap_tools.segmentation.training.run_settings import read_settings
    from hdmap_tools.segmentation.training.trainer import train

    run: Path = given["out"]
    is_first = os.environ.get("RANK", "0") == "0"
    if given["resume"]:
        settings = read_settings(run)
        train_pairs = _opened(settings.data, settings)
        val_pairs = _opened(settings.validation, settings)
    else:
        if is_first:
            _require_new_run(run, given["overwrite"])
        settings, train_pairs, val_pairs = _new_run(given)
    assert train_pairs is not None
    with options.progress_bars(show and is_first) as bars:
        task = bars.add_task("training", total=1000)
        train(
            run,
            train_pairs,
            val_pairs,
            settings,
            resume=given["resume"],
            workers=given["workers"],
            told=_say,
            stepped=lambda progress: bars.update(task, completed=int(1000 * progress)),
        )


def _say(row: dict[str, float]) -> None:
    ious = ", ".join(
        f"{name.removeprefix('iou ')} {value:.3f}"
        for name, value in row.items()
        if name.startswith("iou ") and value == value
    )
    judged = f", mIoU {row['miou']:.3f} ({ious})" if "miou" in row else ""
    click.echo(
        f"step {row['step']}, epoch {row['epoch']:.1f}, {row['minutes']:.1f} min: loss "
        f"{row['loss']:.3f}{judged}"
    )


def _require_new_run(run: Path, overwrite: bool) -> None:
    import shutil

    from hdmap_tools.errors import OutputExistsError
    from hdmap_tools.segmentation.training.run_settings import SETTINGS_NAME

    if not run.exists() or (run.is_dir() and not any(run.iterdir())):
        return
    if not (run / SETTINGS_NAME).is_file():
        raise OutputExistsError(f"{run} exists and is no run of hdmap train; choose another name.")
    if not overwrite:
        raise OutputExistsError(
            f"Run {run} exists; go on with it with --resume, or replace it with --overwrite."
        )
    shutil.rmtree(run)


def _new_run(given: dict[str, Any]) -> tuple[RunSettings, ImagePairs, ImagePairs | None]:
    import torch

    from hdmap_tools.errors import LabelError
    from hdmap_tools.labels.label_set import load_label_set
    from hdmap_tools.segmentation.training.pairs import open_pairs
    from hdmap_tools.segmentation.training.run_settings import RunSettings

    sources = [open_pairs(spec) for spec in given["data"]]
    if given["label_set"] is not None:
        labels = load_label_set(given["label_set"])
    else:
        sets = {pairs.label_set.name: pairs.label_set for pairs in sources}
        if len(sets) > 1:
            raise LabelError(
                f"The data are in several label sets ({', '.join(sorted(sets))}); choose with "
                "--label-set what the network shall tell apart."
            )
        labels = next(iter(sets.values()))
    train_pairs = _in_set(sources, labels)
    val_pairs = _in_set((open_pairs(spec) for spec in given["validation"]), labels)
    assert train_pairs is not None
    preset = _changed_preset(given)
    settings = RunSettings(
        preset=preset,
        label_set=labels,
        seed=given["seed"],
        data=given["data"],
        validation=given["validation"],
        num_train=len(train_pairs),
        num_validation=0 if val_pairs is None else len(val_pairs),
        epochs=given["epochs"],
        max_minutes=given["max_minutes"],
        threads=given["threads"] or torch.get_num_threads(),
        processes=int(os.environ.get("WORLD_SIZE", "1")),
        bfloat16=preset.bfloat16_on_cpu and torch.cpu._is_avx512_bf16_supported(),
    )
    return settings, train_pairs, val_pairs


def _changed_preset(given: dict[str, Any]) -> TrainPreset:
    from hdmap_tools.segmentation.training.presets import find_preset

    preset = find_preset(given["preset"])
    changes: dict[str, Any] = {}
    if given["batch"]:
        changes["batch"] = given["batch"]
    if given["no_pretrained"]:
        changes["pretrained"] = False
    if given["crop"]:
        changes["augmentation"] = preset.augmentation.model_copy(update={"crop_px": given["crop"]})
    if given["learning_rate"]:
        changes["optimizer"] = preset.optimizer.model_copy(
            update={"learning_rate": given["learning_rate"]}
        )
    return preset.model_copy(update=changes)


def _opened(specs: Iterable[str], settings: RunSettings) -> ImagePairs | None:
    from hdmap_tools.segmentation.training.pairs import open_pairs

    return _in_set((open_pairs(spec) for spec in specs), settings.label_set)


def _in_set(sources: Iterable[ImagePairs], labels: Any) -> ImagePairs | None:
    """All sources as one, in one label set; None where there are none."""
    from hdmap_tools.segmentation.training.pairs import joined, relabelled

    parts = [p if p.label_set == labels else relabelled(p, labels) for p in sources]
    return joined(parts) if parts else None
