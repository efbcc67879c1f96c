"""Label images as a folder: what `hdmap segment` writes and `--labels` reads."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from hdmap_tools.config import Config
from hdmap_tools.output_folder import CONFIG_NAME, result_folder
from hdmap_tools.readers.drive import Drive
from hdmap_tools.segmentation.cache import LabelCache, SegmentProgress, segment_drive
from hdmap_tools.segmentation.label_png import write_label_png
from hdmap_tools.segmentation.precomputed import LABEL_SET_NAME, MODEL_NAME
from hdmap_tools.segmentation.segmenter import Segmenter


def write_label_folder(
    drive: Drive,
    segmenter: Segmenter,
    out: Path,
    config: Config,
    *,
    cache: LabelCache | None = None,
    overwrite: bool = False,
    progress: SegmentProgress | None = None,
) -> dict[str, Any]:
    """Segment all images of a drive; write their label images, label set and model's name.

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
        document = segmenter.label_set.model_dump_json(indent=2) + "\n"
        (folder / LABEL_SET_NAME).write_text(document, encoding="utf-8")
        made_by = json.dumps({"model": segmenter.name}, indent=2) + "\n"
        (folder / MODEL_NAME).write_text(made_by, encoding="utf-8")
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
