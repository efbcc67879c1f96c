"""The probabilistic map against truth cells, class by class, where the drive could see.

IoU = TP / (TP + FP + FN); recall = TP / (TP + FN), which Paz et al. (2020) call
accuracy; precision = TP / (TP + FP). A cell's class is its most probable one; it is
predicted to be in a union of classes when that one class is, not when the
probabilities of the union sum to the most. Ties go to the class listed first.
"""

from __future__ import annotations

import logging
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

from hdmap_tools.compare.reference import Reference, ReferenceGroup
from hdmap_tools.errors import LabelError, MapMismatchError, ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.types import NDArrayBool, NDArrayFloat

logger = logging.getLogger(__name__)

_Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] | None
_Count = Annotated[int, Field(ge=0)]


class GroupScore(BaseModel):
    """How one class, or a union of classes, agrees; counts are cells.

    Attributes:
        classes: Map classes of the union.
        iou, recall, precision: None where nothing could be counted: a class that
            neither map has in the compared cells is neither right nor wrong.
        true_positives: Map and reference both say so.
        false_positives: Only the map does.
        false_negatives: Only the reference does.
        true_negatives: Neither does.
        truth_area_m2: Reference area in the compared cells.
        predicted_area_m2: Map area in the compared cells.
        truth_not_observed_m2: Reference area within range that the map has no evidence about.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: tuple[str, ...]
    iou: _Share
    recall: _Share
    precision: _Share
    true_positives: _Count
    false_positives: _Count
    false_negatives: _Count
    true_negatives: _Count
    truth_area_m2: float
    predicted_area_m2: float
    truth_not_observed_m2: float


class RasterComparison(BaseModel):
    """Cells of a map held against cells of a reference.

    Attributes:
        schema_version: Raised when a field changes its meaning.
        reference: Name of the reference.
        frame: The city frame in which cells were compared.
        resolution_m: Cell size.
        truth_rule: When a cell of the reference is truth.
        max_range_m: Only cells this near to the driven path were compared; None: all.
        num_cells: Compared cells: with evidence, covered by the reference, within range.
        area_m2: Their area.
        num_cells_filled: Those among them filled from neighbours, without a vote of their own.
        num_cells_not_observed: Cells within range and reference but without evidence.
        groups: Score by class, and by union of classes such as ``drivable``.
        miou: Mean IoU of the single classes that have one; None if none has.
        notes: What a reader of the figures should know.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    reference: str
    frame: str
    resolution_m: Annotated[float, Field(gt=0)]
    truth_rule: str
    max_range_m: float | None
    num_cells: _Count
    area_m2: float
    num_cells_filled: _Count
    num_cells_not_observed: _Count
    groups: dict[str, GroupScore]
    miou: _Share
    notes: tuple[str, ...] = ()
    _compared: NDArrayBool | None = PrivateAttr(default=None)

    @property
    def compared(self) -> NDArrayBool | None:
        """(y, x) bool: the compared cells; None when this was read from a file."""
        return self._compared

    def __eq__(self, other: object) -> bool:
        # pydantic would compare the cells too, which a comparison from a file does not have.
        return isinstance(other, RasterComparison) and self.model_dump() == other.model_dump()

    def to_json(self) -> str:
        """The document, indented, with a line break at its end."""
        return self.model_dump_json(indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> RasterComparison:
        """From what `to_json` gave."""
        return cls.model_validate_json(text)


def compare_raster(
    window: MapWindow,
    reference: Reference,
    *,
    visible: NDArrayBool | None = None,
    path_xy: NDArrayFloat | None = None,
    max_range_m: float | None = None,
    count_filled: bool = True,
) -> RasterComparison:
    """Compare a map with a reference on the same grid, where the map has evidence.

    With no cell to compare, every score is None and a note says why: that a drive
    misses its reference is a finding, not a failure of the comparison.

    Args:
        window: The map.
        reference: Truth on the window's grid.
        visible: (y, x) bool: compare these cells only.
        path_xy: (N, 2) or (N, 3) points of the driven path, city metres.
        max_range_m: Compare only cells whose centre is this near to one of those
            points, metres; needs path_xy.
        count_filled: Also compare cells that were filled from their neighbours.

    Raises:
        MapMismatchError: If the grids differ.
        ShapeError: If an array does not fit, or a range comes without a path.
        LabelError: If the map lacks every class of a group of the reference.
    """
    _require_same_cells(window.grid, reference.grid)
    in_range = reference.is_covered & cells_in_range(window.grid, path_xy, max_range_m)
    if visible is not None:
        if np.shape(visible) != window.grid.shape:
            raise ShapeError(
                f"visible must be bool of the grid's shape {window.grid.shape}, found {np.shape(visible)}."
            )
        in_range &= np.asarray(visible, dtype=bool)
    posterior = window.dataset["posterior"].values
    has_evidence = np.isfinite(posterior).all(axis=0)
    is_filled = has_evidence & ~(window.layer("observations") > 0)
    if not count_filled:
        has_evidence &= ~is_filled
    compared = in_range & has_evidence
    not_observed = in_range & ~has_evidence
    best = posterior[:, compared].argmax(axis=0)
    cell_m2 = window.grid.resolution_m**2
    groups = {
        group.name: _score(group, window.classes, best, compared, not_observed, cell_m2)
        for group in reference.groups
    }
    notes = list(reference.notes)
    if not compared.any():
        notes.append(
            f"Nothing was compared: none of the {int(in_range.sum())} cells within range and reference has "
            "evidence."
        )
        logger.warning("%s", notes[-1])
    single = [s.iou for s in groups.values() if len(s.classes) == 1 and s.iou is not None]
    comparison = RasterComparison(
        reference=reference.source,
        frame=window.frame.describe(),
        resolution_m=window.grid.resolution_m,
        truth_rule=reference.rule,
        max_range_m=max_range_m,
        num_cells=int(compared.sum()),
        area_m2=round(int(compared.sum()) * cell_m2, 6),
        num_cells_filled=int((compared & is_filled).sum()),
        num_cells_not_observed=int(not_observed.sum()),
        groups=groups,
        miou=float(np.mean(single)) if single else None,
        notes=tuple(notes),
    )
    comparison._compared = compared
    return comparison


def cells_in_range(
    grid: BevGrid, path_xy: NDArrayFloat | None, max_range_m: float | None
) -> NDArrayBool:
    """(y, x) bool: cells whose centre is within max_range_m of a point of the path.

    Raises:
        ShapeError: If a range is given without a path, or the path is not (N, 2) or (N, 3).
    """
    if max_range_m is None:
        return np.ones(grid.shape, dtype=bool)
    if path_xy is None or np.ndim(path_xy) != 2 or np.shape(path_xy)[1] not in (2, 3):
        raise ShapeError(
            f"max_range_m needs path_xy (N, 2) in city metres, found {None if path_xy is None else np.shape(path_xy)}."
        )
    path = np.asarray(path_xy, dtype=np.float64)[:, :2]
    path = path[np.isfinite(path).all(axis=1)]
    if len(path) == 0 or not max_range_m > 0:
        raise ShapeError(
            f"max_range_m needs a positive range and at least one finite path point, found "
            f"{max_range_m} m and {len(path)} points."
        )
    from hdmap_tools.compare.range_kernels import mark_near

    return np.asarray(
        mark_near(grid.x_centres_m, grid.y_centres_m, path, max_range_m * (1 + 1e-9)) > 0
    )


def predicted_cells(window: MapWindow, group: ReferenceGroup) -> NDArrayBool:
    """(y, x) bool: cells with evidence whose most probable class is in the group."""
    posterior = window.dataset["posterior"].values
    best = np.nan_to_num(posterior, nan=-1.0).argmax(axis=0)
    return np.asarray(np.isfinite(posterior).all(axis=0) & _in_group(group, window.classes, best))


def _in_group(group: ReferenceGroup, classes: tuple[str, ...], best: object) -> NDArrayBool:
    ids = [classes.index(str(c)) for c in group.classes if str(c) in classes]
    if not ids:
        raise LabelError(
            f"The map has no class of the reference's {group.name!r} ({', '.join(group.classes)}); it has "
            f"{', '.join(classes)}."
        )
    return np.asarray(np.isin(np.asarray(best), ids))


def _score(
    group: ReferenceGroup,
    classes: tuple[str, ...],
    best: object,
    compared: NDArrayBool,
    not_observed: NDArrayBool,
    cell_m2: float,
) -> GroupScore:
    predicted = _in_group(group, classes, best)
    truth = group.truth[compared]
    tp = int((predicted & truth).sum())
    fp = int((predicted & ~truth).sum())
    fn = int((~predicted & truth).sum())
    return GroupScore(
        classes=tuple(str(c) for c in group.classes),
        iou=_ratio(tp, tp + fp + fn),
        recall=_ratio(tp, tp + fn),
        precision=_ratio(tp, tp + fp),
        true_positives=tp,
        false_positives=fp,
        false_negatives=fn,
        true_negatives=int(truth.size - tp - fp - fn),
        truth_area_m2=round((tp + fn) * cell_m2, 6),
        predicted_area_m2=round((tp + fp) * cell_m2, 6),
        truth_not_observed_m2=round(int((group.truth & not_observed).sum()) * cell_m2, 6),
    )


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _require_same_cells(grid: BevGrid, other: BevGrid) -> None:
    grid.require_same_lattice(other)
    bounds = [(g.x_min, g.y_min, g.x_max, g.y_max) for g in (grid, other)]
    if bounds[0] != bounds[1]:
        raise MapMismatchError(
            f"The map covers cells {bounds[0]} and the reference {bounds[1]} (x_min, y_min, x_max, y_max); "
            "sample the reference onto the map's own grid."
        )
