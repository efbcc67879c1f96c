"""The temperature that makes a map's probabilities mean what they say.

Frames that see one place make the same mistakes, so adding their evidence as if they
were independent claims too much. Dividing it by one number, fitted where the truth is known
and tried where it was not used, repairs most of that.
Source: Guo, Pleiss, Sun, Weinberger, On Calibration of Modern Neural Networks, 2017.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.fusion.observation_model import ObservationModel
from hdmap_tools.fusion.read_window import HasCounts, blocks_with_evidence, read_counts
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayFloat, NDArrayInt

BLOCK_M: Final = 20.0
"""Side of the squares that are fitted on or tried on: neighbouring cells share their mistakes."""

_LOWEST: Final = 0.02
_HIGHEST: Final = 1000.0
_IMPOSSIBLE: Final = float(np.log(1e-12))
"""Log-probability put down for a true class that the model rules out at any temperature."""


@dataclass(frozen=True)
class TemperatureFit:
    """A fitted temperature.

    Attributes:
        temperature: Divides the evidence.
        nll_before: Mean negative log-likelihood of the true classes at temperature 1, nats.
        nll_after: The same at the fitted temperature.
        num_cells: Cells it was fitted on.
    """

    temperature: float
    nll_before: float
    nll_after: float
    num_cells: int


@dataclass(frozen=True, eq=False)
class EvidenceCells:
    """Cells of a map as the observation model sees them.

    Attributes:
        evidence: (class, N) what the votes say, at the model's temperature.
        offset: (class, N) or (class, 1) prior and intensity.
        cells: (N, 2) row and column in the grid they were read over.
    """

    evidence: NDArrayFloat
    offset: NDArrayFloat
    cells: NDArrayInt

    def posterior(self, temperature: float = 1.0) -> NDArrayFloat:
        """(class, N) probabilities with the evidence divided by a (further) temperature."""
        return softmax(self.offset + self.evidence / temperature)

    def __getitem__(self, chosen: NDArrayAny) -> EvidenceCells:
        """Those of the cells."""
        offset = self.offset if self.offset.shape[1] == 1 else self.offset[:, chosen]
        return EvidenceCells(self.evidence[:, chosen], offset, self.cells[chosen])


def read_evidence(
    source: HasCounts,
    grid: BevGrid,
    model: ObservationModel,
    mask: NDArrayBool,
    fill_radius_cells: int = 0,
) -> EvidenceCells:
    """Evidence of the known cells of a mask, read tile by tile.

    Args:
        source: The map.
        grid: Cells of the map.
        model: How counts are read.
        mask: (y, x) bool over the grid.
        fill_radius_cells: As in `read_window`.
    """
    evidence, offset, cells = [], [], []
    for block in blocks_with_evidence(source.tile_indices(), grid, fill_radius_cells):
        y, x = block.y_min - grid.y_min, block.x_min - grid.x_min
        wanted = mask[y : y + block.shape[0], x : x + block.shape[1]]
        if not wanted.any():
            continue
        read = read_counts(source, block, fill_radius_cells)
        rows, cols = np.nonzero(wanted & (read.counts > 0).any(axis=(0, 1)))
        evidence.append(model.evidence(read.counts[:, :, rows, cols][..., None])[..., 0])
        offset.append(model.offset(read.mean_intensity[rows, cols][:, None])[..., 0])
        cells.append(np.column_stack([rows + y, cols + x]))
    if not cells:
        empty = np.zeros((len(model.classes), 0))
        return EvidenceCells(empty, model.log_prior[:, None], np.zeros((0, 2), dtype=np.int64))
    has_own = model.intensity is not None
    return EvidenceCells(
        np.concatenate(evidence, axis=1),
        np.concatenate(offset, axis=1) if has_own else model.log_prior[:, None],
        np.concatenate(cells),
    )


def fit_temperature(
    evidence: NDArrayFloat,
    truth: NDArrayInt,
    offset: NDArrayFloat | float = 0.0,
    *,
    members: NDArrayBool | None = None,
) -> TemperatureFit:
    """The temperature under which the true classes are most likely.

    Args:
        evidence: (class, N) log-likelihood of each class, at temperature 1.
        truth: (N,) index of the true class, or of the true group.
        offset: (class, N) or (class, 1) what the temperature does not divide: the logarithm of
            the prior, and of the intensity.
        members: (group, class) bool, which classes make up each group of the truth, where
            the truth does not tell classes apart; None: each class is a group.

    Raises:
        ShapeError: If the arrays do not fit, or there is no cell.
    """
    from scipy.optimize import minimize_scalar

    evidence = np.asarray(evidence, dtype=np.float64)
    truth = np.asarray(truth)
    groups = len(evidence) if members is None else len(members)
    if evidence.ndim != 2 or truth.shape != evidence.shape[1:] or not len(truth):
        raise ShapeError(
            f"A temperature is fitted on evidence (class, N) and truth (N,) of at least one cell, found "
            f"{evidence.shape} and {truth.shape}."
        )
    if truth.min() < 0 or truth.max() >= groups:
        raise ShapeError(f"Truth must be 0..{groups - 1}, found {truth.min()}..{truth.max()}.")

    def mean_nll(log_temperature: float) -> float:
        log_posterior = log_softmax(offset + evidence / np.exp(log_temperature))
        return float(-_log_of_truth(log_posterior, truth, members).mean())

    bounds = (float(np.log(_LOWEST)), float(np.log(_HIGHEST)))
    # The best of a coarse row first: with unions of classes there may be two valleys.
    coarse = np.linspace(*bounds, 25)
    values = [mean_nll(t) for t in coarse]
    best = int(np.argmin(values))
    around = (float(coarse[max(best - 1, 0)]), float(coarse[min(best + 1, len(coarse) - 1)]))
    found = minimize_scalar(mean_nll, bounds=around, method="bounded", options={"xatol": 1e-4})
    log_temperature = float(found.x) if found.fun <= values[best] else float(coarse[best])
    return TemperatureFit(
        temperature=float(np.exp(log_temperature)),
        nll_before=mean_nll(0.0),
        nll_after=mean_nll(log_temperature),
        num_cells=len(truth),
    )


def checkerboard(grid: BevGrid, block_m: float = BLOCK_M) -> NDArrayBool:
    """(y, x) bool: the white squares of a checkerboard, which is anchored to the city frame."""
    x = np.floor(grid.x_centres_m / block_m).astype(np.int64)
    y = np.floor(grid.y_centres_m / block_m).astype(np.int64)
    return np.asarray((x[None, :] + y[:, None]) % 2 == 0)


def log_softmax(logits: NDArrayFloat) -> NDArrayFloat:
    """(class, ...) logarithm of the probabilities; minus infinity stays."""
    shifted = logits - logits.max(axis=0)
    with np.errstate(divide="ignore"):
        return np.asarray(shifted - np.log(np.exp(shifted).sum(axis=0)))


def softmax(logits: NDArrayFloat) -> NDArrayFloat:
    """(class, ...) probabilities."""
    return np.exp(log_softmax(logits))


def _log_of_truth(
    log_posterior: NDArrayFloat, truth: NDArrayInt, members: NDArrayBool | None
) -> NDArrayFloat:
    """(N,) log-probability of the true class or group."""
    if members is None:
        log_true = log_posterior[truth, np.arange(len(truth))]
    else:
        allowed = np.where(np.asarray(members, dtype=bool)[truth].T, log_posterior, -np.inf)
        highest = np.maximum(allowed.max(axis=0), -1e300)
        with np.errstate(divide="ignore"):
            log_true = highest + np.log(np.exp(allowed - highest).sum(axis=0))
    return np.where(np.isneginf(log_true), _IMPOSSIBLE, log_true)
