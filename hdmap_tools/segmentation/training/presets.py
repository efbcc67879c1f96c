"""Training recipes: the paper's, and a small one that two CPU cores can train and run.

Why `small` is `street_net` and not a DeepLabV3+ on MobileNetV3-small: measured on two
cores (one image of 960x600 in ONNX Runtime; a training step of eight crops of 480x480,
bfloat16), without pretrained weights:

================================  ==========  =======  ======
network                           parameters  image    step
================================  ==========  =======  ======
DeepLabV3+, MobileNetV3-small     2.16 M      67 ms    1.55 s
U-Net, MobileNetV3-small (0.5)    0.78 M      81 ms    1.18 s
`street_net`                      1.01 M      69 ms    0.55 s
================================  ==========  =======  ======

The last one's step judges every second pixel only, the others all. The first is 8.6 MB, above
the 5 MB that a shipped network may have, and sees detail at a quarter of the resolution only.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from hdmap_tools.errors import ConfigError
from hdmap_tools.segmentation.training.augmentation import Augmentation

_Positive = Annotated[float, Field(gt=0)]
_Count = Annotated[int, Field(ge=1)]


class Sgd(BaseModel):
    """Stochastic gradient descent with momentum; the rate falls as (1 - progress) ** power.

    The paper lowers the rate once an epoch; here progress is the share of all steps done,
    which is the same curve drawn finer.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Literal["sgd"] = "sgd"
    learning_rate: _Positive = 0.005
    momentum: Annotated[float, Field(ge=0, lt=1)] = 0.9
    weight_decay: Annotated[float, Field(ge=0)] = 4e-5
    power: _Positive = 0.9

    def rate(self, progress: float) -> float:
        """Learning rate after that share (0..1) of the training."""
        return float(self.learning_rate * max(0.0, 1.0 - progress) ** self.power)


class AdamW(BaseModel):
    """AdamW; the rate rises linearly for the share `warm_up`, then falls as a cosine to 0."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Literal["adamw"] = "adamw"
    learning_rate: _Positive = 4e-3
    weight_decay: Annotated[float, Field(ge=0)] = 0.01
    warm_up: Annotated[float, Field(gt=0, lt=1)] = 0.1

    def rate(self, progress: float) -> float:
        """Learning rate after that share (0..1) of the training."""
        from math import cos, pi

        if progress < self.warm_up:
            return self.learning_rate * (0.05 + 0.95 * progress / self.warm_up)
        left = (progress - self.warm_up) / (1 - self.warm_up)
        return self.learning_rate * 0.5 * (1 + cos(pi * min(1.0, left)))


class TrainPreset(BaseModel):
    """How a network is made and trained.

    Attributes:
        name: Names the recipe in messages and in exported models.
        network: Which architecture (`models.build_model`).
        pretrained: Whether it starts from an encoder trained on ImageNet, which is
            downloaded.
        optimizer: With its schedule.
        batch: Images a step, over all processes.
        epochs: Times that each training image is seen.
        judges_every_second_pixel: A step's loss is that of every second row and column, in
            turn of each; for ``street_net``.
        overlap_weight: Of a second loss, one minus the soft overlap (Dice) of each label of the
            batch, which counts thin and rare things as much as large ones.
        max_gradient_norm: Longer gradients are cut to this length; None: never.
        class_weight_power: Labels are weighted in the loss by their frequency to minus
            this power; 0: alike.
        averaged_steps: Judge and keep, instead of the weights as the last step left them, their
            mean over about so many last steps, fading backwards; None: never. Single steps move
            the IoU of rare labels up and down by hundredths.
        fits_offsets: In the end, move each label's score so that the mean IoU on the
            validation images is highest (`label_offsets`).
        validate_epochs: Validate every so many epochs, and at the end.
        validate_min_steps: But not more often than that, where an epoch is short.
        validate_images: Evenly chosen of those given, to be quick; the end is judged on all.
        validate_long_side_px: Larger images are validated shrunk to this.
        bfloat16_on_cpu: Multiply in bfloat16 on processors that can; GPUs always use
            mixed precision.
        augmentation: Of the training images; its mean and std also normalize all others.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    network: Literal["deeplabv3plus_resnext50", "street_net"]
    pretrained: bool = False
    optimizer: Annotated[Sgd | AdamW, Field(discriminator="name")]
    batch: _Count
    epochs: _Count
    max_gradient_norm: _Positive | None = None
    judges_every_second_pixel: bool = False
    overlap_weight: Annotated[float, Field(ge=0)] = 0.0
    class_weight_power: Annotated[float, Field(ge=0, le=1)] = 0.0
    averaged_steps: Annotated[int, Field(ge=2)] | None = None
    fits_offsets: bool = False
    validate_epochs: _Count = 1
    validate_min_steps: _Count = 50
    validate_images: _Count = 100
    validate_long_side_px: _Count = 2048
    bfloat16_on_cpu: bool = False
    augmentation: Augmentation = Augmentation()


PRESETS: Final[dict[str, TrainPreset]] = {
    preset.name: preset
    for preset in (
        TrainPreset(
            name="paz2020",
            network="deeplabv3plus_resnext50",
            pretrained=True,
            optimizer=Sgd(),
            batch=16,
            epochs=200,
        ),
        TrainPreset(
            name="small",
            network="street_net",
            # Without a limit to the gradient the loss went to NaN where a slow machine's
            # warm-up, which goes by time, had few steps.
            optimizer=AdamW(learning_rate=1e-2, warm_up=0.05),
            max_gradient_norm=1.0,
            judges_every_second_pixel=True,
            overlap_weight=1.0,
            batch=4,
            epochs=15,
            class_weight_power=0.3,
            averaged_steps=500,
            fits_offsets=True,
            # On two cores a look at sixty images takes as long as twenty steps.
            validate_epochs=5,
            validate_images=60,
            bfloat16_on_cpu=True,
            augmentation=Augmentation(
                crop_px=352,
                windows_tried=3,
                scale=(0.7, 1.6),
                brightness=0.25,
                contrast=0.25,
                saturation=0.25,
                white_balance=0.05,
                noise=0.02,
            ),
        ),
    )
}


def find_preset(name: str) -> TrainPreset:
    """A preset by name.

    Raises:
        ConfigError: If there is none; the message lists them.
    """
    try:
        return PRESETS[name]
    except KeyError as error:
        raise ConfigError(
            f"There is no preset {name!r}; there are {', '.join(PRESETS)}."
        ) from error
