"""One element out of the parts of it that several windows saw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from hdmap_tools.map_model.elements import MapElement, RoadBoundary

_TAKEN = frozenset({"geometry", "id", "plugin", "plugin_version"})


def combined(parts: Sequence[tuple[MapElement, float]], geometry: BaseGeometry) -> MapElement:
    """An element with the parts' attributes, each weighted by how much of it that part is.

    Numbers are averaged, standard deviations as variances; of everything else the value of the
    greatest part of the element is taken.

    Args:
        parts: Elements of one type, each with its length or area.
        geometry: Of the whole.
    """
    weights = np.array([max(weight, 1e-9) for _, weight in parts])
    weights /= weights.sum()
    elements = [element for element, _ in parts]
    first = elements[int(np.argmax(weights))]
    changed: dict[str, Any] = {"geometry": geometry}
    for name in type(first).model_fields:
        if name in _TAKEN:
            continue
        values = [getattr(element, name) for element in elements]
        changed[name] = _mean(name, values, weights) if _are_numbers(values) else _most(values, weights)  # fmt: skip
    if isinstance(first, RoadBoundary) and geometry.is_closed:
        # The road lies on the right of a boundary, so around an island it runs counter-clockwise.
        changed["is_island"] = bool(shapely.is_ccw(geometry))
    return first.model_copy(update=changed)


def _are_numbers(values: list[Any]) -> bool:
    known = [value for value in values if value is not None]
    return bool(known) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in known
    )


def _mean(name: str, values: list[Any], weights: Any) -> float | int:
    known = [k for k, value in enumerate(values) if value is not None]
    numbers, shares = np.array([float(values[k]) for k in known]), weights[known]
    if name.startswith("sigma"):
        return float(np.sqrt(np.average(numbers**2, weights=shares)))
    mean = float(np.average(numbers, weights=shares))
    return round(mean) if all(isinstance(values[k], int) for k in known) else mean


def _most(values: list[Any], weights: Any) -> Any:
    """The value of the greatest weight; of equals the one that came first."""
    share: dict[str, float] = {}
    for value, weight in zip(values, weights, strict=True):
        share[repr(value)] = share.get(repr(value), 0.0) + float(weight)
    best = max(share, key=lambda key: share[key])
    return next(value for value in values if repr(value) == best)
