"""The truth of a simulated drive on a map's grid, so that a map can be held against it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from pathlib import Path

import numpy as np

from hdmap_tools.compare.paper import NO_TRUTH, PAINT_SHARE, describe_paint_rule, true_classes
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
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayFloat


def true_shares(raster: TruthRaster, grid: BevGrid) -> NDArrayFloat:
    """(class, y, x) share of each cell that each map class covers; NaN where not all of it is known."""
    covered, known_shares = _covered(raster, grid)
    shares = np.full((len(MAP_CLASSES), *grid.shape), np.nan)
    shares[:, covered] = known_shares
    return shares


def _covered(raster: TruthRaster, grid: BevGrid) -> tuple[NDArrayBool, NDArrayFloat]:
    """(y, x) which cells are wholly known, and (class, N) the shares of those."""
    shares, known = raster.shares(grid, MAP_CLASSES)
    covered = np.asarray(known >= 1.0 - SHARE_TOLERANCE)
    return covered, shares[:, covered].astype(np.float64)


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
    [reference] = references_from_truth_raster(folder, [grid], paint_share=paint_share)
    return reference


def references_from_truth_raster(
    folder: Path, grids: Sequence[BevGrid], *, paint_share: float = PAINT_SHARE
) -> list[Reference]:
    """The same for several grids of one lattice, for which the truth is read once.

    Args:
        folder: ``truth/raster`` of a simulated drive.
        grids: The cells of each map, at least one.
        paint_share: See `true_classes`.

    Raises:
        HDMapError: As `reference_from_truth_raster`, and if the grids differ in resolution.
    """
    raster = TruthRaster.open(folder)
    source = f"truth of {folder.absolute().parent.parent.name}"
    whole = reduce(BevGrid.union, grids)
    frame_relation(raster.frame, whole.frame, source)
    covered, shares = _covered(raster, whole)
    index = np.full(whole.shape, NO_TRUTH, dtype=np.int8)
    index[covered] = true_classes(shares[:, None], [str(c) for c in MAP_CLASSES], paint_share)[0]
    references = []
    for grid in grids:
        part = (
            slice(grid.y_min - whole.y_min, grid.y_max - whole.y_min),
            slice(grid.x_min - whole.x_min, grid.x_max - whole.x_min),
        )
        if not covered[part].any():
            raise FormatError(str(no_overlap(source, raster.bounds_m, grid)))
        references.append(
            Reference(
                grid,
                _groups(index[part]),
                covered[part].copy(),
                source,
                describe_paint_rule(paint_share),
            )
        )
    return references


def _groups(index: NDArrayAny) -> tuple[ReferenceGroup, ...]:
    """Each class, and the drivable ones, of true classes (y, x)."""
    groups = [
        ReferenceGroup(str(c), (c,), np.asarray(index == k)) for k, c in enumerate(MAP_CLASSES)
    ]
    of_class = {group.name: group.truth for group in groups}
    drivable = np.logical_or.reduce([of_class[str(c)] for c in DRIVABLE_CLASSES])
    return (*groups, ReferenceGroup(DRIVABLE_GROUP, DRIVABLE_CLASSES, drivable))
