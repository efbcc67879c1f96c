"""Whether a network's input and output fit its profile, said before the first image."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.segmentation.segmenter import ModelProfile
from hdmap_tools.segmentation.tiling import Tiling

if TYPE_CHECKING:
    from hdmap_tools.segmentation.network import Network


def check_input(network: Network, profile: ModelProfile, tiling: Tiling | None = None) -> None:
    """Refuse a network that does not take what it would be fed.

    Raises:
        ConfigError: With the shape it takes and the one that it would get.
    """
    shape = network.input_shape
    if len(shape) != 4 or shape[0] not in (1, None) or shape[1] not in (3, None):
        hint = (
            " It looks like (N, H, W, C): export the model with channels first."
            if len(shape) == 4 and shape[3] == 3
            else ""
        )
        raise ConfigError(
            f"Model {network.path} takes input {_shape_text(shape)}; expected (1, 3, H, W), one image "
            f"with channels first.{hint}"
        )
    if tiling is not None:
        width, height = tiling.size_px
        if shape[2] not in (height, None) or shape[3] not in (width, None):
            raise ConfigError(
                f"Model {network.path} takes input {_shape_text(shape)} only, so tiles of "
                f"{width}x{height} px cannot be fed to it; make tiles of the network's size."
            )
        return
    if profile.input_size_px is None:
        if shape[2] is not None or shape[3] is not None:
            raise ConfigError(
                f"Model {network.path} takes input {_shape_text(shape)} only, but profile "
                f"{profile.name!r} feeds images at their own size; set its input_size_px to "
                "the [width, height] of the network."
            )
        return
    width, height = profile.input_size_px
    if shape[2] not in (height, None) or shape[3] not in (width, None):
        raise ConfigError(
            f"Model {network.path} takes input {_shape_text(shape)}, but profile {profile.name!r} "
            f"feeds (1, 3, {height}, {width}) from its input_size_px [{width}, {height}]; "
            "correct the profile, or choose the model it was made for."
        )


def check_output(network: Network, profile: ModelProfile, label_set: LabelSet) -> None:
    """Refuse a network whose scores are of another number of labels, where that is known.

    Raises:
        LabelError: With both numbers.
    """
    shape = network.output_shape
    if profile.output != "scores" or len(shape) != 4:
        return  # answers are checked as they come
    if shape[1] not in (None, len(label_set)):
        raise LabelError(
            f"Model {network.path} gives {shape[1]} channels of scores, but label set "
            f"{label_set.name!r} has {len(label_set)} labels ({', '.join(label_set.names)}); name "
            "the label set that the network was trained with."
        )


def _shape_text(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"
