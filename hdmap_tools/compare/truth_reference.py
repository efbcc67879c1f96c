"""The truth of a simulated drive on a map's grid, so that a map can be held against it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdmap_tools.compare.paper import PAINT_SHARE, describe_paint_rule, true_classes
from hdmap_tools.compare.reference import (
    DRIVABLE_GROUP,
    SHARE_TOLERANCE,
    Reference,
    ReferenceGroup,
    frame_relation,
    no_overlap,
)
from hdmap_tools.errors import FormatError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MAP_CLASSES
from hdmap_tools.simulate.truth_raster import TruthRaster
from hdmap_tools.types import NDArrayFloat


def true_shares(raster: TruthRaster, grid: BevGrid) -> NDArrayFloat:
    """(class, y, x) share of each cell that each map class covers; NaN where not all of it is known."""
    shares = raster.class_fractions(grid, MAP_CLASSES).astype(np.float64)
    shares[:, raster.known_fraction(grid) < 1.0 - SHARE_TOLERANCE] = np.nan
    return shares


def reference_from_truth_raster(
    folder: Path, grid: BevGrid, *, paint_share: float = PAINT_SHARE
) -> Reference:
    """The true classes of the cells of a grid.

    Args:
        folder: ``truth/raster`` of a simulated drive.
        grid: The map's cells; a whole number of 2 cm wide.
        paint_share: See `true_classes`.

    Raises:
        FormatError: If it is no truth raster, or of another place.
        CRSMismatchError: If it is of another frame.
        MapMismatchError: If the resolution does not fit.
    """
    raster = TruthRaster.open(folder)
    source = f"truth of {folder.absolute().parent.parent.name}"
    frame_relation(raster.frame, grid.frame, source)
    shares = true_shares(raster, grid)
    covered = np.asarray(np.isfinite(shares).all(axis=0))
    if not covered.any():
        raise FormatError(str(no_overlap(source, raster.bounds_m, grid)))
    index = true_classes(shares, [str(c) for c in MAP_CLASSES], paint_share)
    groups = [
        ReferenceGroup(str(c), (c,), np.asarray(index == k)) for k, c in enumerate(MAP_CLASSES)
    ]
    drivable = [MAP_CLASSES.index(c) for c in DRIVABLE_CLASSES]
    groups.append(ReferenceGroup(DRIVABLE_GROUP, DRIVABLE_CLASSES, np.isin(index, drivable)))
    return Reference(grid, tuple(groups), covered, source, describe_paint_rule(paint_share))
