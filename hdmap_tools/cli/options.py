"""Options that several commands share, and what they do with them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

if TYPE_CHECKING:
    from rich.progress import Progress

    from hdmap_tools.config import Config
    from hdmap_tools.distributed.cluster import Workers
    from hdmap_tools.segmentation.cache import LabelCache, SegmentProgress

F = TypeVar("F", bound=Callable[..., Any])


class _LocalPath(click.Path):
    """A path of this machine."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from hdmap_tools.fusion.map_location import is_s3_address

        if isinstance(value, str) and is_s3_address(value):
            self.fail(f"{value} lies in S3, where only semantic maps can; give a path.", param, ctx)
        return super().convert(value, param, ctx)


class _MapPath(click.Path):
    """Where a semantic map lies: a path, or s3://BUCKET/PREFIX."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from hdmap_tools.fusion.map_location import is_s3_address, map_location

        if isinstance(value, str) and is_s3_address(value):
            return map_location(value)
        return super().convert(value, param, ctx)


PATH: Final = _LocalPath(path_type=Path)
MAP: Final = _MapPath(path_type=Path)


def config_options(function: F) -> F:
    """--config and --set."""
    function = click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="STEP.FIELD=VALUE",
        help="Set one field of the configuration, for example fusion.resolution_m=0.1; repeatable.",
    )(function)
    return click.option("--config", "config_path", type=PATH, help="hdmap.yaml to start from.")(
        function
    )


def drive_options(function: F) -> F:
    """--layout, --scene and --camera."""
    for option in (
        click.option(
            "--camera", "cameras", multiple=True, help="Use only this camera; repeatable."
        ),
        click.option("--scene", help="Which drive of a data root: nuScenes scene, AV2 log."),
        click.option(
            "--layout", help="Layout of the drive, where it is not recognized: nuscenes, av2."
        ),
    ):
        function = option(function)
    return function


def segmentation_options(function: F) -> F:
    """--model, --profile, --labels, --label-set, --cache and --no-cache."""
    for option in (
        click.option(
            "--no-cache", is_flag=True, help="Neither use nor keep label images of earlier runs."
        ),
        click.option("--cache", "cache_folder", type=PATH, help="Folder for kept label images."),
        click.option(
            "--label-set",
            help="What the ids in those PNGs (or of a model that does not say it) mean: a name or a "
            "JSON file [default: label_set.json there].",
        ),
        click.option(
            "--labels", type=PATH, help="Folder of label PNGs, CAMERA/TIMESTAMP_NS.png, instead."
        ),
        click.option(
            "--profile", help="How to feed the model, where it is not known: name or JSON file."
        ),
        click.option(
            "--model",
            type=PATH,
            help="ONNX or OpenVINO model, or street-small [default: found in models/ by the drive, "
            "else street-small].",
        ),
    ):
        function = option(function)
    return function


def network_options(function: F) -> F:
    """--input-size, --batch, --tile, --overlap and --no-undistort."""
    for option in (
        click.option(
            "--no-undistort",
            is_flag=True,
            help="Show the network images as recorded, also of cameras with distortion.",
        ),
        click.option(
            "--overlap", type=int, help="By how many pixels tiles overlap [default: 128]."
        ),
        click.option(
            "--tile",
            metavar="WIDTHxHEIGHT",
            help="Cut large images into tiles, at their own scale.",
        ),
        click.option(
            "--batch", type=int, help="Images or tiles at once, if the model takes several."
        ),
        click.option(
            "--input-size",
            metavar="WIDTHxHEIGHT",
            help="Feed a model of which nothing is known at this size.",
        ),
    ):
        function = option(function)
    return function


METHODS: Final = ("dense", "surface", "sparse", "planar")
"""Methods of association."""


def association_option(function: F) -> F:
    """--association and --points."""
    function = click.option(
        "--points",
        type=PATH,
        help="Point map (`hdmap points`) or point cloud of the place; its poses are used.",
    )(function)
    return click.option(
        "--association",
        type=click.Choice(METHODS),
        help="How labels reach the ground [default: dense with --points, else surface].",
    )(function)


def confusion_option(function: F) -> F:
    """--confusion."""
    return click.option(
        "--confusion",
        type=PATH,
        help="Confusion matrix to read the map with [default: the one known for the model].",
    )(function)


def vectorizer_option(function: F) -> F:
    """--vectorizer."""
    return click.option(
        "--vectorizer",
        "vectorizers",
        multiple=True,
        metavar="NAME",
        help="Run this one and what it requires; repeatable [default: all installed].",
    )(function)


def resolution_option(function: F) -> F:
    """--resolution."""
    return click.option("--resolution", type=float, help="Cell size, metres [default: 0.1].")(
        function
    )


def worker_options(shared: str, more: str = "") -> Callable[[F], F]:
    """--workers, --scheduler and --worker-memory.

    Args:
        shared: What workers of a scheduler must find where this process does.
        more: What else they need.
    """

    def added(function: F) -> F:
        for option in (
            click.option(
                "--worker-memory", metavar="SIZE", help="Of each of the --workers, for example 2GB."
            ),
            click.option(
                "--scheduler",
                metavar="ADDRESS",
                help="Spread it over the workers of a Dask scheduler, tcp://HOST:PORT; they must find "
                f"{shared} under the same paths{more}.",
            ),
            click.option(
                "--workers",
                type=click.IntRange(min=1),
                help="Spread the work over so many processes of this machine.",
            ),
        ):
            function = option(function)
        return function

    return added


def workers_of(given: dict[str, Any]) -> Workers | None:
    """The workers asked for; None if none were."""
    from hdmap_tools.distributed.cluster import Workers

    number, scheduler, memory = given["workers"], given["scheduler"], given["worker_memory"]
    if number is not None and scheduler is not None:
        raise click.UsageError("Give --workers or --scheduler, not both.")
    if memory is not None and number is None:
        raise click.UsageError("--worker-memory needs --workers.")
    if number is None and scheduler is None:
        return None
    if memory is not None:
        memory = f"{parse_bytes('--worker-memory', memory)}B"
    return Workers(number or 0, scheduler, memory)


def parse_bytes(option: str, text: str) -> int:
    """Bytes, from a size such as 2GB.

    Args:
        option: That it was given for, for messages.
        text: What was given.

    Raises:
        click.UsageError: If it is not a size above 0.
    """
    from pydantic import ByteSize, TypeAdapter, ValidationError

    try:
        size = int(TypeAdapter(ByteSize).validate_python(text))
    except ValidationError:
        size = 0
    if size == 0:
        raise click.UsageError(f"{option}: expected a size such as 2GB, found {text!r}.")
    return size


def origin_option(function: F) -> F:
    """--origin."""
    return click.option(
        "--origin",
        metavar="LAT,LON[,ALT]",
        help="Place of the city origin on earth, where the data does not say it.",
    )(function)


def overwrite_option(function: F) -> F:
    """--overwrite."""
    return click.option("--overwrite", is_flag=True, help="Replace an earlier result.")(function)


def json_option(function: F) -> F:
    """--json."""
    return click.option("--json", "json_path", type=PATH, help="Also write the figures as JSON.")(
        function
    )


_FIELD_OF_OPTION: Final = {
    "layout": "drive.layout",
    "scene": "drive.scene",
    "cameras": "drive.cameras",
    "model": "segmentation.model",
    "profile": "segmentation.profile",
    "labels": "segmentation.labels",
    "label_set": "segmentation.label_set",
    "batch": "segmentation.batch",
    "overlap": "segmentation.tile_overlap_px",
    "association": "association.method",
    "points": "association.points",
    "refine_poses": "points.refine_poses",
    "also": "association.also",
    "resolution": "fusion.resolution_m",
    "confusion": "observation.confusion",
    "vectorizers": "vectorize.vectorizers",
    "window": "vectorize.window_m",
    "reference": "compare.reference",
    "max_range": "compare.max_range_m",
}
"""The field of the configuration that an option of that parameter name sets, in every command."""


def resolve_config(given: dict[str, Any], **fixed: Any) -> Config:
    """The configuration from a file, --set, and a command's own options (these win).

    Args:
        given: A command's parameters by name; those in `_FIELD_OF_OPTION` that were
            given on the command line are put over the file.
        fixed: What the command itself settles, by dotted name with ``__`` for the dot.
    """
    import yaml

    from hdmap_tools.config import load_config
    from hdmap_tools.errors import ConfigError

    require_free_json(given.get("json_path"), given["overwrite"])
    dotted: dict[str, Any] = {}
    for setting in given["settings"]:
        name, equals, value = setting.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"--set {setting!r}: expected STEP.FIELD=VALUE.")
        try:
            dotted[name.strip()] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {setting!r}: the value is not YAML: {error}") from error
    for option, field in _FIELD_OF_OPTION.items():
        value = given.get(option)
        if value is not None and value != ():
            dotted[field] = _plain(value)
    if given.get("points") is not None:
        # Above the file, which says `surface` wherever it was made from the defaults.
        dotted.setdefault("association.method", "dense")
    if given.get("origin") is not None:
        dotted["export.origin"] = parse_origin(given["origin"])
    for option, field in (("input_size", "input_size_px"), ("tile", "tile_px")):
        if given.get(option) is not None:
            dotted[f"segmentation.{field}"] = parse_size(given[option], option)
    if given.get("no_undistort"):
        dotted["segmentation.undistort"] = False
    dotted |= {name.replace("__", "."): value for name, value in fixed.items()}
    return load_config(given["config_path"], dotted)


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    return list(value) if isinstance(value, tuple) else value


def parse_origin(text: str) -> list[float]:
    """LAT,LON[,ALT] as three numbers.

    Raises:
        ConfigError: If it is not two or three numbers.
    """
    from hdmap_tools.errors import ConfigError

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise ConfigError(
            f"--origin {text!r}: expected LAT,LON or LAT,LON,ALT in degrees and metres, for example "
            "49.0123,8.4321,115."
        )
    return [*numbers, 0.0][:3]


def parse_size(text: str, option: str) -> list[int]:
    """WIDTHxHEIGHT as two numbers.

    Args:
        text: What was given.
        option: Name of the parameter it was given for, for messages.

    Raises:
        ConfigError: If it is not two whole numbers above 0.
    """
    from hdmap_tools.errors import ConfigError

    numbers = text.lower().split("x")
    if len(numbers) != 2 or not all(n.isdecimal() and int(n) > 0 for n in numbers):
        raise ConfigError(
            f"--{option.replace('_', '-')} {text!r}: expected WIDTHxHEIGHT in pixels, for example "
            "960x608."
        )
    return [int(number) for number in numbers]


def label_cache(cache_folder: Path | None, no_cache: bool) -> LabelCache | None:
    """The label cache asked for."""
    from hdmap_tools.segmentation.cache import LabelCache

    return None if no_cache else LabelCache(cache_folder)


def progress_bars(enabled: bool) -> Progress:
    """Bars on stderr, gone when done, only where a person is watching."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not (enabled and console.is_terminal),
    )


class ImageProgress:
    """A progress bar over images (or sweeps)."""

    def __init__(self, enabled: bool, what: str = "images") -> None:
        self._progress = progress_bars(enabled)
        self._task = self._progress.add_task(what, total=None)

    def __enter__(self) -> SegmentProgress:
        self._progress.start()
        return self._told

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def _told(self, done: int, total: int) -> None:
        self._progress.update(self._task, completed=done, total=total)


def require_free_json(path: Path | None, overwrite: bool) -> None:
    """Refuse a --json file that exists before the work, not after it.

    Raises:
        OutputExistsError: If there is a file and overwrite is False: it may be anything.
    """
    from hdmap_tools.errors import OutputExistsError

    if path is not None and path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists; use --overwrite to replace it.")


def write_json(path: Path | None, document: Any, overwrite: bool = False) -> None:
    """Write a --json file, whole or not at all.

    Raises:
        OutputExistsError: If there is a file and overwrite is False: it may be anything.
    """
    if path is None:
        return
    from hdmap_tools.formats.atomic import atomic_output

    text = document if isinstance(document, str) else json.dumps(document, indent=2) + "\n"
    with atomic_output(path, overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
