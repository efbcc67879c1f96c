"""From one label set to another: every label of the first has a declared fate in the second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hdmap_tools.errors import LabelError
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet
from hdmap_tools.types import NDArrayByte


@dataclass(frozen=True, eq=False)
class LabelMapping:
    """What becomes of each label of a set in another set.

    Attributes:
        source: The set that the label images have.
        target: The set that they get.
        fates: By source name: a target name, or None for dropped (`IGNORE_ID`, not
            judged). Names every source label and nothing else.

    Raises:
        LabelError: If a source label has no fate, a fate is of no source label, or
            a target label does not exist.
    """

    source: LabelSet
    target: LabelSet
    fates: Mapping[str, str | None]

    def __post_init__(self) -> None:
        between = f"The mapping {self.source.name} -> {self.target.name}"
        if missing := sorted(set(self.source.names) - set(self.fates)):
            raise LabelError(f"{between} does not say what becomes of {', '.join(missing)}.")
        if unknown := sorted(set(self.fates) - set(self.source.names)):
            raise LabelError(f"{between} names {', '.join(unknown)}, which the first set has not.")
        for fate in self.fates.values():
            if fate is not None:
                self.target.id_of(fate)

    @cached_property
    def table(self) -> NDArrayByte:
        """(256,) uint8 look-up table of ids; what is dropped or no id of the source is 255."""
        table = np.full(256, IGNORE_ID, dtype=np.uint8)
        for label in self.source.labels:
            fate = self.fates[label.name]
            if fate is not None:
                table[label.id] = self.target.id_of(fate)
        table.setflags(write=False)
        return table

    def apply(self, label_image: NDArrayByte, what: str) -> NDArrayByte:
        """A label image of the source as one of the target.

        Args:
            label_image: (H, W) uint8, ids of the source or 255.
            what: Names the image in messages.

        Returns:
            (H, W) uint8, ids of the target; 255 where the label is dropped.

        Raises:
            LabelError: If the image is not uint8, or holds an id that the source has not.
        """
        if label_image.dtype != np.uint8:
            raise LabelError(f"{what} holds {label_image.dtype}, expected uint8 label ids.")
        self.source.check(label_image, what)
        return self.table[label_image]

    def then(self, following: LabelMapping) -> LabelMapping:
        """Both mappings as one; what the first drops stays dropped.

        Raises:
            LabelError: If the second does not begin with the set that the first ends with.
        """
        if following.source != self.target:
            raise LabelError(
                f"A mapping to {self.target.name!r} cannot be followed by one from "
                f"{following.source.name!r}."
            )
        fates = {
            name: None if fate is None else following.fates[fate]
            for name, fate in self.fates.items()
        }
        return LabelMapping(self.source, following.target, fates)


def identity_mapping(label_set: LabelSet) -> LabelMapping:
    """Each label stays what it is."""
    return LabelMapping(label_set, label_set, {name: name for name in label_set.names})
