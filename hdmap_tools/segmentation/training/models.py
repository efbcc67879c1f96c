"""The networks of the presets: images in, one score a label and pixel out.

Each takes normalized images (N, 3, H, W) of any size and gives logits (N, labels, H, W)
of the same size, also after export.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from hdmap_tools.errors import ConfigError
from hdmap_tools.segmentation.training.presets import TrainPreset

_SMP_MULTIPLE: Final = 16
"""DeepLabV3+ takes sides that are multiples of this."""


def build_model(preset: TrainPreset, num_labels: int, pretrained: bool | None = None) -> nn.Module:
    """The network of a preset, with random weights but for a pretrained encoder.

    Args:
        preset: Names the architecture.
        num_labels: Scores a pixel.
        pretrained: Whether the encoder begins with ImageNet weights, which are
            downloaded; None: as the preset says.

    Raises:
        ConfigError: If the weights cannot be had.
    """
    wanted = preset.pretrained if pretrained is None else pretrained
    if preset.network == "street_net":
        if wanted:
            raise ConfigError(
                "Network 'street_net' has no pretrained weights; train it from scratch."
            )
        return StreetNet(num_labels)
    return _deeplab(num_labels, wanted)


def shift_scores(model: nn.Module, offsets: Sequence[float]) -> None:
    """Add to the score of each label, in the last convolution of a network of `build_model`."""
    last = model.scores if isinstance(model, StreetNet) else model.network.segmentation_head[0]
    with torch.no_grad():
        added = torch.tensor(offsets, dtype=last.bias.dtype, device=last.bias.device)
        # Several in a row are one label's: of the pixels of a cell.
        last.bias += added.repeat_interleave(len(last.bias) // len(added))


def _deeplab(num_labels: int, pretrained: bool) -> nn.Module:
    """The paper's DeepLabV3+ on ResNeXt50-32x4d.

    Its decoder is separable as the paper says: the three atrous branches of the ASPP, the
    convolution after them and the one after the skip are depthwise 3x3, then 1x1.

    26.15 M parameters, 104.9 MB of weights. The paper's 210 MB in memory (ResNet101: 367 MB)
    are twice that: weights and momentum, 209.8 MB here (ResNet101: 366.2 MB).
    """
    import segmentation_models_pytorch as smp

    try:
        network = smp.DeepLabV3Plus(
            encoder_name="resnext50_32x4d",
            encoder_weights="imagenet" if pretrained else None,
            encoder_output_stride=8,
            classes=num_labels,
        )
    except OSError as error:  # no connection, or the server refuses
        raise ConfigError(
            f"The encoder's ImageNet weights cannot be downloaded ({error}); connect to the internet, "
            "or train from scratch with --no-pretrained."
        ) from error
    return _Padded(network, _SMP_MULTIPLE)


class _Padded(nn.Module):  # type: ignore[misc]
    """A network that wants sides of a multiple, for images of any size."""

    def __init__(self, network: nn.Module, multiple: int) -> None:
        super().__init__()
        self.network = network
        self.multiple = multiple

    def forward(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        right, below = -width % self.multiple, -height % self.multiple
        # Of the edge's own colour: black would be an object.
        padded = functional.pad(images, (0, right, 0, below), mode="replicate")
        return self.network(padded)[..., :height, :width]


class StreetNet(nn.Module):  # type: ignore[misc]
    """A small encoder and decoder made to learn much per CPU second, and to see thin paint.

    Plain 3x3 convolutions where there are few channels (fastest per multiplication on a
    CPU), depthwise ones where there are many; context by dilation and a global mean at a
    32nd of the size; a decoder that ends at half the size, where each cell gives the
    scores of its four pixels (sub-pixel convolution): marks a pixel or two wide are not
    blurred by an enlargement.
    """

    WIDTHS: Final = (16, 32, 64, 96, 128)
    """Channels at a half, 4th, 8th, 16th and 32nd of the size."""

    def __init__(self, num_labels: int) -> None:
        super().__init__()
        half, fourth, eighth, sixteenth, last = self.WIDTHS
        self.stage1 = _convolution(3, half, stride=2)
        self.stage2 = nn.Sequential(_convolution(half, fourth, stride=2), _Residual(fourth))
        self.stage3 = nn.Sequential(
            _convolution(fourth, eighth, stride=2), _Residual(eighth), _Residual(eighth)
        )
        self.stage4 = nn.Sequential(
            _convolution(eighth, sixteenth, stride=2),
            _Residual(sixteenth),
            _Inverted(sixteenth, dilation=2),
            _Inverted(sixteenth),
        )
        self.stage5 = nn.Sequential(
            _convolution(sixteenth, last, stride=2),
            _Inverted(last),
            _Inverted(last, dilation=2),
            _Inverted(last, dilation=4),
        )
        self.decode4 = _Joined(sixteenth, last, sixteenth, eighth)
        self.decode3 = _Joined(eighth, eighth, 48, 48)
        self.decode2 = _Joined(fourth, 48, fourth, fourth)
        self.decode1 = _Joined(half, fourth, half, 24)
        self.scores = nn.Conv2d(24, num_labels * 4, 1)

    def forward(self, images: Tensor, offset: tuple[int, int] | None = None) -> Tensor:
        """Logits (N, labels, H, W) of normalized images (N, 3, H, W).

        Args:
            images: Of any size.
            offset: Row and column, 0 or 1 each: give the logits of every second pixel from
                there on only. Neighbours say nearly the same in training, and all that is
                done at full size takes half of a step.
        """
        height, width = images.shape[-2:]
        at2 = self.stage1(images)
        at4 = self.stage2(at2)
        at8 = self.stage3(at4)
        at16 = self.stage4(at8)
        at32 = self.stage5(at16)
        at32 = at32 + at32.mean((2, 3), keepdim=True)
        up = self.decode4(at16, at32)
        up = self.decode3(at8, up)
        up = self.decode2(at4, up)
        up = self.decode1(at2, up)
        if offset is not None:
            row, column = offset
            # As pixel_shuffle sorts them: label, then row, then column.
            part = slice(2 * row + column, None, 4)
            assert self.scores.bias is not None
            some = functional.conv2d(up, self.scores.weight[part], self.scores.bias[part])
            return some[..., : (height - row + 1) // 2, : (width - column + 1) // 2]
        # Odd sides were rounded up on the way down.
        return functional.pixel_shuffle(self.scores(up), 2)[..., :height, :width]


def _convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1, **more: Any) -> Any:
    dilation = more.get("dilation", 1)
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, dilation * (size // 2), bias=False, **more),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):  # type: ignore[misc]
    """Two 3x3 convolutions beside the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


class _InFloat32(nn.Module):  # type: ignore[misc]
    """A part that is never computed in less precision.

    On CPUs the gradient of dilated depthwise kernels in bfloat16 was not the same twice
    (torch 2.14.1: off by a tenth, once in some hundred times not a number).
    """

    def __init__(self, part: nn.Module) -> None:
        super().__init__()
        self.part = part

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return self.part(x.float())


class _Inverted(nn.Module):  # type: ignore[misc]
    """Widen, filter each channel by itself, narrow; beside the identity."""

    def __init__(self, channels: int, dilation: int = 1, widening: int = 2) -> None:
        super().__init__()
        wide = channels * widening
        self.body = nn.Sequential(
            _convolution(channels, wide, 1),
            _InFloat32(_convolution(wide, wide, dilation=dilation, groups=wide)),
            nn.Conv2d(wide, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.body(x))


class _Joined(nn.Module):  # type: ignore[misc]
    """What was seen finely beside what is known coarsely, and a convolution over both.

    Beside each other, not summed: on one batch learned by heart, marks, kerbs and poles then
    took half as many steps to appear.
    """

    def __init__(self, fine: int, coarse: int, narrowed: int, outputs: int) -> None:
        super().__init__()
        self.narrow = _convolution(coarse, narrowed, 1)
        self.join = _convolution(fine + narrowed, outputs)

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        return self.join(torch.cat([fine, _enlarged(self.narrow(coarse), fine)], dim=1))


def _enlarged(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)
