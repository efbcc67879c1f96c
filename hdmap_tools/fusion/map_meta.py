"""What the counts of a semantic map mean; stored with it and checked before two maps are added."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from hdmap_tools.config import RangeEdges, WholeMillimetres
from hdmap_tools.errors import MapMismatchError
from hdmap_tools.fusion.voting import CountMode, quanta_per_vote
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import LabelSet

MAP_SCHEMA_VERSION: Final = 1

_MUST_AGREE: Final = {"resolution_m", "count_mode", "intensity_threshold", "range_edges_m", "model"}


class MapMeta(BaseModel):
    """Resolution, frame, labels and count mode of a semantic map.

    Attributes:
        resolution_m: Cell size, metres.
        label_set: What was counted: all the network's labels.
        count_mode: How a frame votes in a cell.
        intensity_threshold: k; counts in odd bins had intensity k or above, 0..255.
        range_edges_m: Distances from the camera at which a new band begins; counts of each
            band are kept apart, because networks err more the further they look.
        reference_height_m: City height from which stored heights count.
        frame_document: The city frame (`MapFrame.to_json`).
        model: Name of the segmentation model; finds its confusion matrix on reading.
        confusion: The matrix that came with the model (a document as `ConfusionMatrix` writes
            it), which then is read with instead.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = MAP_SCHEMA_VERSION
    resolution_m: Annotated[float, Field(gt=0)]
    label_set: LabelSet
    count_mode: CountMode
    intensity_threshold: Annotated[int, Field(ge=1, le=255)]
    range_edges_m: RangeEdges = ()
    reference_height_m: WholeMillimetres = 0.0
    frame_document: dict[str, Any] = Field(default_factory=lambda: MapFrame().to_json())
    model: str = ""
    confusion: dict[str, Any] | None = None

    @property
    def frame(self) -> MapFrame:
        """The city frame."""
        return MapFrame.from_json(self.frame_document)

    @property
    def num_bins(self) -> int:
        """For each band of range two bins, nearest first: intensity below k, and k or above."""
        return 2 * (len(self.range_edges_m) + 1)

    @property
    def quanta_per_vote(self) -> int:
        """Counts that one frame's vote is worth."""
        return quanta_per_vote(self.count_mode)

    def require_compatible(self, other: MapMeta) -> None:
        """Raise unless counts of both maps may be added; the reference height may differ.

        Raises:
            MapMismatchError: Naming each field that differs, with both values.
            CRSMismatchError: If the frames differ.
        """
        mine = {"label_set": self.label_set.name} | self.model_dump(include=_MUST_AGREE)
        theirs = {"label_set": other.label_set.name} | other.model_dump(include=_MUST_AGREE)
        differing = [
            f"{key} {mine[key]!r} and {theirs[key]!r}" for key in mine if mine[key] != theirs[key]
        ]
        if not differing and self.confusion != other.confusion:
            differing = [f"the confusion matrix that came with model {self.model!r}"]
        if not differing and self.label_set != other.label_set:
            differing = [f"label set {self.label_set.name!r} with different labels"]
        if differing:
            raise MapMismatchError(
                f"The maps cannot be added, they differ in {'; '.join(differing)}. Build the second "
                "with `hdmap build --like FIRST`, which takes its settings over."
            )
        self.frame.require_same(other.frame)
