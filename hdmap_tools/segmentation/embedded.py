"""What an ONNX file says of itself, so that the one file is enough to run the network and to fuse.

Profile, label set and confusion matrix lie as one JSON document in the model's metadata.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import (
    BaseModel,
    ConfigDict,
    JsonValue,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    model_validator,
)

from hdmap_tools.errors import ConfigError, HDMapError, brief_problems
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.onnx_metadata import read_metadata, with_metadata
from hdmap_tools.segmentation.segmenter import ModelProfile

METADATA_KEY: Final = "hdmap_tools"
"""Key of the document in the ``metadata_props`` of an ONNX model."""


def _confusion(given: Any) -> ConfusionMatrix:
    if isinstance(given, ConfusionMatrix):
        return given
    try:
        return ConfusionMatrix.from_json(json.dumps(given), "it")
    except HDMapError as error:
        raise ValueError(str(error)) from error


def _confusion_document(matrix: ConfusionMatrix) -> Any:
    return json.loads(matrix.to_json())


class EmbeddedModel(BaseModel):
    """How to feed a network, what its answers mean, and how often they are wrong.

    Attributes:
        profile: How to feed it and read its answer; its `label_set` is the name of the
            set below.
        label_set: The labels, whole.
        confusion: How often it takes what for what, rows true; its predicted labels are
            those of the label set. In JSON as in a confusion file.
        training: What it was trained on and how; for people.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    profile: ModelProfile
    label_set: LabelSet
    confusion: (
        Annotated[
            ConfusionMatrix,
            PlainValidator(_confusion),
            PlainSerializer(_confusion_document, return_type=dict[str, Any]),
        ]
        | None
    ) = None
    training: dict[str, JsonValue] | None = None

    @model_validator(mode="after")
    def _parts_fit(self) -> EmbeddedModel:
        if self.profile.label_set != self.label_set.name:
            raise ValueError(
                f"its profile names label set {self.profile.label_set!r}, but the set in it is "
                f"{self.label_set.name!r}"
            )
        if (
            self.confusion is not None
            and self.confusion.predicted_set.names != self.label_set.names
        ):
            raise ValueError(
                f"its confusion matrix predicts the labels of {self.confusion.predicted_set.name!r}, "
                f"which are not those of its label set {self.label_set.name!r}"
            )
        return self


def read_embedded(model: Path) -> EmbeddedModel | None:
    """What an ONNX file says of itself, or None if it says nothing to us.

    Raises:
        ConfigError: If there is no such file, it is not an ONNX model, or what it says
            cannot be read.
    """
    text = read_metadata(model).get(METADATA_KEY)
    if text is None:
        return None
    about = f"What model {model} says of itself (metadata {METADATA_KEY!r})"
    advice = "Export it anew, or give --profile"
    try:
        return EmbeddedModel.model_validate(json.loads(text))
    except ValidationError as error:
        raise ConfigError(
            f"{about} cannot be used: {brief_problems(error, 'model')}. {advice}."
        ) from error
    except RecursionError as error:
        raise ConfigError(f"{about} cannot be read: it is nested too deeply. {advice}.") from error
    except ValueError as error:
        raise ConfigError(f"{about} is not JSON: {error}. {advice}.") from error


def write_embedded(model: Path, embedded: EmbeddedModel) -> None:
    """Put the document into an ONNX file, in place of an earlier one; the rest stays as it is.

    The same model and document give the same bytes.

    Raises:
        ConfigError: If there is no such file, or it is not an ONNX model.
        FormatError: If it cannot be written.
    """
    try:
        content = model.read_bytes()
    except OSError as error:
        raise ConfigError(f"Model {model} cannot be read: {error.strerror or error}.") from error
    text = json.dumps(
        embedded.model_dump(mode="json"), ensure_ascii=False, separators=(",", ":"), sort_keys=True
    )
    changed = with_metadata(content, METADATA_KEY, text, str(model))
    with atomic_output(model, overwrite=True) as temporary:
        temporary.write_bytes(changed)
