"""A set of map elements in one frame, with where they come from."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import shapely

from hdmap_tools.errors import FormatError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import MapElement

T = TypeVar("T", bound=MapElement)

_ID_GRID_M = 0.5
"""Positions are rounded to this before they enter an id, so that small changes keep it."""


@dataclass(frozen=True)
class VectorMap:
    """Map elements in one city frame.

    Attributes:
        frame: The city frame of all geometry.
        elements: Sorted by element type and id; ids are unique.
        provenance: What made the map: plugins with distribution, version and
            options, the semantic map's version. JSON-like.
    """

    frame: MapFrame
    elements: tuple[MapElement, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        ordered = tuple(sorted(self.elements, key=lambda e: (e.element_type, e.id)))
        ids = [element.id for element in ordered]
        if "" in ids:
            raise FormatError(
                f"Element ids must not be empty; {ids.count('')} of {len(ids)} are. "
                "Call with_stable_ids first."
            )
        repeated = sorted(i for i, count in Counter(ids).items() if count > 1)
        if repeated:
            raise FormatError(
                f"Element ids must be unique; {len(repeated)} occur again: {', '.join(repeated[:3])}. "
                "Give each element an id of its own, or none and call with_stable_ids."
            )
        object.__setattr__(self, "elements", ordered)

    def __len__(self) -> int:
        return len(self.elements)

    def __iter__(self) -> Iterator[MapElement]:
        return iter(self.elements)

    def of_type(self, element_type: type[T]) -> tuple[T, ...]:
        """All elements of that class, sorted by id."""
        return tuple(e for e in self.elements if isinstance(e, element_type))

    def counts(self) -> dict[str, int]:
        """Number of elements by element type."""
        result: dict[str, int] = {}
        for element in self.elements:
            result[element.element_type] = result.get(element.element_type, 0) + 1
        return result

    @property
    def bounds_m(self) -> tuple[float, float, float, float] | None:
        """(x0, y0, x1, y1) of all geometry in city metres, or None for an empty map."""
        if not self.elements:
            return None
        x0, y0, x1, y1 = shapely.total_bounds([e.geometry for e in self.elements])
        return float(x0), float(y0), float(x1), float(y1)

    def with_elements(self, elements: Iterable[MapElement]) -> VectorMap:
        """The same map with these elements added; those without an id are given one."""
        added = with_stable_ids(elements, taken={e.id for e in self.elements})
        return VectorMap(self.frame, self.elements + added, self.provenance)


def with_stable_ids(
    elements: Iterable[MapElement], taken: set[str] | None = None
) -> tuple[MapElement, ...]:
    """Give each element without an id one that follows from its type and place.

    Positions enter coarsely (0.5 m), so the same thing found again in a slightly
    different place mostly keeps its id; several of one type in one place are
    numbered in a fixed order.
    """
    elements = tuple(elements)
    taken = set(taken or ())
    result = [e for e in elements if e.id]
    taken.update(e.id for e in result)
    fresh = [e for e in elements if not e.id]
    # Ties broken by geometry and attributes, so that the order of arrival does not matter.
    for element in sorted(
        fresh,
        key=lambda e: (e.element_type, _place(e), e.geometry.wkb, e.model_dump_json()),
    ):
        base = f"{element.element_type}-{_place(element)}"
        candidate, number = base, 1
        while candidate in taken:
            number += 1
            candidate = f"{base}-{number}"
        taken.add(candidate)
        result.append(element.model_copy(update={"id": candidate}))
    return tuple(result)


def _place(element: MapElement) -> str:
    centre = element.geometry.centroid
    size = element.geometry.length
    key = np.round(np.array([centre.x, centre.y, size / 4.0]) / _ID_GRID_M).astype(int)
    return hashlib.sha256(repr(key.tolist()).encode()).hexdigest()[:10]
