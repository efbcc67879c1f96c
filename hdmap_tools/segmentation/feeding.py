"""How a network is fed: by a profile, by what its file says, or by what most networks want."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hdmap_tools.errors import ConfigError
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.segmenter import ModelProfile


@dataclass(frozen=True)
class Output:
    """One output of a network.

    Attributes:
        name: Its name.
        shape: None where a length is not known before it is run; empty where nothing is.
        is_integer: Whether it gives whole numbers.
    """

    name: str
    shape: tuple[int | None, ...]
    is_integer: bool


@dataclass(frozen=True)
class Feeding:
    """What is known of a network besides its weights.

    Attributes:
        profile: How to feed it and read its answer; None is as most networks want it (RGB,
            normalized as for ImageNet, at the size it takes), settled once it is loaded.
        label_set: What its outputs mean; None is the set that the profile names.
        confusion: The matrix that came with it.
        input_size_px: (width, height) to feed it without a profile; None is the size it
            takes, or the image's own where it takes any.
    """

    profile: ModelProfile | None = None
    label_set: LabelSet | None = None
    confusion: ConfusionMatrix | None = None
    input_size_px: tuple[int, int] | None = None

    def settled(
        self, model: Path, input_shape: Sequence[int | None], outputs: Sequence[Output]
    ) -> ModelProfile:
        """The profile, or the one that a network of that input and those outputs most likely has.

        Raises:
            ConfigError: If there is no profile and no label set, or several outputs may hold
                the labels.
        """
        if self.profile is not None:
            return self.profile
        if self.label_set is None:
            raise ConfigError(f"What the outputs of model {model} mean is not said; {HOW_TO_SAY}.")
        size_px = self.input_size_px
        if size_px is None and len(input_shape) == 4:
            height, width = input_shape[2:]
            size_px = None if height is None or width is None else (width, height)
        chosen = self._output(model, outputs, len(self.label_set))
        return ModelProfile(
            name=model.stem,
            label_set=self.label_set.name,
            input_size_px=size_px,
            output="ids" if chosen.is_integer or len(chosen.shape) == 3 else "scores",
            output_name=chosen.name,
            source="assumed: RGB, normalized as for ImageNet",
        )

    def _output(self, model: Path, outputs: Sequence[Output], num_labels: int) -> Output:
        if len(outputs) == 1:
            return outputs[0]
        fitting = [o for o in outputs if len(o.shape) == 4 and o.shape[1] == num_labels]
        if len(fitting) == 1:
            return fitting[0]
        listed = ", ".join(repr(output.name) for output in outputs)
        raise ConfigError(
            f"Model {model} has the outputs {listed}, of which {len(fitting)} have a channel for each "
            f"of the {num_labels} labels; say which one holds the labels as output_name in a "
            "profile (--profile)."
        )


HOW_TO_SAY = (
    "give its labels with --label-set (a name or a JSON file), and a --profile where it is not fed "
    "as most are (RGB, normalized as for ImageNet)"
)
