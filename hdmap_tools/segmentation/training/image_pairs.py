"""What a network learns from: pairs of image and labels, brought onto one label set, joined."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Protocol

import numpy as np

from hdmap_tools.errors import LabelError
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.labels.mappings import mapping_to
from hdmap_tools.types import NDArrayByte


class ImagePairs(Protocol):
    """Images with their labels, read one at a time.

    Picklable and without open files, so that worker processes may read them.
    """

    @property
    def name(self) -> str:
        """Names the data in logs and in what is kept with a trained model."""
        ...

    @property
    def label_set(self) -> LabelSet:
        """What the ids mean."""
        ...

    def __len__(self) -> int:
        """Number of pairs."""
        ...

    def read(self, index: int) -> tuple[NDArrayByte, NDArrayByte]:
        """One pair: rgb (h, w, 3) uint8 and ids (h, w) uint8, 255 where nothing is judged.

        Raises:
            ImageError: If a file is missing, damaged, or the two differ in size; the
                message names the files.
            LabelError: If an id is outside the label set.
        """
        ...

    def describe(self, index: int) -> str:
        """The files of a pair, for messages."""
        ...


@dataclass(frozen=True, eq=False)
class _Relabelled:
    """Pairs whose labels are brought onto another set."""

    pairs: ImagePairs
    label_set: LabelSet
    table: NDArrayByte

    @property
    def name(self) -> str:
        return self.pairs.name

    def __len__(self) -> int:
        return len(self.pairs)

    def read(self, index: int) -> tuple[NDArrayByte, NDArrayByte]:
        rgb, ids = self.pairs.read(index)
        return rgb, np.take(self.table, ids)

    def describe(self, index: int) -> str:
        return self.pairs.describe(index)


@dataclass(frozen=True)
class _Joined:
    """Several sources one after another."""

    parts: tuple[ImagePairs, ...]

    @cached_property
    def _ends(self) -> list[int]:
        return list(accumulate(len(part) for part in self.parts))

    @property
    def name(self) -> str:
        return " + ".join(part.name for part in self.parts)

    @property
    def label_set(self) -> LabelSet:
        return self.parts[0].label_set

    def __len__(self) -> int:
        return self._ends[-1]

    def read(self, index: int) -> tuple[NDArrayByte, NDArrayByte]:
        part, within = self._find(index)
        return part.read(within)

    def describe(self, index: int) -> str:
        part, within = self._find(index)
        return part.describe(within)

    def _find(self, index: int) -> tuple[ImagePairs, int]:
        if not 0 <= index < len(self):
            raise IndexError(f"There are {len(self)} pairs, asked for number {index}.")
        which = bisect_right(self._ends, index)
        return self.parts[which], index - (self._ends[which - 1] if which else 0)


def relabelled(pairs: ImagePairs, target: str | LabelSet) -> ImagePairs:
    """The same pairs with their labels brought onto another set.

    Args:
        pairs: In a label set that a mapping to the target is known of.
        target: The set or the name of a shipped one.

    Raises:
        LabelError: If no mapping between the two sets is known; the message lists them.
    """
    mapping = mapping_to(pairs.label_set, target)
    if mapping.target == pairs.label_set:
        return pairs
    return _Relabelled(pairs, mapping.target, mapping.table)


def joined(parts: Sequence[ImagePairs]) -> ImagePairs:
    """Several sources as one, in the order given.

    Raises:
        LabelError: If there is none, or their label sets differ: bring them onto one
            with `relabelled` first.
    """
    if not parts:
        raise LabelError("There are no images to train on; name at least one source.")
    first = parts[0]
    for part in parts:
        if part.label_set.names != first.label_set.names:
            raise LabelError(
                f"{first.name} has label set {first.label_set.name!r} and {part.name} has "
                f"{part.label_set.name!r}; bring them onto one set before joining them."
            )
    return first if len(parts) == 1 else _Joined(tuple(parts))
