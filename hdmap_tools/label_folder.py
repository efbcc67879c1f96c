"""Label images as a folder: what `hdmap segment` writes and `--labels` reads."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.config import Config
from hdmap_tools.output_folder import CONFIG_NAME, result_folder
from hdmap_tools.readers.drive import Drive
from hdmap_tools.readers.image import read_image
from hdmap_tools.segmentation.cache import LabelCache, SegmentProgress, segment_drive
from hdmap_tools.segmentation.known_confusion import confusion_of
from hdmap_tools.segmentation.label_png import write_label_png
from hdmap_tools.segmentation.overlay import legend_picture, overlay_picture, write_picture
from hdmap_tools.segmentation.precomputed import CONFUSION_NAME, LABEL_SET_NAME, MODEL_NAME
from hdmap_tools.segmentation.segmenter import Segmenter

OVERLAYS: Final = "overlays"
"""In a folder of label images: pictures for people."""


def write_label_folder(
    drive: Drive,
    segmenter: Segmenter,
    out: Path,
    config: Config,
    *,
    cache: LabelCache | None = None,
    overwrite: bool = False,
    overlays: bool = False,
    progress: SegmentProgress | None = None,
) -> dict[str, Any]:
    """Segment all images of a drive; write their label images and all that they mean.

    Beside them lie the label set, the model's name, and its confusion matrix where one came
    with it.

    Args:
        drive: The drive.
        segmenter: Makes the label images.
        out: Folder to make.
        config: Written beside the result.
        cache: Where label images of earlier runs are.
        overwrite: Replace an earlier result.
        overlays: Also write pictures for people: `OVERLAYS` / camera / timestamp ``.jpg``.
        progress: Told before each image and after the last.

    Returns:
        Number of images, share of pixels by label, milliseconds an image.
    """
    pixels = np.zeros(256, dtype=np.int64)
    start = time.perf_counter()
    with result_folder(out, "segment", overwrite) as folder:
        for image, labels in segment_drive(drive, segmenter, drive.images, cache, progress):
            path = folder / f"{image.key}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_label_png(path, labels)
            pixels += np.bincount(labels.reshape(-1), minlength=256)
            if overlays:
                rgb = read_image(image, drive.cameras[image.camera])
                picture = overlay_picture(rgb, labels, segmenter.label_set)
                write_picture(folder / OVERLAYS / f"{image.key}.jpg", picture)
        if overlays:
            write_picture(folder / OVERLAYS / "legend.png", legend_picture(segmenter.label_set))
        document = segmenter.label_set.model_dump_json(indent=2) + "\n"
        (folder / LABEL_SET_NAME).write_text(document, encoding="utf-8")
        made_by = json.dumps({"model": segmenter.name}, indent=2) + "\n"
        (folder / MODEL_NAME).write_text(made_by, encoding="utf-8")
        confusion = confusion_of(segmenter)
        if confusion is not None:
            (folder / CONFUSION_NAME).write_text(confusion.to_json(), encoding="utf-8")
        (folder / CONFIG_NAME).write_text(config.to_yaml(), encoding="utf-8")
    return {
        "num_images": len(drive.images),
        "model": segmenter.name,
        "label_set": segmenter.label_set.name,
        "ms_per_image": 1000 * (time.perf_counter() - start) / len(drive.images),
        "pixel_share": {
            name: float(pixels[i] / pixels.sum())
            for i, name in enumerate(segmenter.label_set.names)
        },
    }
