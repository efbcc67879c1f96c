"""What a segmentation back end is, and what has to be known about a model to run it."""

from __future__ import annotations

from typing import Annotated, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field

from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.types import NDArrayByte

_Positive = Annotated[float, Field(gt=0)]
_Pixels = Annotated[int, Field(ge=1, le=16384)]


class Segmenter(Protocol):
    """Turns camera images into label images."""

    @property
    def name(self) -> str:
        """Names it in maps and messages; a network's confusion matrix is known by it."""
        ...

    @property
    def label_set(self) -> LabelSet:
        """What the ids in its label images mean."""
        ...

    @property
    def fingerprint(self) -> str:
        """Changes whenever its results could: hash of weights, pre- and post-processing."""
        ...

    def segment(self, image: ImageRef) -> NDArrayByte:
        """The label image (height, width) uint8 of one camera image, at the image's own size.

        May be called from several threads at once.
        """
        ...


class ModelProfile(BaseModel):
    """How to feed a network and read its answer.

    Attributes:
        name: Names the model in caches and messages.
        sha256: Hashes of the weight files that this profile is known to fit
            (lower case hex; for OpenVINO of the ``.bin``); empty: any.
        label_set: Name of a shipped label set, or path of a JSON file.
        input_size_px: (width, height) the network wants, or None for the image's own.
        size_multiple_px: Images fed at their own size (and tiles) are continued to the right
            and below to whole multiples of it, as networks that shrink and enlarge need.
        channels: Order of the colour channels.
        scale: Pixel values 0..255 are multiplied by this first.
        mean, std: Then normalized, per channel in that order.
        output: ``scores`` (1, C, H, W), largest wins; ``ids`` (1, H, W) or (1, 1, H, W).
        output_name: Which output holds them; needed when the network has several.
        source: Where model and figures come from.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    sha256: tuple[Annotated[str, Field(pattern="^[0-9a-f]{64}$")], ...] = ()
    label_set: str
    input_size_px: tuple[_Pixels, _Pixels] | None = None
    size_multiple_px: _Pixels = 1
    channels: Literal["rgb", "bgr"] = "rgb"
    scale: _Positive = 1 / 255
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[_Positive, _Positive, _Positive] = (0.229, 0.224, 0.225)
    output: Literal["scores", "ids"] = "scores"
    output_name: str | None = None
    source: str = ""
