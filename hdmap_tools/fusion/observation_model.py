"""How counts become probabilities; applied on reading, so a new model needs no rebuild.

    log P(S=c | z, I) = log prior(c) + (sum_l N[l] log M[c, l] + gamma N_high [c = lane mark]) / (w T)
                        + v log P(i | c) - log Z

with N the counts, w the counts that one frame's vote is worth and T the
temperature. Source: Paz et al. 2020, equations 3 to 8, written over counts. The
last term, v log P(i | c), goes beyond the paper and takes the place of gamma: i is
the cell's mean intensity, one observation a cell. T does not divide it: it tempers
what many frames repeat, and the mean is taken once.
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdmap_tools.config import ObservationConfig
from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.fusion.intensity_likelihood import IntensityLikelihood
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.labels.label_set import Label, LabelSet, MapClass
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayFloat

_LOG = logging.getLogger(__name__)

_MIN_PIXELS: Final = 1000
"""A label seen on fewer pixels of a band says nothing of how the network sees it there."""

OTHER: Final = "other"
"""The name of "none of the map's classes": buildings, vehicles, water, rails."""


@dataclass(frozen=True, eq=False)
class ObservationModel:
    """Log-likelihood of each kind of vote under each class.

    Attributes:
        classes: Names; `OTHER` last where it is part of the model.
        log_likelihood: (class, label, bin) natural logarithm of P(label | class),
            with the intensity term added in the high bin. Finite.
        log_prior: (class,) natural logarithm of the prior; minus infinity for a
            class that the labels cannot tell (no label, no measured row).
        votes_per_count: 1 / (w T).
        intensity: What the mean intensity of a cell says, or None; its classes are
            this model's.
        intensity_weight: v, the weight of that.
    """

    classes: tuple[str, ...]
    log_likelihood: NDArrayFloat
    log_prior: NDArrayFloat
    votes_per_count: float
    intensity: IntensityLikelihood | None = None
    intensity_weight: float = 1.0

    def posterior(
        self, counts: NDArrayAny, mean_intensity: NDArrayFloat | None = None
    ) -> NDArrayFloat:
        """Class probabilities from counts.

        Args:
            counts: (label, bin, y, x) of any real dtype.
            mean_intensity: (y, x) mean intensity 0..255 of each cell, NaN where none;
                only a model with an intensity likelihood looks at it.

        Returns:
            (class, y, x) float64; sums to 1 over class, NaN where all counts are 0.
        """
        log_posterior = self.offset(mean_intensity) + self.evidence(counts)
        log_posterior -= log_posterior.max(axis=0)
        posterior = np.exp(log_posterior)
        posterior /= posterior.sum(axis=0)
        posterior[:, ~(counts > 0).any(axis=(0, 1))] = np.nan
        return np.asarray(posterior)

    def evidence(self, counts: NDArrayAny) -> NDArrayFloat:
        """(class, y, x) what the votes say: log-likelihood up to a constant, divided by T.

        Args:
            counts: (label, bin, y, x) of any real dtype.
        """
        labels, bins, rows, cols = counts.shape
        summed = self.log_likelihood.reshape(len(self.classes), -1) @ counts.reshape(
            labels * bins, rows * cols
        ).astype(np.float64)
        return np.asarray(
            (summed * self.votes_per_count).reshape(len(self.classes), rows, cols),
            dtype=np.float64,
        )

    def offset(self, mean_intensity: NDArrayFloat | None) -> NDArrayFloat:
        """(class, y, x) or (class, 1, 1) what is known beside the votes: prior and intensity.

        Args:
            mean_intensity: As for `posterior`.
        """
        log_prior = self.log_prior[:, None, None]
        if self.intensity is None or mean_intensity is None:
            return log_prior
        seen = self.intensity.log_likelihood(mean_intensity)
        return np.asarray(log_prior + self.intensity_weight * seen)

    def with_intensity(self, likelihood: IntensityLikelihood, weight: float) -> ObservationModel:
        """The same model with a learned intensity term.

        Raises:
            LabelError: If the likelihood knows none of the model's classes.
        """
        return replace(
            self, intensity=likelihood.for_classes(self.classes), intensity_weight=weight
        )


def observation_model(
    config: ObservationConfig,
    meta: MapMeta,
    classes: tuple[MapClass, ...],
    confusion: ConfusionMatrix | None,
) -> ObservationModel:
    """Make the model that a configuration asks for, for a map's label set.

    A learned intensity term is in it only where its file is given; what is learned
    from a map itself needs that map (`hdmap_tools.fusion.learn_intensity`).

    Raises:
        ConfigError: If a confusion matrix is asked for and there is none, or the
            priors are not probabilities.
        LabelError: If the confusion matrix is for another label set.
    """
    names = (*(str(c) for c in classes), *((OTHER,) if config.other else ()))
    kind = config.model
    if kind == "auto":
        kind = "vanilla" if confusion is None else "confusion"
        if confusion is None:
            _LOG.warning(
                "No confusion matrix is known for the labels of %s (%s): each label is believed alike. "
                "Measure one with `hdmap confusion` and give it with --confusion.",
                meta.model,
                meta.label_set.name,
            )
    if kind == "vanilla":
        likelihood, can_tell = vanilla_likelihood(meta.label_set, names, config.vanilla_lambda)
        by_band = [likelihood] * (meta.num_bins // 2)
    else:
        if confusion is None:
            raise ConfigError(
                f"Observation model 'confusion' needs a confusion matrix for label set "
                f"{meta.label_set.name!r} of {meta.model!r}, and none is known. Measure one with `hdmap "
                "confusion` and give it with --confusion, or use observation.model: vanilla."
            )
        if confusion.predicted_set.names != meta.label_set.names:
            raise LabelError(
                f"The confusion matrix predicts {confusion.predicted_set.name!r} "
                f"({', '.join(confusion.predicted_set.names)}), but the map counted "
                f"{meta.label_set.name!r} ({', '.join(meta.label_set.names)})."
            )
        _, can_tell = confusion_likelihood(confusion, names, config.smoothing)
        by_band = [
            confusion_likelihood(of_band, names, config.smoothing)[0]
            for of_band in _matrices_of_bands(confusion, meta.range_edges_m)
        ]
    untold = [
        name for name, told in zip(names, can_tell, strict=True) if not told and name != OTHER
    ]
    if untold:
        _LOG.info(
            "The labels of %s cannot tell %s; the map gives them probability 0.",
            meta.label_set.name,
            " or ".join(untold),
        )
    # Two bins of intensity a band, see `MapMeta.num_bins`.
    log_likelihood = np.repeat(np.log(np.stack(by_band, axis=2)), 2, axis=2)
    if config.intensity == "gamma" and MapClass.LANE_MARK in names:
        log_likelihood[names.index(MapClass.LANE_MARK), :, 1::2] += config.gamma
    model = ObservationModel(
        names,
        log_likelihood,
        _log_prior(config, names, can_tell),
        1.0 / (meta.quanta_per_vote * config.temperature),
    )
    if config.intensity == "learned" and config.intensity_likelihood is not None:
        likelihood_of_intensity = IntensityLikelihood.load(config.intensity_likelihood)
        model = model.with_intensity(likelihood_of_intensity, config.intensity_weight)
    return model


def _matrices_of_bands(
    confusion: ConfusionMatrix, edges_m: tuple[float, ...]
) -> list[ConfusionMatrix]:
    """The matrix of each band of a map, nearest first; the whole one where range was not measured.

    A band of the matrix belongs to the band of the map in which it begins (with a
    millimetre to spare). A label that was hardly seen in a band is read with its whole row.
    """
    found = []
    for low, high in itertools.pairwise([0.0, *edges_m, np.inf]):
        counts = np.zeros_like(confusion.counts)
        for band in confusion.bands:
            if low <= band.min_m + 1e-3 < high:
                counts = counts + band.counts
        lacking = (counts.sum(axis=1) < _MIN_PIXELS) & (confusion.counts.sum(axis=1) > 0)
        counts = np.where(lacking[:, None], confusion.counts, counts)
        found.append(ConfusionMatrix(confusion.true_set, confusion.predicted_set, counts))
    return found


def vanilla_likelihood(
    label_set: LabelSet, names: tuple[str, ...], lam: float
) -> tuple[NDArrayFloat, list[bool]]:
    """M = mu (I + lambda 1), rectangular: each label stands for its class, or for `OTHER`.

    Returns:
        (class, label) rows that sum to 1 over the labels that are counted, and which
        classes have a label.
    """
    matrix = np.full((len(names), len(label_set)), lam)
    for label in label_set.labels:
        name = _class_among(label, names)
        if name in names and not label.moves:
            matrix[names.index(name), label.id] += 1.0
    can_tell = [bool((row > lam).any()) for row in matrix]
    return _normalized(matrix, label_set), can_tell


def confusion_likelihood(
    confusion: ConfusionMatrix, names: tuple[str, ...], smoothing: float
) -> tuple[NDArrayFloat, list[bool]]:
    """P(predicted | true class) from a measured matrix, smoothed so that no entry is 0.

    Rows of true labels that are one class of the map are added before they are
    normalized. Smoothing adds the share ``smoothing`` of a row, spread evenly.

    Returns:
        (class, label) rows that sum to 1 over the labels that are counted, and which
        classes have a measured row.
    """
    is_counted = _is_counted(confusion.predicted_set)
    rows = []
    for name in names:
        members = [
            label.id for label in confusion.true_set.labels if _class_among(label, names) == name
        ]
        rows.append(confusion.counts[members].sum(axis=0) * is_counted)
    counts = np.array(rows, dtype=np.float64)
    totals = counts.sum(axis=1, keepdims=True)
    can_tell = [bool(total > 0) for total in totals[:, 0]]
    even = is_counted / is_counted.sum()
    normalized = np.where(totals > 0, counts / np.maximum(totals, 1.0), even)
    smoothed = (1.0 - smoothing) * normalized + smoothing * even
    # Votes for moving objects never reach the counts; any finite value does.
    return np.where(is_counted, smoothed, 1.0), can_tell


def _class_among(label: Label, names: tuple[str, ...]) -> str:
    """The class of these that a label is; `OTHER` if it is none of them."""
    name = OTHER if label.map_class is None else str(label.map_class)
    return name if name in names else OTHER


def _is_counted(label_set: LabelSet) -> NDArrayBool:
    """(label,) bool: association leaves labels of moving objects out, so rows must not hold them."""
    return np.array([not label.moves for label in label_set.labels])


def _normalized(matrix: NDArrayFloat, label_set: LabelSet) -> NDArrayFloat:
    is_counted = _is_counted(label_set)
    sums = (matrix * is_counted).sum(axis=1, keepdims=True)
    return np.where(is_counted, matrix / sums, 1.0)


def _log_prior(
    config: ObservationConfig, names: tuple[str, ...], can_tell: list[bool]
) -> NDArrayFloat:
    """Natural logarithm of the prior: as given, `OTHER` from what is left, the rest shared."""
    prior = {str(c): p for c, p in config.priors.items() if str(c) in names}
    if sum(prior.values()) > 1.0 + 1e-9:
        raise ConfigError(
            f"observation.priors must be probabilities that sum to at most 1, found {prior}."
        )
    if OTHER in names:
        prior[OTHER] = min(config.other_prior, 1.0 - sum(prior.values()))
    told = [name for name, is_told in zip(names, can_tell, strict=True) if is_told]
    open_names = [name for name in told if name not in prior]
    rest = max(1.0 - sum(prior.values()), 0.0) / max(len(open_names), 1)
    values = np.array([prior.get(name, rest) if name in told else 0.0 for name in names])
    if values.sum() <= 0.0:
        raise ConfigError("No class is left with a prior above 0; check observation.priors.")
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(values / values.sum()))
