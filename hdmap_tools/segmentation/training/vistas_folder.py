"""Mapillary Vistas as it is handed out: ``training/images`` with ``training/labels``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.labels.vistas import VISTAS
from hdmap_tools.labels.vistas_v2 import VISTAS_V2
from hdmap_tools.segmentation.training.labelled_files import (
    LabelledFiles,
    list_files,
    paired,
    read_palette_png,
    require_folder,
)

VERSIONS: Final = ("1.2", "2.0")
_SETS: Final = {"1.2": VISTAS, "2.0": VISTAS_V2}
_LABELS: Final = {"1.2": ("v1.2/labels", "labels"), "2.0": ("v2.0/labels",)}
_CONFIGS: Final = {
    "1.2": ("config_v1.2.json", "config.json"),
    "2.0": ("config_v2.0.json", "config.json"),
}
_TRAFFIC_LIGHT: Final = "object--traffic-light"


def open_vistas(
    folder: Path | str, split: str = "training", version: str | None = None
) -> LabelledFiles:
    """The images and labels of one split of Mapillary Vistas.

    Version 1 has ``<split>/labels``; version 2.0 has ``<split>/v2.0/labels`` and, beside
    it, those of version 1 as ``<split>/v1.2/labels``. The data set's own list of
    labels is compared with ours where it lies in the folder.

    Args:
        folder: Holds ``training`` and ``validation``.
        split: Name of one of them.
        version: ``1.2`` or ``2.0``; None takes 1.2, the paper's, where it is there.

    Raises:
        ConfigError: If a folder is missing or empty, or the version unknown.
        ImageError: If an image has no label file.
        LabelError: If the data set's own list of labels is another.
    """
    root, images = Path(folder), Path(folder) / split / "images"
    if version is not None and version not in VERSIONS:
        raise ConfigError(f"Vistas {version!r} is unknown; expected one of {', '.join(VERSIONS)}.")
    layout = (
        f"Mapillary Vistas: {split}/images beside {split}/labels, {split}/v1.2/labels or "
        f"{split}/v2.0/labels"
    )
    require_folder(images, layout)
    for candidate in VERSIONS if version is None else (version,):
        for name in _LABELS[candidate]:
            labels = root / split / name
            if labels.is_dir():
                label_set = load_label_set(_SETS[candidate])
                _compare_with_config(root, candidate, label_set)
                return LabelledFiles(
                    name=f"Vistas {candidate} {split}",
                    label_set=label_set,
                    files=paired(
                        list_files(images, "*", (".jpg", ".jpeg", ".png")),
                        lambda image, labels=labels: labels / f"{image.stem}.png",  # type: ignore[misc]
                        f"{images} (*.jpg)",
                    ),
                    read_ids=read_palette_png,
                )
    wanted = " or ".join(
        str(root / split / name)
        for candidate in (VERSIONS if version is None else (version,))
        for name in _LABELS[candidate]
    )
    raise ConfigError(f"There is no folder of labels {wanted}; expected {layout}.")


def _compare_with_config(root: Path, version: str, label_set: LabelSet) -> None:
    path = next((root / name for name in _CONFIGS[version] if (root / name).is_file()), None)
    if path is None:
        return
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        names = [str(label["name"]) for label in document["labels"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(
            f"{path} is not the list of labels that Vistas comes with: {error!r}."
        ) from error
    if [_known_as(name) for name in names] == [_known_as(name) for name in label_set.names]:
        return
    first = next(
        (
            f"number {i} is {theirs!r}, expected {ours!r}"
            for i, (theirs, ours) in enumerate(zip(names, label_set.names, strict=False))
            if _known_as(theirs) != _known_as(ours)
        ),
        "the rest agrees",
    )
    raise LabelError(
        f"{path} has {len(names)} labels, expected the {len(label_set)} of {label_set.name}; {first}. "
        "Name the version that the labels are of."
    )


def _known_as(name: str) -> str:
    """The six traffic lights of version 2.0 as one: their order is not certain, nor does it matter."""
    return _TRAFFIC_LIGHT if name.startswith(_TRAFFIC_LIGHT) else name
