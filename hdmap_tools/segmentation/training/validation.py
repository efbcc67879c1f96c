"""How well a network does on images that it was not trained on."""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hdmap_tools.errors import ConfigError, HDMapError, ShapeError
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.training.augmentation import Augmentation
from hdmap_tools.segmentation.training.image_pairs import ImagePairs
from hdmap_tools.types import NDArrayByte


def confusion_on(
    model: nn.Module,
    pairs: ImagePairs,
    indices: Iterable[int],
    augmentation: Augmentation,
    device: torch.device,
    *,
    long_side_px: int = 2048,
    bfloat16: bool = False,
    source: str = "",
) -> ConfusionMatrix:
    """Count true against predicted labels, a whole image at a time.

    Args:
        model: Gives logits at the input's size; is left in evaluation mode.
        pairs: Images and labels.
        indices: Which of them.
        augmentation: Only its normalization is used.
        device: Where the model is.
        long_side_px: Larger images are shrunk to this, and their scores enlarged.
        bfloat16: Whether to multiply in bfloat16.
        source: Kept with the matrix.

    Raises:
        LabelError: If a mask holds an id outside the label set.
        ShapeError: If image and mask differ in size.
    """
    labels = pairs.label_set
    size = len(labels)
    # float64 would be exact too; whole numbers say what they are.
    total = ConfusionMatrix(labels, labels, np.zeros((size, size), dtype=np.int64), source)
    model.eval()
    with torch.inference_mode():
        for index in indices:
            rgb, truth = pairs.read(index)
            if rgb.shape[:2] != truth.shape:
                raise ShapeError(
                    f"{pairs.describe(index)}: the image is {rgb.shape[:2]}, its mask {truth.shape}."
                )
            images = normalized(_shrunk(rgb, long_side_px), augmentation).to(device)
            with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
                logits = model(images).float()
            if logits.shape[-2:] != truth.shape:
                logits = functional.interpolate(
                    logits, size=truth.shape, mode="bilinear", align_corners=False
                )
            predicted = logits[0].argmax(0).to(torch.uint8).cpu().numpy()
            try:
                total = total + ConfusionMatrix.measure(truth, predicted, labels, labels)
            except HDMapError as error:
                raise type(error)(f"{pairs.describe(index)}: {error}") from error
    return total


def normalized(rgb: NDArrayByte, augmentation: Augmentation) -> Tensor:
    """A network's input (1, 3, H, W) float32 of an image (height, width, 3) uint8 RGB."""
    mean = torch.tensor(augmentation.mean).view(1, 3, 1, 1)
    std = torch.tensor(augmentation.std).view(1, 3, 1, 1)
    images = torch.from_numpy(rgb.copy()).permute(2, 0, 1)[None].float() / 255
    return ((images - mean) / std).contiguous(memory_format=torch.channels_last)


def label_ious(matrix: ConfusionMatrix) -> dict[str, float]:
    """IoU of each label; NaN for one that the truth does not hold."""
    true, predicted = matrix.counts.sum(axis=1), matrix.counts.sum(axis=0)
    both = np.diagonal(matrix.counts)
    return {
        name: float(both[k] / (true[k] + predicted[k] - both[k])) if true[k] else math.nan
        for k, name in enumerate(matrix.true_set.names)
    }


def mean_iou(matrix: ConfusionMatrix) -> float:
    """Mean IoU over the labels that the truth holds.

    Raises:
        ConfigError: If it holds none.
    """
    found = [iou for iou in label_ious(matrix).values() if not math.isnan(iou)]
    if not found:
        raise ConfigError("The validation images hold no labelled pixel; give others with --val.")
    return sum(found) / len(found)


def _shrunk(rgb: NDArrayByte, long_side_px: int) -> NDArrayByte:
    scale = long_side_px / max(rgb.shape[:2])
    if scale >= 1:
        return rgb
    height, width = (max(1, round(side * scale)) for side in rgb.shape[:2])
    return cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]
