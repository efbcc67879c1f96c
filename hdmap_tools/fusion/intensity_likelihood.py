"""What each class of the map looks like in lidar intensity: P(intensity | class).

The paper adds a constant to lane marks above a threshold and asks for "a more
sophisticated function" (Paz et al. 2020, section III-D). Here it is a histogram for each class,
over the **mean** intensity of a cell: the points in a cell lie on one surface and
repeat one another, so a cell is one observation however many points it holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hdmap_tools.errors import ConfigError, LabelError, ShapeError, brief_problems
from hdmap_tools.types import NDArrayFloat

NUM_BINS: Final = 32

_SMOOTHING_BINS: Final = 1.0
"""Standard deviation of the kernel that smooths a histogram, bins."""

NEUTRAL_CELLS: Final = 25.0
"""Cells' worth of the histogram of all classes that is added to each: a class that was hardly seen says nothing."""

UNRELATED: Final = 0.01
"""Share of cells whose intensity has nothing to do with their class: wet patches, leaves, wrong labels."""


def default_bin_edges(num_bins: int = NUM_BINS) -> NDArrayFloat:
    """(num_bins + 1,) edges from 0 to 256, evenly spaced in the square root.

    Most sensors put asphalt into the lowest tenth of their range, where even steps would
    leave a handful of bins; and the spread of an intensity grows with it.
    """
    return np.asarray(256.0 * np.linspace(0.0, 1.0, num_bins + 1) ** 2)


@dataclass(frozen=True, eq=False)
class IntensityLikelihood:
    """Log-probability of a cell's mean intensity under each class.

    Attributes:
        classes: Names.
        bin_edges: (B + 1,) increasing, intensity 0..256.
        log_probability: (class, B) natural logarithm of P(bin | class); finite.
        log_neutral: (B,) the same over all classes: what a class of which nothing is
            known is taken to look like.
        num_cells: (class,) cells behind each row.
        source: What it was learned from.
    """

    classes: tuple[str, ...]
    bin_edges: NDArrayFloat
    log_probability: NDArrayFloat
    log_neutral: NDArrayFloat
    num_cells: NDArrayFloat
    source: str = ""

    def __post_init__(self) -> None:
        bins = len(self.bin_edges) - 1
        shapes = (self.log_probability.shape, self.log_neutral.shape, self.num_cells.shape)
        if shapes != ((len(self.classes), bins), (bins,), (len(self.classes),)) or bins < 1:
            raise ShapeError(
                f"An intensity likelihood of {len(self.classes)} classes and {bins} bins has arrays of "
                f"{', '.join(map(str, shapes))}."
            )
        if not (np.isfinite(self.bin_edges).all() and (np.diff(self.bin_edges) > 0).all()):
            raise ShapeError(
                "The bin edges of an intensity likelihood must be finite and increase."
            )
        rows = np.vstack([self.log_probability, self.log_neutral])
        if not np.isfinite(rows).all() or not np.allclose(np.exp(rows).sum(axis=1), 1.0, atol=1e-6):
            raise ShapeError("Each row of an intensity likelihood must be positive and sum to 1.")

    @classmethod
    def estimate(
        cls,
        mean_intensity: NDArrayFloat,
        weights: NDArrayFloat,
        classes: tuple[str, ...],
        *,
        source: str = "",
        bin_edges: NDArrayFloat | None = None,
        neutral_cells: float = NEUTRAL_CELLS,
        unrelated: float = UNRELATED,
    ) -> IntensityLikelihood:
        """Learn it from cells whose classes are known, wholly or in part.

        Args:
            mean_intensity: Mean intensity 0..255 of each cell, any shape; NaN is left out.
            weights: (class, *shape) how much of a cell is each class: shares of its
                area, or posterior probabilities; NaN is left out.
            classes: Their names.
            source: What this was learned from, kept with it.
            bin_edges: Other bins than `default_bin_edges`.
            neutral_cells: Cells' worth of the histogram of all classes added to each.
            unrelated: Share of cells whose intensity has nothing to do with their class.

        Raises:
            ShapeError: If the arrays do not fit, or no cell has an intensity and a class.
        """
        from scipy.ndimage import gaussian_filter1d

        edges = default_bin_edges() if bin_edges is None else np.asarray(bin_edges, np.float64)
        values = np.ravel(mean_intensity)
        share = np.reshape(weights, (len(weights), -1))
        if share.shape != (len(classes), values.size):
            raise ShapeError(
                f"Weights must be ({len(classes)}, *{np.shape(mean_intensity)}), found {np.shape(weights)}."
            )
        usable = np.isfinite(values) & np.isfinite(share).all(axis=0)
        values, share = values[usable], share[:, usable]
        if not share.sum() > 0:
            raise ShapeError(
                "No cell has both a lidar intensity and a class, so what classes look like cannot be "
                "learned. Turn observation.intensity off, or give a likelihood that was learned elsewhere."
            )
        bins = _bins_of(values, edges)
        number = len(edges) - 1
        histogram = np.array([np.bincount(bins, weights=row, minlength=number) for row in share])
        smooth = gaussian_filter1d(histogram, _SMOOTHING_BINS, axis=1, mode="nearest")
        neutral = smooth.sum(axis=0) + 1.0
        neutral /= neutral.sum()
        rows = smooth + neutral_cells * neutral
        rows /= rows.sum(axis=1, keepdims=True)
        rows = (1.0 - unrelated) * rows + unrelated * neutral
        return cls(
            tuple(classes), edges, np.log(rows), np.log(neutral), histogram.sum(axis=1), source
        )

    def log_likelihood(self, mean_intensity: NDArrayFloat) -> NDArrayFloat:
        """(class, *shape) log P(intensity | class); 0 for every class where the intensity is NaN.

        Args:
            mean_intensity: Mean intensity 0..255 of each cell, any shape.
        """
        known = np.isfinite(mean_intensity)
        bins = _bins_of(np.where(known, mean_intensity, 0.0), self.bin_edges)
        return np.asarray(self.log_probability[:, bins] * known)

    def for_classes(self, names: tuple[str, ...]) -> IntensityLikelihood:
        """The same with rows for these classes; those it does not know look like the average.

        Raises:
            LabelError: If it knows none of them.
        """
        if not set(names) & set(self.classes):
            raise LabelError(
                f"The intensity likelihood ({self.source or 'no source'}) is about "
                f"{', '.join(self.classes)}; the map has {', '.join(names)}."
            )
        at = [self.classes.index(n) if n in self.classes else None for n in names]
        rows = [self.log_neutral if k is None else self.log_probability[k] for k in at]
        cells = [0.0 if k is None else float(self.num_cells[k]) for k in at]
        return IntensityLikelihood(
            names, self.bin_edges, np.array(rows), self.log_neutral, np.array(cells), self.source
        )

    def to_json(self) -> str:
        """The document that `from_json` reads back."""
        document = IntensityDocument(
            classes=self.classes,
            source=self.source,
            bin_edges=tuple(self.bin_edges.tolist()),
            num_cells=tuple(round(n, 1) for n in self.num_cells.tolist()),
            probability=tuple(_shown(row) for row in self.log_probability),
            neutral=_shown(self.log_neutral),
        )
        return document.model_dump_json(indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str, what: str = "The document") -> IntensityLikelihood:
        """Read what `to_json` wrote.

        Raises:
            ConfigError: If it is not such a document.
        """
        try:
            document = IntensityDocument.model_validate_json(text)
        except ValidationError as error:
            raise ConfigError(
                f"{what} is not an intensity likelihood: {brief_problems(error)}."
            ) from error
        try:
            rows = np.array(document.probability, dtype=np.float64)
            return cls(
                document.classes,
                np.array(document.bin_edges),
                np.log(rows / rows.sum(axis=1, keepdims=True)),
                np.log(np.array(document.neutral) / np.sum(document.neutral)),
                np.array(document.num_cells),
                document.source,
            )
        except ValueError as error:  # rows of different lengths, and what __post_init__ refuses
            raise ConfigError(f"{what} is not an intensity likelihood: {error}") from error

    def save(self, path: Path, *, overwrite: bool = False) -> None:
        """Write the document, whole or not at all.

        Raises:
            OutputExistsError: If the file exists and overwrite is False.
        """
        from hdmap_tools.formats.atomic import atomic_output

        with atomic_output(path, overwrite) as temporary:
            temporary.write_text(self.to_json(), encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> IntensityLikelihood:
        """Read a document from a file.

        Raises:
            ConfigError: If it is missing or not such a document.
        """
        try:
            return cls.from_json(path.read_text(encoding="utf-8"), str(path))
        except (UnicodeDecodeError, OSError) as error:
            raise ConfigError(
                f"{path} is not an intensity likelihood: {error}; `hdmap reliability` writes one beside its "
                "figures."
            ) from error


_Positive = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]


class IntensityDocument(BaseModel):
    """An intensity likelihood on disk.

    Attributes:
        classes: Names of the rows.
        source: What it was learned from.
        bin_edges: Intensities 0..256 between which a bin lies; one more than bins.
        num_cells: Cells behind each row.
        probability: P(bin | class); a row a class.
        neutral: P(bin) over all classes, for a class that is not among them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    classes: Annotated[tuple[str, ...], Field(min_length=1)]
    source: str = ""
    bin_edges: Annotated[tuple[float, ...], Field(min_length=2)]
    num_cells: tuple[Annotated[float, Field(ge=0)], ...]
    probability: tuple[tuple[_Positive, ...], ...]
    neutral: tuple[_Positive, ...]


def _shown(log_probability: NDArrayFloat) -> tuple[float, ...]:
    """Probabilities of 9 digits: more are noise, and reading and writing would change the last ones."""
    return tuple(float(f"{p:.9g}") for p in np.exp(log_probability))


def _bins_of(values: NDArrayFloat, edges: NDArrayFloat) -> NDArrayFloat:
    """Bin of each value; values beyond the edges belong to the outermost bins."""
    return np.asarray(np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2))
