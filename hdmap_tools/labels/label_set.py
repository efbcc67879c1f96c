"""Label sets: the network's label ids, and their way onto the map's classes."""

from __future__ import annotations

import json
from enum import StrEnum
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from hdmap_tools.errors import LabelError, brief_problems, shown
from hdmap_tools.types import NDArrayByte

IGNORE_ID: Final = 255
"""Pixels of this id say nothing: void, ego vehicle, not annotated."""


class MapClass(StrEnum):
    """The semantic classes of the map; the paper's five."""

    ROAD = "road"
    CROSSWALK = "crosswalk"
    LANE_MARK = "lane_mark"
    VEGETATION = "vegetation"
    SIDEWALK = "sidewalk"


MAP_CLASSES: Final[tuple[MapClass, ...]] = tuple(MapClass)

DRIVABLE_CLASSES: Final = (MapClass.ROAD, MapClass.CROSSWALK, MapClass.LANE_MARK)
"""Where a vehicle may be: the ground between the road's boundaries."""


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError("expected printable text, without control characters")
    return name


_Name = Annotated[str, AfterValidator(_printable)]
_Channel = Annotated[int, Field(ge=0, le=255)]


class Label(BaseModel):
    """One label of a network or of an annotation.

    Attributes:
        id: Value in the uint8 label image, 0..254.
        name: The data set's own name of it.
        color: (R, G, B) for overlays.
        map_class: The class of the map that it is, or None.
        moves: Vehicles and people: evidence about the object, not about the
            ground behind it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: Annotated[int, Field(ge=0, le=254)]
    name: Annotated[_Name, Field(min_length=1)]
    color: tuple[_Channel, _Channel, _Channel]
    map_class: MapClass | None = None
    moves: bool = False


class LabelSet(BaseModel):
    """Labels with ids 0..n-1 and their mapping onto the map's classes.

    Attributes:
        name: Names the set in maps, caches and messages.
        labels: In the order of their ids, without holes.
        source: Where ids and names come from.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: _Name
    labels: tuple[Label, ...]
    source: str = ""

    @model_validator(mode="after")
    def _ids_are_dense(self) -> LabelSet:
        ids = [label.id for label in self.labels]
        if ids != list(range(len(ids))) or not ids:
            found = ids if len(ids) <= 10 else f"{ids[:10]} and {len(ids) - 10} more"
            raise ValueError(f"label set {self.name!r} needs ids 0..n-1 in order, found {found}")
        names = [label.name for label in self.labels]
        if len(set(names)) != len(names):
            raise ValueError(f"label set {self.name!r} has a name twice")
        return self

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def names(self) -> tuple[str, ...]:
        """Label names in the order of their ids."""
        return tuple(label.name for label in self.labels)

    def id_of(self, name: str) -> int:
        """The id of a label by name.

        Raises:
            LabelError: If the set has no such label; the message lists its names.
        """
        for label in self.labels:
            if label.name == name:
                return label.id
        raise LabelError(
            f"Label set {self.name!r} has no label {name!r}; it has {', '.join(self.names)}."
        )

    def ids_of_class(self, map_class: MapClass) -> tuple[int, ...]:
        """Ids of all labels that are that class of the map."""
        return tuple(label.id for label in self.labels if label.map_class == map_class)

    @property
    def moving_ids(self) -> tuple[int, ...]:
        """Ids of the labels of moving objects."""
        return tuple(label.id for label in self.labels if label.moves)

    @property
    def colors(self) -> NDArrayByte:
        """(256, 3) RGB look-up table; unknown ids are black."""
        table = np.zeros((256, 3), dtype=np.uint8)
        for label in self.labels:
            table[label.id] = label.color
        return table

    def check(self, label_image: NDArrayByte, what: str) -> None:
        """Refuse a label image that holds an id outside the set (255, to be ignored, is allowed).

        Raises:
            LabelError: With the lowest bad id and how many pixels have one, or
                with the dtype if it is not one of whole numbers.
        """
        if not np.issubdtype(label_image.dtype, np.integer):
            raise LabelError(f"{what} holds {label_image.dtype}, expected uint8 label ids.")
        bad = ((label_image < 0) | (label_image >= len(self))) & (label_image != IGNORE_ID)
        if bad.any():
            first = int(label_image[bad].min())
            raise LabelError(
                f"{what} holds label id {first} ({int(bad.sum())} pixels outside the set), but label set "
                f"{self.name!r} has ids 0..{len(self) - 1} and {IGNORE_ID} for ignore; "
                "name the label set that the image was made with."
            )


@lru_cache
def builtin_label_sets() -> dict[str, LabelSet]:
    """The label sets that ship with the package, by name."""
    folder = resources.files("hdmap_tools.labels") / "sets"
    sets = [
        LabelSet.model_validate_json(entry.read_text(encoding="utf-8"))
        for entry in sorted(folder.iterdir(), key=lambda e: e.name)
        if entry.name.endswith(".json")
    ]
    return {label_set.name: label_set for label_set in sets}


def load_label_set(name_or_path: str | Path) -> LabelSet:
    """A shipped label set by name, or one from a JSON file.

    Raises:
        LabelError: If there is neither; the message lists the shipped names.
    """
    shipped = builtin_label_sets()
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    path = Path(name_or_path)
    try:
        is_file = path.is_file()
    except (OSError, ValueError):  # too long for a path, or a NUL in it
        is_file = False
    if not is_file:
        raise LabelError(
            f"{shown(str(name_or_path))} is neither a label set ({', '.join(sorted(shipped))}) nor "
            "a JSON file."
        )
    try:
        return LabelSet.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        reason = brief_problems(error, "the file")
    except RecursionError:
        reason = "it is nested too deeply"
    except OSError as error:
        reason = f"it cannot be read: {error.strerror or type(error).__name__}"
    except ValueError as error:  # no JSON, no UTF-8, or a number of thousands of digits
        reason = f"it is not valid JSON ({error})"
    raise LabelError(f"{path} is not a label set: {reason}.")
