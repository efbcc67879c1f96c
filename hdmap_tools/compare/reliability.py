"""Whether a map's probabilities mean what they say: of cells claimed with 0.8, 0.8 must be right.

Source: Guo, Pleiss, Sun, Weinberger, On Calibration of Modern Neural Networks, 2017
(reliability diagram, expected calibration error in 15 bins); Brier, Verification of
forecasts expressed in terms of probability, 1950.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hdmap_tools.compare.paper import NO_TRUTH
from hdmap_tools.compare.reference import Reference
from hdmap_tools.errors import LabelError, ShapeError
from hdmap_tools.fusion.temperature import EvidenceCells, fit_temperature
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

NUM_BINS: Final = 15

_LEAST: Final = 1e-12
"""A true class of probability 0 costs as much as this one: the mean stays a number."""

_Share = Annotated[float, Field(ge=0.0, le=1.0 + 1e-9, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=0)]


class ReliabilityBin(BaseModel):
    """Cells of about one confidence.

    Attributes:
        confidence: Their mean confidence: the probability of their most probable class.
        accuracy: Share of them whose most probable class is true.
        count: Cells.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    confidence: _Share
    accuracy: _Share
    count: _Count


class ReliabilityCurve(BaseModel):
    """How confidence and accuracy go together.

    Attributes:
        bins: Bins of equal width that hold cells, by confidence.
        ece: Expected calibration error over bins of equal width: mean of
            |confidence - accuracy|, weighted by cells.
        ece_equal_mass: The same over bins of equally many cells, which no empty bin can flatter.
        class_ece: For each class, the same over the probability of that class alone, in
            bins of equal width: a rare class shows here and is lost in the others.
        brier: Mean squared distance of the probabilities from the truth, summed over classes, 0..2.
        nll: Mean negative log-likelihood of the true class, nats.
        accuracy: Share of all cells whose most probable class is true.
        mean_confidence: Of all cells.
        num_cells: Cells.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    bins: tuple[ReliabilityBin, ...]
    ece: _Share
    ece_equal_mass: _Share
    class_ece: dict[str, _Share]
    brier: Annotated[float, Field(ge=0.0, le=2.0 + 1e-9)]
    nll: Annotated[float, Field(ge=0.0)]
    accuracy: _Share
    mean_confidence: _Share
    num_cells: _Count


class ReliabilityReport(BaseModel):
    """A map's reliability on a held-out area, before and after fitting a temperature elsewhere.

    Attributes:
        truth: What the map was held against.
        classes: What is told apart; unions of classes where the truth tells no more.
        temperature: To be used as ``observation.temperature``: fitted on one half of the area.
        temperature_before: The one the map was read with.
        num_cells_fitted: Cells of that half.
        class_shares: Share of each of the classes in that half. Where a network cannot tell
            some of them apart, no temperature mends a prior that is far from these
            (``observation.priors``, ``observation.other_prior``).
        before: The other half, as the map was read.
        after: The other half, with the fitted temperature.
        rule: Which cells are which half.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    truth: str
    classes: tuple[str, ...]
    temperature: Annotated[float, Field(gt=0)]
    temperature_before: Annotated[float, Field(gt=0)]
    num_cells_fitted: _Count
    class_shares: dict[str, _Share] = Field(default_factory=dict)
    before: ReliabilityCurve
    after: ReliabilityCurve
    rule: str

    def to_json(self) -> str:
        """The document, indented, with a line break at its end."""
        return self.model_dump_json(indent=2) + "\n"


@dataclass(frozen=True, eq=False)
class CellTruth:
    """True class, or true union of classes, of each cell.

    Attributes:
        index: (y, x) group of each cell, `NO_TRUTH` where nothing is known.
        members: (group, class) bool: the map's classes that make up each group.
        names: Of the groups.
        source: Where the truth comes from.
    """

    index: NDArrayInt
    members: NDArrayBool
    names: tuple[str, ...]
    source: str = ""


def reliability(
    posterior: NDArrayFloat,
    truth: NDArrayInt,
    mask: NDArrayBool | None = None,
    *,
    names: Sequence[str] = (),
    num_bins: int = NUM_BINS,
) -> ReliabilityCurve:
    """Hold probabilities against the truth.

    Args:
        posterior: (class, *shape) probabilities; cells with NaN are left out.
        truth: (*shape) index of the true class; negative where it is not known.
        mask: (*shape) bool, cells to look at; None looks at all.
        names: Of the classes, for `class_ece`; their numbers if empty.
        num_bins: Bins of equal width, and of equally many cells.

    Raises:
        ShapeError: If the arrays do not fit, or no cell is left.
    """
    posterior, truth = np.asarray(posterior), np.asarray(truth)
    if posterior.shape[1:] != truth.shape or (mask is not None and mask.shape != truth.shape):
        raise ShapeError(
            f"Posterior {posterior.shape}, truth {truth.shape} and mask "
            f"{None if mask is None else mask.shape} are not over the same cells."
        )
    use = np.isfinite(posterior).all(axis=0) & (truth >= 0)
    if mask is not None:
        use &= mask
    p, t = posterior[:, use].astype(np.float64), truth[use]
    if not len(t):
        raise ShapeError(
            "No cell has both a probability and a truth, so nothing can be said of them."
        )
    if t.max() >= len(p):
        raise ShapeError(f"Truth names class {int(t.max())}, the posterior has {len(p)}.")
    best = p.argmax(axis=0)
    confidence, right = p[best, np.arange(len(t))], best == t
    bins = _equal_width(confidence, right, num_bins)
    one_hot = np.arange(len(p))[:, None] == t
    labels = [str(n) for n in names] or [str(k) for k in range(len(p))]
    return ReliabilityCurve(
        bins=bins,
        ece=_ece(bins),
        ece_equal_mass=_ece(_equal_mass(confidence, right, num_bins)),
        class_ece={
            name: _ece(_equal_width(p[k], one_hot[k], num_bins)) for k, name in enumerate(labels)
        },
        brier=float(((p - one_hot) ** 2).sum(axis=0).mean()),
        nll=float(-np.log(np.clip(p[t, np.arange(len(t))], _LEAST, 1.0)).mean()),
        accuracy=float(right.mean()),
        mean_confidence=float(min(confidence.mean(), 1.0)),
        num_cells=len(t),
    )


def truth_of_classes(
    index: NDArrayInt, names: Sequence[str], classes: Sequence[str], source: str
) -> CellTruth:
    """Truth that tells single classes, in the map's own order of classes.

    Args:
        index: (y, x) index into names, negative where the truth says nothing
            (`hdmap_tools.compare.paper.true_classes`, whose last is ``other``).
        names: What the index means.
        classes: The map's classes. Cells of a class that the map does not have count as
            its ``other`` where it has that, and are left out where it has not.
        source: Where the truth comes from.
    """
    listed = [str(c) for c in classes]
    other = listed.index("other") if "other" in listed else NO_TRUTH
    table = np.array([listed.index(n) if n in listed else other for n in names] + [NO_TRUTH])
    return CellTruth(
        table[np.where(np.asarray(index) < 0, -1, index)],
        np.eye(len(listed), dtype=bool),
        tuple(listed),
        source,
    )


def truth_of_reference(reference: Reference, classes: Sequence[str]) -> CellTruth:
    """Truth from a reference, whose groups may overlap or be unions that it does not tell apart.

    Classes of the map that belong to the same groups of the reference cannot be told apart
    with it, and are taken together. Cells whose groups contradict one another are left out.

    Raises:
        LabelError: If it tells no two of the map's classes apart.
    """
    listed = [str(c) for c in classes]
    membership = np.array([[c in map(str, g.classes) for c in listed] for g in reference.groups])
    kinds, group_of = np.unique(membership.T, axis=0, return_inverse=True)
    group_of = group_of.reshape(-1)
    if len(kinds) < 2:
        raise LabelError(
            f"Reference {reference.source} does not tell any two of the map's classes apart "
            f"({', '.join(listed)})."
        )
    members = group_of[None, :] == np.arange(len(kinds))[:, None]
    found = np.stack([group.truth for group in reference.groups], axis=-1)
    matches = (found[None] == kinds[:, None, None, :]).all(axis=-1)
    index = np.where(matches.any(axis=0) & reference.is_covered, matches.argmax(axis=0), NO_TRUTH)
    names = tuple("+".join(c for c, own in zip(listed, row, strict=True) if own) for row in members)
    return CellTruth(index, members, names, reference.source)


def assess(
    cells: EvidenceCells,
    truth: CellTruth,
    is_for_fit: NDArrayBool,
    rule: str,
    temperature: float = 1.0,
) -> ReliabilityReport:
    """Fit a temperature on one part of the cells, and judge the probabilities on the rest.

    Args:
        cells: Cells of a map (`read_evidence`).
        truth: Over the grid that the cells were read over.
        is_for_fit: (y, x) bool over that grid: cells to fit on.
        rule: What is_for_fit is, in words.
        temperature: The one that the cells were read with.

    Raises:
        ShapeError: If one of the two parts has no cell with truth.
    """
    rows, cols = cells.cells.T
    index, fits = truth.index[rows, cols], is_for_fit[rows, cols]
    told = index != NO_TRUTH
    number = int((told & fits).sum()), int((told & ~fits).sum())
    if min(number) == 0:
        raise ShapeError(
            f"A temperature needs cells to be fitted on and others to be tried on, found {number[0]} and "
            f"{number[1]} cells that the map knows and the truth covers ({rule}); is the truth of this place?"
        )
    fitted_on, tried_on = cells[told & fits], cells[told & ~fits]
    fit = fit_temperature(
        fitted_on.evidence, index[told & fits], fitted_on.offset, members=truth.members
    )

    def curve(further: float) -> ReliabilityCurve:
        grouped = truth.members.astype(np.float64) @ tried_on.posterior(further)
        return reliability(grouped, index[told & ~fits], names=truth.names)

    return ReliabilityReport(
        truth=truth.source,
        classes=truth.names,
        temperature=temperature * fit.temperature,
        temperature_before=temperature,
        num_cells_fitted=fit.num_cells,
        class_shares={
            name: float((index[told & fits] == k).mean()) for k, name in enumerate(truth.names)
        },
        before=curve(1.0),
        after=curve(fit.temperature),
        rule=rule,
    )


def _equal_width(p: NDArrayFloat, right: NDArrayBool, num_bins: int) -> tuple[ReliabilityBin, ...]:
    # Bin k holds probabilities in (k / n, (k + 1) / n]; 0 belongs to the first.
    at = np.clip(np.ceil(p * num_bins).astype(np.int64) - 1, 0, num_bins - 1)
    return _bins(p, right, at, num_bins)


def _equal_mass(p: NDArrayFloat, right: NDArrayBool, num_bins: int) -> tuple[ReliabilityBin, ...]:
    """Bins of equally many cells; equal probabilities stay in one bin."""
    rank = np.searchsorted(np.sort(p), p, side="left")
    return _bins(p, right, rank * num_bins // len(p), num_bins)


def _bins(
    p: NDArrayFloat, right: NDArrayBool, at: NDArrayInt, num_bins: int
) -> tuple[ReliabilityBin, ...]:
    count = np.bincount(at, minlength=num_bins)
    confidence = np.bincount(at, weights=p, minlength=num_bins)
    accuracy = np.bincount(at, weights=right, minlength=num_bins)
    return tuple(
        ReliabilityBin(
            confidence=float(confidence[k] / count[k]),
            accuracy=float(accuracy[k] / count[k]),
            count=int(count[k]),
        )
        for k in np.flatnonzero(count)
    )


def _ece(bins: tuple[ReliabilityBin, ...]) -> float:
    total = sum(b.count for b in bins)
    return sum(b.count * abs(b.confidence - b.accuracy) for b in bins) / total
