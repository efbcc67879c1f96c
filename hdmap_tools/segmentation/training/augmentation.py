"""Augmentation: another crop of an image and its labels each time, the same for the same seed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from hdmap_tools.errors import ShapeError
from hdmap_tools.labels.label_set import IGNORE_ID
from hdmap_tools.types import NDArrayByte, NDArrayFloat32

if TYPE_CHECKING:
    from torch import Tensor

_Positive = Annotated[float, Field(gt=0)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Amount = Annotated[float, Field(ge=0)]

_LUMA: Final = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in brightness (ITU-R BT.601)."""
_LEAST_BLUR_PX: Final = 0.2
"""Of sigma; less leaves every byte as it is, nearly."""
_NOISE_SIZE: Final = 1 << 22
_MIX_STEP: Final = 6
"""Every so many rows and columns tell what a window holds."""


class Augmentation(BaseModel):
    """What is done to a training image; the defaults are the paper's.

    Attributes:
        flip: Probability of mirroring left and right.
        scale: Smallest and largest factor, drawn evenly.
        crop_px: Side of the square that the network is given; what an image lacks is
            filled with the mean colour and 255.
        windows_tried: So many crops are drawn, and the one with the most even mix of labels
            is taken: sky and house fronts are learned soon, poles and people late.
        long_side_px: An image's long side at scale 1; None: its own. Data sets whose
            images differ in size need one.
        mean, std: Of the colours in 0..1, in order red, green, blue.
        brightness, contrast, saturation: Largest relative change; 0: none.
        white_balance: Largest relative change of each colour channel.
        blur_px: Largest sigma of a Gaussian blur, in pixels of the crop.
        noise: Largest sigma of noise, colours being 0..1.
        colour_probability: How often each of the last three groups is applied: colour,
            blur and noise.

    Source:
        Paz et al. 2020, on its training: flips, scale 0.5 to 2, crops of 640, mean and std.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    flip: _Share = 0.5
    scale: tuple[_Positive, _Positive] = (0.5, 2.0)
    crop_px: Annotated[int, Field(ge=16, le=8192)] = 640
    windows_tried: Annotated[int, Field(ge=1, le=16)] = 1
    long_side_px: Annotated[int, Field(ge=16)] | None = None
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[_Positive, _Positive, _Positive] = (0.229, 0.224, 0.225)
    brightness: _Share = 0.0
    contrast: _Share = 0.0
    saturation: _Share = 0.0
    white_balance: _Share = 0.0
    blur_px: _Amount = 0.0
    noise: _Share = 0.0
    colour_probability: _Share = 0.8

    @model_validator(mode="after")
    def _scales_in_order(self) -> Augmentation:
        if self.scale[0] > self.scale[1]:
            raise ValueError(f"scale needs the smaller factor first, found {self.scale}")
        return self


@dataclass(frozen=True)
class _Window:
    """Rows and columns of the source, the size they get, and where that lies in the crop."""

    top: int
    left: int
    height: int
    width: int
    out_height: int
    out_width: int
    out_top: int
    out_left: int


class Augment:
    """Cuts, scales, mirrors and colours an image, and its labels with it.

    The window is cut before it is scaled: the same pixels as scaling the whole image
    first, at a fraction of the time.

    Args:
        settings: What is done.

    Raises:
        MissingExtraError: If torch or torchvision is not installed.
    """

    def __init__(self, settings: Augmentation) -> None:
        from hdmap_tools.segmentation.training.extra import require_training

        require_training()
        self.settings = settings

    def __call__(
        self, rgb: NDArrayByte, ids: NDArrayByte, rng: np.random.Generator | int
    ) -> tuple[Tensor, Tensor]:
        """One crop.

        Args:
            rgb: (h, w, 3) uint8.
            ids: (h, w) uint8, 255 where nothing is judged.
            rng: The only source of chance; a number is a seed.

        Returns:
            The image (3, crop, crop) float32, normalized, and its ids (crop, crop)
            int64.

        Raises:
            ShapeError: If image and labels differ in size or are not of those types.
        """
        import torch
        from torchvision import tv_tensors
        from torchvision.transforms import v2
        from torchvision.transforms.v2 import functional

        _check(rgb, ids)
        s = self.settings
        rng = np.random.default_rng(rng)
        tried = [_draw_window(rng, rgb.shape[0], rgb.shape[1], s) for _ in range(s.windows_tried)]
        window = tried[0] if len(tried) == 1 else max(tried, key=partial(_mix, ids))
        rows = slice(window.top, window.top + window.height)
        columns = slice(window.left, window.left + window.width)
        size = [window.out_height, window.out_width]
        # A view with the channels last: torchvision resizes such bytes as they are.
        image: Any = torch.from_numpy(rgb[rows, columns].copy()).permute(2, 0, 1)
        mask: Any = torch.from_numpy(ids[rows, columns].copy())[None]
        image = functional.resize_image(image, size, v2.InterpolationMode.BILINEAR, antialias=True)
        # Torchvision resizes a Mask with NEAREST, up to a source pixel beside where the
        # bilinear image has it; that is the width of a far lane mark.
        mask = functional.resize_image(mask, size, v2.InterpolationMode.NEAREST_EXACT)
        image = self._blurred(image, rng)
        pair = tv_tensors.Image(image), tv_tensors.Mask(mask)
        if rng.random() < s.flip:
            pair = tuple(functional.horizontal_flip(part) for part in pair)
        bottom = s.crop_px - window.out_top - window.out_height
        right = s.crop_px - window.out_left - window.out_width
        coloured = self._coloured(functional.to_dtype(pair[0], torch.float32, scale=True), rng)
        image = functional.normalize(coloured.as_subclass(torch.Tensor), list(s.mean), list(s.std))
        ids_out = pair[1].as_subclass(torch.Tensor)
        if window.out_top or window.out_left or bottom or right:
            padding = [window.out_left, window.out_top, right, bottom]
            image = functional.pad(image, padding, fill=0.0)  # 0 is the mean colour by now
            ids_out = functional.pad(ids_out, padding, fill=IGNORE_ID)
        return image.contiguous(), ids_out[0].to(torch.int64)

    def _blurred(self, image: Tensor, rng: np.random.Generator) -> Tensor:
        """The lens, (3, h, w) uint8; before the light and the noise of the sensor."""
        import cv2
        import torch

        s = self.settings
        if not s.blur_px or rng.random() >= s.colour_probability:
            return image
        sigma = float(rng.uniform(0.0, s.blur_px))
        if sigma < _LEAST_BLUR_PX:
            return image
        # OpenCV's is separable: a tenth of the time of torchvision's.
        pixels = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
        return torch.from_numpy(cv2.GaussianBlur(pixels, (0, 0), sigma)).permute(2, 0, 1)

    def _coloured(self, image: Tensor, rng: np.random.Generator) -> Tensor:
        """Another light and sensor, (3, h, w) float32 in 0..1."""
        import torch

        s = self.settings
        changes = (s.brightness, s.contrast, s.saturation, s.white_balance)
        if any(changes) and rng.random() < s.colour_probability:
            image = _change_colours(image, rng, *changes)
        if s.noise and rng.random() < s.colour_probability:
            sigma = np.float32(rng.uniform(0.0, s.noise))
            noise = torch.from_numpy(sigma * _noise(image.numel(), rng))
            image = (image + noise.reshape(image.shape)).clamp_(0.0, 1.0)
        return image


def _noise(size: int, rng: np.random.Generator) -> NDArrayFloat32:
    """Normal noise (size,), cut at random from a piece drawn once: a tenth of the time."""
    if size > _NOISE_SIZE // 2:
        return rng.standard_normal(size, dtype=np.float32)
    first = int(rng.integers(_NOISE_SIZE - size))
    return _much_noise()[first : first + size]


@lru_cache
def _much_noise() -> NDArrayFloat32:
    noise = np.random.default_rng(0).standard_normal(_NOISE_SIZE, dtype=np.float32)
    noise.setflags(write=False)
    return noise


def _draw_window(rng: np.random.Generator, height: int, width: int, s: Augmentation) -> _Window:
    factor = float(rng.uniform(*s.scale))
    if s.long_side_px is not None:
        factor *= s.long_side_px / max(height, width)
    top, rows, out_rows, out_top = _draw_span(rng, height, factor, s.crop_px)
    left, columns, out_columns, out_left = _draw_span(rng, width, factor, s.crop_px)
    return _Window(top, left, rows, columns, out_rows, out_columns, out_top, out_left)


def _mix(ids: NDArrayByte, window: _Window) -> float:
    """How evenly labels are mixed in a window: the sum of the roots of their shares."""
    rows = slice(window.top, window.top + window.height, _MIX_STEP)
    columns = slice(window.left, window.left + window.width, _MIX_STEP)
    counts = np.bincount(ids[rows, columns].ravel(), minlength=256)[:IGNORE_ID]
    return float(np.sqrt(counts / max(counts.sum(), 1)).sum())


def _draw_span(
    rng: np.random.Generator, length: int, factor: float, crop_px: int
) -> tuple[int, int, int, int]:
    """Along one side: first pixel and number of the source, number and first of the crop."""
    taken = max(1, round(crop_px / factor))
    if taken <= length:
        return int(rng.integers(length - taken + 1)), taken, crop_px, 0
    given = min(crop_px, max(1, round(length * factor)))
    return 0, length, given, int(rng.integers(crop_px - given + 1))


def _change_colours(
    image: Tensor,
    rng: np.random.Generator,
    brightness: float,
    contrast: float,
    saturation: float,
    white_balance: float,
) -> Tensor:
    """All four as one affine map of the colours: one pass over the pixels instead of nine."""
    import torch

    luma = np.array(_LUMA)
    gain = rng.uniform(1 - brightness, 1 + brightness)
    gains = gain * rng.uniform(1 - white_balance, 1 + white_balance, 3)
    keep = rng.uniform(1 - saturation, 1 + saturation)
    spread = rng.uniform(1 - contrast, 1 + contrast)
    matrix = spread * (keep * np.eye(3) + (1 - keep) * luma[None, :]) @ np.diag(gains)
    # Contrast turns about the image's own mean brightness.
    mean = np.asarray(image.mean(dim=(1, 2)), dtype=float)
    offset = (1 - spread) * float(luma @ (gains * mean))
    flat = torch.from_numpy(matrix.astype(np.float32)) @ image.reshape(3, -1)
    return flat.add_(offset).clamp_(0.0, 1.0).reshape(image.shape)


def _check(rgb: NDArrayByte, ids: NDArrayByte) -> None:
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or rgb.size == 0:
        raise ShapeError(f"An image is (h, w, 3) uint8, found {rgb.shape} {rgb.dtype}.")
    if ids.shape != rgb.shape[:2] or ids.dtype != np.uint8:
        raise ShapeError(
            f"The labels of an image of {rgb.shape[1]}x{rgb.shape[0]} pixels are ({rgb.shape[0]}, "
            f"{rgb.shape[1]}) uint8, found {ids.shape} {ids.dtype}."
        )
