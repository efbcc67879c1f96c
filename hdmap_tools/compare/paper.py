"""The measures of Paz et al. 2020: IoU and "accuracy" of road, crosswalk and lane mark.

Their accuracy is recall: TP / (TP + FN). A cell is predicted to be its most probable class
of all the map has; a cell without evidence is predicted to be none, so inside the mask
it is missed. What of the truth is compared is said by a mask, so that the figures can be had
near and far, on the slope, or where only one method saw anything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hdmap_tools.compare.reference import SHARE_TOLERANCE
from hdmap_tools.errors import LabelError, ShapeError
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MapClass
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

EVALUATED: Final = DRIVABLE_CLASSES
"""The classes of the paper's table: road, crosswalk, lane mark."""

PAINT_SHARE: Final = 0.35
"""A cell is lane mark when at least so much of it is paint. A mark 0.12 m wide covers 0.3 to 0.6
of the fuller of the 0.2 m cells across it; a sliver of one does not make its neighbour a mark."""

ANY_PAINT: Final = 0.0
"""The rule of the reference: any paint at all makes a cell mark, so its truth is dilated.
Source: design of the reference's evaluation, truth drawn at 5 cm and sampled down by 4 with ``> 0``."""

NO_TRUTH: Final = -1
UNKNOWN: Final = -1

_Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] | None
_Count = Annotated[int, Field(ge=0)]


class ClassScore(BaseModel):
    """How one class agrees; counts are cells, shares None where nothing could be counted.

    Attributes:
        iou: TP / (TP + FP + FN).
        accuracy: The paper's: TP / (TP + FN), recall.
        precision: TP / (TP + FP).
        true_positives, false_positives, false_negatives: Cells.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    iou: _Share
    accuracy: _Share
    precision: _Share
    true_positives: _Count
    false_positives: _Count
    false_negatives: _Count


class PaperScores(BaseModel):
    """The paper's measures of one map.

    Attributes:
        classes: Score of road, crosswalk and lane mark.
        miou: Mean IoU of those that have one.
        mean_accuracy: Mean accuracy of those that have one.
        coverage: Share of the truth's drivable cells in the mask that the map knows.
        num_cells: Cells in the mask that have truth.
        num_unknown: Those of them without evidence, which are missed.
        paint_share: Share of a cell that must be paint for it to be mark; 0: any paint.
        truth_rule: The same in words.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    classes: dict[str, ClassScore]
    miou: _Share
    mean_accuracy: _Share
    coverage: _Share
    num_cells: _Count
    num_unknown: _Count
    paint_share: Annotated[float, Field(ge=0.0, le=1.0)]
    truth_rule: str

    def to_json(self) -> str:
        """The document, indented, with a line break at its end."""
        return self.model_dump_json(indent=2) + "\n"


class PaperRow(BaseModel):
    """A row of the paper's table: IoU and accuracy by class, and mIoU."""

    model_config = ConfigDict(frozen=True)

    iou: tuple[float, float, float]
    miou: float
    accuracy: tuple[float, float, float]


PAPER_TABLE: Final[dict[str, PaperRow]] = {
    "Vanilla": PaperRow(iou=(0.715, 0.537, 0.135), miou=0.462, accuracy=(0.797, 0.577, 0.180)),
    "Vanilla+I": PaperRow(iou=(0.712, 0.510, 0.163), miou=0.462, accuracy=(0.789, 0.548, 0.234)),
    "CFN": PaperRow(iou=(0.671, 0.605, 0.301), miou=0.526, accuracy=(0.708, 0.696, 0.652)),
    "CFN+I": PaperRow(iou=(0.669, 0.588, 0.298), miou=0.518, accuracy=(0.705, 0.676, 0.657)),
}
"""Road, crosswalk, lane mark on a private campus at 0.2 m, points clipped to 15 m ahead and
10 m to each side. Source: Paz, Zhang, Li, Xiang, Christensen, Probabilistic Semantic Mapping for
Urban Autonomous Driving Applications, 2020, the table of results."""


def true_classes(
    shares: NDArrayFloat, classes: Sequence[str], paint_share: float = PAINT_SHARE
) -> NDArrayInt:
    """The one true class of each cell, from the shares of its area.

    Paint goes first, because it is thinner than a cell: a cell is lane mark when at least
    ``paint_share`` of it is. Any other cell is what most of it is; what no class covers is
    other. With ``ANY_PAINT`` the same holds for the crosswalk, as in the reference.

    Args:
        shares: (class, y, x) share of each cell, 0..1; NaN where the truth says nothing.
        classes: Their names.
        paint_share: See above.

    Returns:
        (y, x) index into ``(*classes, "other")``, `NO_TRUTH` where the truth says nothing.
    """
    shares = np.asarray(shares)
    if shares.ndim != 3 or len(shares) != len(classes):
        raise ShapeError(
            f"Shares of {len(classes)} classes must be ({len(classes)}, y, x), found {shares.shape}."
        )
    if not 0.0 <= paint_share <= 1.0:
        raise ShapeError(f"paint_share must be 0..1, found {paint_share}.")
    names = [str(c) for c in classes]
    has_truth = np.isfinite(shares).all(axis=0)
    filled = np.where(has_truth, shares, 0.0)
    other = np.clip(1.0 - filled.sum(axis=0), 0.0, 1.0)
    first = [MapClass.CROSSWALK, MapClass.LANE_MARK] if paint_share == 0 else [MapClass.LANE_MARK]
    rest = np.concatenate([filled, other[None]])
    # Paint that is too little for a mark lies on the road; it must not win by a split of the rest.
    if MapClass.LANE_MARK in names and MapClass.ROAD in names:
        rest[names.index(MapClass.ROAD)] += rest[names.index(MapClass.LANE_MARK)]
        rest[names.index(MapClass.LANE_MARK)] = 0.0
    truth = rest.argmax(axis=0)
    for name in first:
        if name in names:
            share = filled[names.index(name)]
            enough = (
                share > SHARE_TOLERANCE
                if paint_share == 0
                else share >= paint_share - SHARE_TOLERANCE
            )
            truth[enough] = names.index(name)
    truth[~has_truth] = NO_TRUTH
    return np.asarray(truth, dtype=np.int64)


def predicted_classes(posterior: NDArrayFloat) -> NDArrayInt:
    """(y, x) index of the most probable class of a posterior (class, y, x), `UNKNOWN` where there is none."""
    known = np.isfinite(posterior).all(axis=0)
    best = np.nan_to_num(posterior, nan=-1.0).argmax(axis=0)
    return np.where(known, best, UNKNOWN)


def paper_scores(
    posterior: NDArrayFloat,
    classes: Sequence[str],
    shares: NDArrayFloat,
    share_classes: Sequence[str],
    mask: NDArrayBool | None = None,
    *,
    paint_share: float = PAINT_SHARE,
) -> PaperScores:
    """Hold a map against the true shares of its cells.

    Read the posterior with and without hole filling to have the figures of both.

    Args:
        posterior: (class, y, x), NaN where unknown; its classes may end with ``other``.
        classes: Their names.
        shares: (class, y, x) share of each cell, NaN where the truth says nothing.
        share_classes: Their names, in any order.
        mask: (y, x) bool, cells to compare; None compares all that have truth.
        paint_share: See `true_classes`.

    Raises:
        ShapeError: If the arrays do not fit.
        LabelError: If map or truth lack road, crosswalk or lane mark.
    """
    names, true_names = [str(c) for c in classes], [str(c) for c in share_classes]
    for what, have in (("map", names), ("truth", true_names)):
        missing = [str(c) for c in EVALUATED if str(c) not in have]
        if missing:
            raise LabelError(f"The {what} has no {' or '.join(missing)}; it has {', '.join(have)}.")
    if posterior.shape[1:] != shares.shape[1:] or len(posterior) != len(names):
        raise ShapeError(
            f"The posterior {posterior.shape} of {len(names)} classes and the truth {shares.shape} must be "
            "over the same cells."
        )
    truth = true_classes(shares, true_names, paint_share)
    compared = truth != NO_TRUTH
    if mask is not None:
        if mask.shape != compared.shape:
            raise ShapeError(f"The mask is {mask.shape} and the map {compared.shape}.")
        compared &= np.asarray(mask, dtype=bool)
    predicted, truth = predicted_classes(posterior)[compared], truth[compared]
    scores = {
        str(c): _score(predicted == names.index(c), truth == true_names.index(c)) for c in EVALUATED
    }
    drivable = np.isin(truth, [true_names.index(c) for c in EVALUATED])
    return PaperScores(
        classes=scores,
        miou=_mean([s.iou for s in scores.values()]),
        mean_accuracy=_mean([s.accuracy for s in scores.values()]),
        coverage=_ratio(int((drivable & (predicted != UNKNOWN)).sum()), int(drivable.sum())),
        num_cells=len(truth),
        num_unknown=int((predicted == UNKNOWN).sum()),
        paint_share=paint_share,
        truth_rule=describe_paint_rule(paint_share),
    )


def pooled_scores(scores: Sequence[PaperScores]) -> PaperScores:
    """The measures over the cells of several maps together; at least one."""
    classes = {}
    for name in scores[0].classes:
        each = [one.classes[name] for one in scores]
        classes[name] = _from_counts(
            sum(s.true_positives for s in each),
            sum(s.false_positives for s in each),
            sum(s.false_negatives for s in each),
        )
    # Coverage is of the truth's drivable cells; those are found or missed by some class.
    weights = [
        sum(s.true_positives + s.false_negatives for s in one.classes.values()) for one in scores
    ]
    known = sum(w * (one.coverage or 0.0) for w, one in zip(weights, scores, strict=True))
    return PaperScores(
        classes=classes,
        miou=_mean([s.iou for s in classes.values()]),
        mean_accuracy=_mean([s.accuracy for s in classes.values()]),
        coverage=known / sum(weights) if sum(weights) else None,
        num_cells=sum(one.num_cells for one in scores),
        num_unknown=sum(one.num_unknown for one in scores),
        paint_share=scores[0].paint_share,
        truth_rule=scores[0].truth_rule,
    )


def describe_paint_rule(paint_share: float) -> str:
    """When a cell is lane mark, in words."""
    if paint_share == ANY_PAINT:
        return "a cell is lane mark when any of it is paint (the reference's rule)"
    return f"a cell is lane mark when at least {paint_share:.0%} of it is paint"


def paper_table(scores: Mapping[str, PaperScores]) -> str:
    """A table of measured figures with the paper's below, for people to read.

    Args:
        scores: By method; those named as in `PAPER_TABLE` stand beside the paper's.
    """
    head = ("method", "IoU road", "crosswalk", "lane mark", "mIoU", "acc. road", "crosswalk")
    rows: list[tuple[str, ...]] = [(*head, "lane mark", "coverage")]
    for name, one in scores.items():
        each = [one.classes[str(c)] for c in EVALUATED]
        figures = [*(s.iou for s in each), one.miou, *(s.accuracy for s in each), one.coverage]
        rows.append((name, *(_shown(f) for f in figures)))
        if name in PAPER_TABLE:
            paper = PAPER_TABLE[name]
            known = [*paper.iou, paper.miou, *paper.accuracy, None]
            rows.append(("  in the paper", *(_shown(f) for f in known)))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "  ".join(
            [
                row[0].ljust(widths[0]),
                *(v.rjust(w) for v, w in zip(row[1:], widths[1:], strict=True)),
            ]
        )
        for row in rows
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def _score(predicted: NDArrayBool, truth: NDArrayBool) -> ClassScore:
    tp = int((predicted & truth).sum())
    fp = int((predicted & ~truth).sum())
    fn = int((~predicted & truth).sum())
    return _from_counts(tp, fp, fn)


def _from_counts(tp: int, fp: int, fn: int) -> ClassScore:
    return ClassScore(
        iou=_ratio(tp, tp + fp + fn),
        accuracy=_ratio(tp, tp + fn),
        precision=_ratio(tp, tp + fp),
        true_positives=tp,
        false_positives=fp,
        false_negatives=fn,
    )


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _mean(values: Sequence[float | None]) -> float | None:
    counted = [v for v in values if v is not None]
    return float(np.mean(counted)) if counted else None


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
