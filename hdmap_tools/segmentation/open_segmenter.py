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
from hdmap_tools.segmentation.embedded import read_embedded
from hdmap_tools.segmentation.feeding import HOW_TO_SAY, Feeding
from hdmap_tools.segmentation.model_profile import (
    builtin_profiles,
    find_profile,
    profile_for,
    require_model_file,
    sha256_of_files,
    weights_file,
)
from hdmap_tools.segmentation.network import Handling, NetworkSegmenter
from hdmap_tools.segmentation.precomputed import (
    LABEL_SET_NAME,
    PrecomputedSegmenter,
    require_label_folder,
)
from hdmap_tools.segmentation.segmenter import ModelProfile, Segmenter
from hdmap_tools.segmentation.shipped import (
    SHIPPED,
    SIMULATED,
    STREET_SMALL,
    is_shipped,
    shipped_network,
)
from hdmap_tools.segmentation.tiling import Tiling

_log = logging.getLogger(__name__)

NAMED_MODELS = (SIMULATED, *SHIPPED)
"""Models that are known by name and are no paths."""

_HOW_TO_GIVE = (
    "give a model with --model PATH (.onnx or .xml), or label images with --labels FOLDER "
    "--label-set NAME"
)


def open_segmenter(config: SegmentationConfig, drive: Drive) -> Segmenter:
    """The segmenter for a drive.

    Label PNGs if a folder of them is given (their label set may lie in it), else the
    model given, where ``simulated`` puts errors on the true labels of a simulated drive,
    else the one model that says of itself how to feed it, or whose profile is known, in
    ``models/`` in the drive's folder, beside it, or in the working directory; else the
    network that ships with the package.

    Raises:
        ConfigError: If what is given does not exist or fit, or nothing is given
            and several known models are found.
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
    tiling = None
    if config.tile_px is not None:
        tiling = Tiling(config.tile_px, config.tile_overlap_px)
    return open_model(
        model,
        config.profile,
        drive.cameras,
        threads=config.threads,
        label_set=config.label_set,
        input_size_px=config.input_size_px,
        handling=Handling(config.batch, tiling, config.undistort),
    )


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
    label_set: str | None = None,
    input_size_px: tuple[int, int] | None = None,
    handling: Handling | None = None,
) -> NetworkSegmenter:
    """A network by name if it ships, or by the suffix of its file: ``.onnx`` or ``.xml``.

    Args:
        model: The model file.
        profile: Name or path of its profile; None takes what the file says of itself, or
            the profile known by the model's hash.
        cameras: Cameras by name.
        threads: CPU threads for one image; 0 is the runtime's choice.
        label_set: Name or path of the label set of a model of which nothing is known.
        input_size_px: (width, height) to feed such a model; None is what it takes.
        handling: How images are brought to it.

    Raises:
        ConfigError: If the model or profile cannot be used.
        LabelError: If the model's outputs do not match its label set.
        MissingExtraError: If the model needs a runtime that is not installed.
    """
    if str(model) in SHIPPED:
        model = shipped_network(str(model))
    suffix = model.suffix.lower()
    if suffix == ".onnx":
        from hdmap_tools.segmentation.onnx import load_onnx as load
    elif suffix == ".xml":
        from hdmap_tools.segmentation.openvino import load_openvino as load
    else:
        raise ConfigError(
            f"Model {model} has suffix {suffix!r}; expected .onnx or .xml (OpenVINO, with its .bin "
            f"beside it), or the name of a shipped network ({', '.join(SHIPPED)})."
        )
    feeding = _feeding(model, profile, label_set, input_size_px)
    return load(model, feeding, cameras, threads=threads, handling=handling)


def _feeding(
    model: Path,
    profile: str | None,
    label_set: str | None,
    input_size_px: tuple[int, int] | None,
) -> Feeding:
    """All that is known of a model: told, said by its file, or known by its hash, in this order."""
    require_model_file(model)
    if profile is None:
        known = known_feeding(model)
        if known is None and label_set is not None:
            return Feeding(label_set=load_label_set(label_set), input_size_px=input_size_px)
        if known is None:
            raise ConfigError(
                f"{_nothing_known(model)}: {HOW_TO_SAY}. A profile is the name of a shipped one "
                f"({', '.join(sorted(builtin_profiles()))}) or a JSON file with the fields "
                f"{', '.join(ModelProfile.model_fields)}."
            )
    else:
        known = Feeding(profile_for(model, profile))
    assert known.profile is not None
    if input_size_px not in (None, known.profile.input_size_px):
        raise ConfigError(
            f"An input size of {input_size_px} is asked for, but profile {known.profile.name!r} of "
            f"model {model} feeds {known.profile.input_size_px or 'images at their own size'}; "
            "leave --input-size out, or change it in a profile of your own."
        )
    has = known.label_set or load_label_set(known.profile.label_set)
    if label_set not in (None, has.name) and load_label_set(str(label_set)) != has:
        raise ConfigError(
            f"Label set {label_set!r} is asked for, but model {model} gives "
            f"{has.name!r} by its profile {known.profile.name!r}; leave --label-set "
            "out, or name it in a profile of your own."
        )
    return known


def known_feeding(model: Path) -> Feeding | None:
    """What a model's file says of itself, or what is known of it by its hash; else None.

    Raises:
        ConfigError: If it is no model, or what it says cannot be read.
    """
    if model.suffix.lower() == ".onnx":
        embedded = read_embedded(model)
        if embedded is not None:
            return Feeding(embedded.profile, embedded.label_set, embedded.confusion)
    profile = find_profile(model)
    return None if profile is None else Feeding(profile)


def _nothing_known(model: Path) -> str:
    weights = weights_file(model)
    said = (
        f"No profile is known for model {model} (sha256 {sha256_of_files([weights])} of "
        f"{weights.name})"
    )
    if model.suffix.lower() == ".onnx":
        said += ", and it carries none in its metadata"
    return f"{said}, so how to feed it is not known either"


def find_model(drive_root: Path) -> Path:
    """The one known model that lies with a drive, or the name of the one that ships.

    Raises:
        ConfigError: If there are several with the drive, or none at all; the message lists
            what it found, or where it looked.
    """
    root = drive_root.resolve()
    places = list(dict.fromkeys([root / "models", root.parent / "models", Path.cwd() / "models"]))
    found: dict[str, Path] = {}
    unknown: list[Path] = []
    for model in _models_in(places):
        if _is_known(model):
            # The same weights twice are one choice, not two.
            found.setdefault(sha256_of_files([weights_file(model)]), model)
        else:
            unknown.append(model)
    if len(found) == 1:
        return next(iter(found.values()))
    if found:
        raise ConfigError(
            f"Several models with a known profile lie with the drive: "
            f"{', '.join(str(model) for model in found.values())}; choose one with --model."
        )
    others = (
        f" The models {', '.join(map(str, unknown))} have no known profile; using one takes "
        "--model and --label-set, or --profile."
        if unknown
        else ""
    )
    if is_shipped(STREET_SMALL):
        if not (root / "truth").is_dir():  # which lies with simulated drives
            _log.warning(
                "No network is given, so %s is used, which has seen simulated images only and labels "
                "recorded ones badly; take one that has seen such with --model, or --labels.",
                STREET_SMALL,
            )
        if others:
            _log.warning("%s is used.%s", STREET_SMALL, others)
        return Path(STREET_SMALL)
    raise ConfigError(
        f"No segmentation model is given, and none with a known profile lies in "
        f"{', '.join(map(str, places))}: {_HOW_TO_GIVE}.{others}"
    )


def _is_known(model: Path) -> bool:
    try:
        return known_feeding(model) is not None
    except ConfigError as error:
        _log.warning("Not used: %s", error)
        return False


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
