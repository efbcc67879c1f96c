"""Whether points spread in space so that a pose can be told from them."""

from __future__ import annotations

from typing import Final

import numpy as np

from hdmap_tools.errors import CalibrationError
from hdmap_tools.types import NDArrayFloat

_LINE_SHARE: Final = 0.01
_PLANE_SHARE: Final = 0.02
_FLAT_SHARE: Final = 0.1


def principal_extents(points: NDArrayFloat) -> NDArrayFloat:
    """(3,) root mean square extents, metres, along the axes of the points (N, 3), largest first."""
    centred = points - points.mean(axis=0)
    return np.asarray(np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(points)))


def require_spread(points: NDArrayFloat, what: str) -> list[str]:
    """Refuse points of one line or one plane.

    Args:
        points: (N, 3) metres.
        what: Names them in messages, for example ``The 20 pairs``.

    Returns:
        Warnings about points nearly on a plane.

    Raises:
        CalibrationError: If the points lie on a line (any turn about it fits) or on a plane:
            there the equations of EPnP lose rank, OpenCV's solver returns wrong poses without
            a word, and a second pose mirrored in the plane fits nearly as well.

    Source:
        Lepetit, Moreno-Noguer and Fua, EPnP: An Accurate O(n) Solution to the PnP Problem,
        IJCV 2009, section 3.4 (planar configurations).
    """
    first, second, third = principal_extents(points)
    sizes = f"{first:.3g}, {second:.3g} and {third:.3g} m (RMS) along their axes"
    if second <= _LINE_SHARE * first:
        raise CalibrationError(
            f"{what} lie on one line: they extend {sizes}. Any turn about the line fits them; take "
            "points off it."
        )
    if third <= _PLANE_SHARE * second:
        raise CalibrationError(
            f"{what} lie on one plane: they extend {sizes}. A plane leaves two poses that fit nearly "
            "as well, and EPnP fails on it; add points off the plane (poles, edges of walls, a board "
            "at several distances)."
        )
    if third <= _FLAT_SHARE * second:
        return [f"the points are nearly on one plane: they extend {sizes}; add points off it"]
    return []
