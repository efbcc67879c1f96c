"""The segmenter that the configuration asks for, or the one model that lies with the drive."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path

from hdmap_tools.config import SegmentationConfig
from hdmap_tools.errors import ConfigError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.readers.drive import Drive
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.model_profile import (
    find_profile,
    profile_for,
    sha256_of_files,
    weights_file,
)
from hdmap_tools.segmentation.network import NetworkSegmenter
from hdmap_tools.segmentation.precomputed import (
    LABEL_SET_NAME,
    PrecomputedSegmenter,
    require_label_folder,
)
from hdmap_tools.segmentation.segmenter import Segmenter

_log = logging.getLogger(__name__)

SIMULATED = "simulated"
"""As a model: the true label images of a simulated drive, with errors."""

_HOW_TO_GIVE = (
    "give a model with --model PATH (.onnx or .xml), or label images with --labels FOLDER "
    "--label-set NAME"
)


def open_segmenter(config: SegmentationConfig, drive: Drive) -> Segmenter:
    """The segmenter for a drive.

    Label PNGs if a folder of them is given (their label set may lie in it), else the
    model given, where ``simulated`` puts errors on the true labels of a simulated drive,
    else the one model with a known profile in ``models/`` in the drive's folder, beside
    it, or in the working directory.

    Raises:
        ConfigError: If what is given does not exist or fit, or nothing is given
            and not exactly one known model is found.
        LabelError: If the label set cannot be read.
        MissingExtraError: If the model needs a runtime that is not installed.
    """
    if config.labels is not None:
        if config.model is not None:
            raise ConfigError(
                f"Both a model ({config.model}) and label images ({config.labels}) are given; "
                "leave one out."
            )
        label_set = label_set_of(config.labels, config.label_set)
        return PrecomputedSegmenter(config.labels, label_set, drive.cameras)
    if config.model is not None and str(config.model) == SIMULATED:
        return _simulated(config, drive)
    if config.confusion is not None:
        raise ConfigError(
            f"segmentation.confusion ({config.confusion}) is what the simulated network errs by; give "
            "it with --model simulated. The matrix to read the map with is --confusion."
        )
    model = config.model
    if model is None:
        model = find_model(drive.root)
        _log.info("Using the model %s.", model)
    segmenter = open_model(model, config.profile, drive.cameras, threads=config.threads)
    if config.label_set not in (None, segmenter.label_set.name):
        raise ConfigError(
            f"Label set {config.label_set!r} is asked for, but model {model} gives "
            f"{segmenter.label_set.name!r} by its profile {segmenter.name!r}; leave --label-set "
            "out, or name it in a profile of your own."
        )
    return segmenter


def _simulated(config: SegmentationConfig, drive: Drive) -> Segmenter:
    from hdmap_tools.segmentation.simulated import TRUE_LABELS, SimulatedSegmenter

    if config.profile is not None or config.label_set is not None:
        raise ConfigError(
            "The simulated network needs no profile and has the label set of the drive's true label "
            "images; leave --profile and --label-set out."
        )
    matrix = None if config.confusion is None else ConfusionMatrix.load(config.confusion)
    return SimulatedSegmenter(
        drive.root / TRUE_LABELS, matrix, config.seed, drive.cameras, drive.trajectory
    )


def label_set_of(labels: Path, given: str | None) -> LabelSet:
    """The label set given (a name or a JSON file), or the one in a folder of label images.

    Raises:
        ConfigError: If there is neither, or no such folder.
        LabelError: If the label set cannot be read.
    """
    require_label_folder(labels)
    beside = labels / LABEL_SET_NAME
    if given is None and not beside.is_file():
        raise ConfigError(
            f"What the ids in the label images in {labels} mean is not said; name their label set "
            f"with --label-set, or put it there as {LABEL_SET_NAME}."
        )
    return load_label_set(beside if given is None else given)


def open_model(
    model: Path,
    profile: str | None,
    cameras: Mapping[str, PinholeCamera],
    *,
    threads: int = 0,
) -> NetworkSegmenter:
    """A network by the suffix of its file: ``.onnx`` or ``.xml``.

    Args:
        model: The model file.
        profile: Name or path of its profile; None finds it by the model's hash.
        cameras: Cameras by name.
        threads: CPU threads for one image; 0 is the runtime's choice.

    Raises:
        ConfigError: If the model or profile cannot be used.
        MissingExtraError: If the model needs a runtime that is not installed.
    """
    suffix = model.suffix.lower()
    if suffix == ".onnx":
        from hdmap_tools.segmentation.onnx import load_onnx as load
    elif suffix == ".xml":
        from hdmap_tools.segmentation.openvino import load_openvino as load
    else:
        raise ConfigError(
            f"Model {model} has suffix {suffix!r}; expected .onnx or .xml (OpenVINO, with its .bin "
            "beside it)."
        )
    return load(model, profile_for(model, profile), cameras, threads=threads)


def find_model(drive_root: Path) -> Path:
    """The one model with a known profile that lies with a drive.

    Raises:
        ConfigError: If there is none, or several; the message lists where it
            looked or what it found.
    """
    root = drive_root.resolve()
    places = list(dict.fromkeys([root / "models", root.parent / "models", Path.cwd() / "models"]))
    found: dict[str, Path] = {}
    unknown: list[Path] = []
    for model in _models_in(places):
        if find_profile(model) is None:
            unknown.append(model)
        else:
            # The same weights twice are one choice, not two.
            found.setdefault(sha256_of_files([weights_file(model)]), model)
    if len(found) == 1:
        return next(iter(found.values()))
    if found:
        raise ConfigError(
            f"Several models with a known profile lie with the drive: "
            f"{', '.join(str(model) for model in found.values())}; choose one with --model."
        )
    others = (
        f" The models {', '.join(map(str, unknown))} have no known profile; using one takes "
        "--model and --profile."
        if unknown
        else ""
    )
    raise ConfigError(
        f"No segmentation model is given, and none with a known profile lies in "
        f"{', '.join(map(str, places))}: {_HOW_TO_GIVE}.{others}"
    )


def _models_in(folders: list[Path]) -> Iterator[Path]:
    for path in _model_files(folders):
        if path.suffix.lower() == ".onnx" or weights_file(path).is_file():
            yield path


def _model_files(folders: list[Path]) -> Iterator[Path]:
    yielded: set[Path] = set()
    for folder in folders:
        for path in sorted([*folder.rglob("*.onnx"), *folder.rglob("*.xml")]):
            if path.is_file() and path.resolve() not in yielded:
                yielded.add(path.resolve())
                yield path
