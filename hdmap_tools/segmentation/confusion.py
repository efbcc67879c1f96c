"""Confusion matrices: how often a network says which label where the truth is another."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hdmap_tools.errors import ConfigError, LabelError, ShapeError, brief_problems
from hdmap_tools.labels.label_set import (
    LabelSet,
    MapClass,
    builtin_label_sets,
    load_label_set,
)
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayInt


@dataclass(frozen=True)
class Agreement:
    """How well predicted pixels cover true ones; NaN where there is nothing to divide by.

    Attributes:
        recall: Share of the true pixels that were predicted.
        precision: Share of the predicted pixels that are true.
        iou: Pixels that are both, of those that are either.
    """

    recall: float
    precision: float
    iou: float


@dataclass(frozen=True, eq=False)
class RangeBand:
    """Pixel counts of one band of distance.

    Attributes:
        min_m: Distance from the camera over level ground, metres, from here on;
        max_m: and below this. Infinite in the last band, which also holds all pixels
            at or above the horizon.
        counts: (T, P) int64, as in `ConfusionMatrix`.
    """

    min_m: float
    max_m: float
    counts: NDArrayInt

    @property
    def name(self) -> str:
        """In tables: ``10-20 m``, or ``40 m and beyond``."""
        if np.isinf(self.max_m):
            return f"{self.min_m:g} m and beyond"
        return f"{self.min_m:g}-{self.max_m:g} m"


@dataclass(frozen=True, eq=False)
class ConfusionMatrix:
    """Pixel counts by true and predicted label.

    Neighbouring pixels are not independent: the counts weigh labels against each
    other, they are no sample size.

    Attributes:
        true_set: Labels of the rows (the annotation).
        predicted_set: Labels of the columns (the network's).
        counts: (T, P) int64, rows true, columns predicted; read-only.
        source: What it was measured on, and how.
        bands: The same counts by distance, nearest first, where that was measured;
            they add up to the counts.
    """

    true_set: LabelSet
    predicted_set: LabelSet
    counts: NDArrayInt
    source: str = ""
    bands: tuple[RangeBand, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "counts", self._checked(self.counts))
        if not self.bands:
            return
        bands = tuple(RangeBand(b.min_m, b.max_m, self._checked(b.counts)) for b in self.bands)
        edges = [bands[0].min_m, *(band.max_m for band in bands)]
        touch = all(a.max_m == b.min_m for a, b in itertools.pairwise(bands))
        if not touch or edges[0] != 0 or not (np.diff(edges[:-1]) > 0).all() or edges[-1] != np.inf:
            raise LabelError(
                f"Range bands must run from 0 without gaps to infinity, found {[b.name for b in bands]}."
            )
        if not np.array_equal(np.sum([band.counts for band in bands], axis=0), self.counts):
            raise LabelError("The counts of the range bands do not add up to those of the whole.")
        object.__setattr__(self, "bands", bands)

    def _checked(self, given: NDArrayAny) -> NDArrayInt:
        counts = np.asarray(given)
        expected = (len(self.true_set), len(self.predicted_set))
        about = f"Confusion matrix {self.true_set.name!r} by {self.predicted_set.name!r}"
        if counts.shape != expected:
            raise LabelError(f"{about}: counts are {counts.shape}, expected {expected}.")
        # Up to 2**53 any sum over 255 labels still fits, and each count is a float exactly.
        fits = counts.dtype.kind in "iuf" and bool(
            (np.isfinite(counts) & (counts >= 0) & (counts <= 2**53)).all()
            and (counts == np.floor(counts)).all()
        )
        if not fits:
            raise LabelError(
                f"{about}: counts must be whole numbers of pixels from 0 to 2**53, without NaN; "
                f"found {counts.dtype} values that are not. Measure it anew."
            )
        whole = counts.astype(np.int64)
        whole.flags.writeable = False
        return whole

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ConfusionMatrix)
            and self.true_set == other.true_set
            and self.predicted_set == other.predicted_set
            and bool((self.counts == other.counts).all())
            and self.range_edges_m == other.range_edges_m
            and all(
                bool((mine.counts == theirs.counts).all())
                for mine, theirs in zip(self.bands, other.bands, strict=True)
            )
        )

    __hash__ = None  # type: ignore[assignment]

    @classmethod
    def measure(
        cls,
        true_image: NDArrayByte,
        predicted_image: NDArrayByte,
        true_set: LabelSet,
        predicted_set: LabelSet,
        *,
        band_image: NDArrayByte | None = None,
        range_edges_m: Sequence[float] = (),
    ) -> ConfusionMatrix:
        """Count the pixels of one image; those of id 255 on either side are left out.

        Args:
            true_image: (height, width) uint8 ids of true_set.
            predicted_image: (height, width) uint8 ids of predicted_set.
            true_set: The annotation's labels.
            predicted_set: The network's labels.
            band_image: (height, width) uint8 number of the band of distance that each
                pixel is in (`range_bands.band_image`); None: distance is not told apart.
            range_edges_m: Where those bands begin, from 0.

        Raises:
            ShapeError: If the images differ in size or are not (height, width) uint8.
            LabelError: If an id lies outside its set.
        """
        shapes = (true_image.shape, predicted_image.shape)
        dtypes = (true_image.dtype, predicted_image.dtype)
        are_bytes = all(dtype == np.uint8 for dtype in dtypes)
        are_bytes = all(dtype == np.uint8 for dtype in dtypes)
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or not are_bytes:
            raise ShapeError(
                f"True and predicted labels must be (height, width) uint8 of one size, found "
                f"{shapes[0]} {dtypes[0]} and {shapes[1]} {dtypes[1]}."
            )
        true_set.check(true_image, "The true label image")
        predicted_set.check(predicted_image, "The predicted label image")
        pairs = true_image.astype(np.int32) * 256 + predicted_image
        number = 1
        if band_image is not None:
            number = len(range_edges_m)
            if band_image.shape != shapes[0] or band_image.max(initial=0) >= number:
                raise ShapeError(
                    f"Range bands {band_image.shape} of {number} edges do not fit an image {shapes[0]}."
                )
            pairs += band_image.astype(np.int32) * (256 * 256)
        joint = np.bincount(pairs.ravel(), minlength=number * 256 * 256).reshape(number, 256, 256)
        # Row and column 255, to be ignored, lie beyond any label set.
        counts = joint[:, : len(true_set), : len(predicted_set)]
        bands = () if band_image is None else _bands(range_edges_m, counts)
        return cls(true_set, predicted_set, counts.sum(axis=0), bands=bands)

    def __add__(self, other: ConfusionMatrix) -> ConfusionMatrix:
        if self.true_set != other.true_set or self.predicted_set != other.predicted_set:
            raise LabelError(
                f"Confusion matrices of {self.true_set.name!r} by {self.predicted_set.name!r} and of "
                f"{other.true_set.name!r} by {other.predicted_set.name!r} cannot be added."
            )
        if self.range_edges_m != other.range_edges_m:
            raise LabelError(
                f"Confusion matrices of range bands {list(self.range_edges_m)} and "
                f"{list(other.range_edges_m)} m cannot be added; measure both with the same ones."
            )
        sources = dict.fromkeys(text for text in (self.source, other.source) if text)
        return ConfusionMatrix(
            self.true_set,
            self.predicted_set,
            self.counts + other.counts,
            " + ".join(sources),
            tuple(
                RangeBand(mine.min_m, mine.max_m, mine.counts + theirs.counts)
                for mine, theirs in zip(self.bands, other.bands, strict=True)
            ),
        )

    @property
    def range_edges_m(self) -> tuple[float, ...]:
        """Where the range bands begin, metres; empty where there are none."""
        return tuple(band.min_m for band in self.bands)

    def of_band(self, index: int) -> ConfusionMatrix:
        """The matrix of one range band alone."""
        band = self.bands[index]
        return ConfusionMatrix(
            self.true_set, self.predicted_set, band.counts, f"{self.source} ({band.name})".strip()
        )

    def label_agreement(self) -> dict[str, Agreement]:
        """Agreement of each label that both label sets have by the same name."""
        shared = [name for name in self.true_set.names if name in self.predicted_set.names]
        return {name: self.agreement([name], [name]) for name in shared}

    def agreement(self, true_names: Iterable[str], predicted_names: Iterable[str]) -> Agreement:
        """How well some predicted labels, taken together, cover some true ones.

        Raises:
            LabelError: If a label is not in its set.
        """
        rows = sorted({self.true_set.id_of(name) for name in true_names})
        columns = sorted({self.predicted_set.id_of(name) for name in predicted_names})
        both = int(self.counts[np.ix_(rows, columns)].sum())
        true, predicted = int(self.counts[rows].sum()), int(self.counts[:, columns].sum())
        return Agreement(
            recall=_ratio(both, true),
            precision=_ratio(both, predicted),
            iou=_ratio(both, true + predicted - both),
        )

    def class_agreement(self) -> dict[MapClass, Agreement]:
        """Agreement of each map class that both label sets know."""
        result = {}
        for map_class in MapClass:
            true = [label.name for label in self.true_set.labels if label.map_class == map_class]
            predicted = [
                label.name for label in self.predicted_set.labels if label.map_class == map_class
            ]
            if true and predicted:
                result[map_class] = self.agreement(true, predicted)
        return result

    def class_rows(self, classes: Sequence[MapClass]) -> NDArrayInt:
        """(C, P) counts by map class and predicted label: true labels of a class added up.

        A class that the annotation does not know, or never saw, has a row of
        zeros: nothing is known of how the network sees it. Whoever reads a map
        with it must take such a class as not distinguishable (each label equally
        likely, once smoothed), not as impossible.
        """
        rows = [
            self.counts[list(self.true_set.ids_of_class(map_class))].sum(axis=0)
            for map_class in classes
        ]
        return np.array(rows, dtype=np.int64).reshape(len(classes), len(self.predicted_set))

    def to_json(self) -> str:
        """The document that `from_json` reads back; one row of counts a line."""
        document = ConfusionDocument(
            true_set=_named_or_whole(self.true_set),
            predicted_set=_named_or_whole(self.predicted_set),
            true_labels=self.true_set.names,
            predicted_labels=self.predicted_set.names,
            source=self.source,
            counts=(),
        ).model_dump(mode="json")
        del document["counts"], document["bands"]
        head = json.dumps(document, indent=2, ensure_ascii=False)[:-2]
        text = f'{head},\n  "counts": [\n{_rows(self.counts, 4)}\n  ]'
        if self.bands:
            each = [
                f'    {{"min_m": {band.min_m:g}, "max_m": '
                f"{'null' if np.isinf(band.max_m) else format(band.max_m, 'g')}, "
                f'"counts": [\n{_rows(band.counts, 6)}\n    ]}}'
                for band in self.bands
            ]
            text += ',\n  "bands": [\n' + ",\n".join(each) + "\n  ]"
        return text + "\n}\n"

    @classmethod
    def from_json(cls, text: str, what: str = "The document") -> ConfusionMatrix:
        """Read what `to_json` wrote.

        Raises:
            ConfigError: If it is not such a document.
            LabelError: If its labels are not those of its label sets, or its
                counts do not fit them.
        """
        try:
            document = ConfusionDocument.model_validate(json.loads(text))
        except ValidationError as error:
            raise ConfigError(
                f"{what} is not a confusion matrix: {brief_problems(error)}."
            ) from error
        except RecursionError as error:
            raise ConfigError(
                f"{what} is not a confusion matrix: it is nested too deeply."
            ) from error
        except ValueError as error:  # no JSON, or a number of thousands of digits
            raise ConfigError(f"{what} is not a confusion matrix: {error}") from error
        sets = []
        for given, names, side in (
            (document.true_set, document.true_labels, "true"),
            (document.predicted_set, document.predicted_labels, "predicted"),
        ):
            label_set = load_label_set(given) if isinstance(given, str) else given
            if label_set.names != names:
                raise LabelError(
                    f"{what}: its {side} labels {', '.join(names)} are not those of label set "
                    f"{label_set.name!r} ({', '.join(label_set.names)}); measure it anew."
                )
            sets.append(label_set)
        if len({len(row) for row in document.counts}) > 1:
            raise LabelError(f"{what}: its rows of counts differ in length.")
        try:
            counts = np.array(document.counts, dtype=np.int64)
            bands = tuple(
                RangeBand(
                    one.min_m,
                    np.inf if one.max_m is None else one.max_m,
                    np.array(one.counts, dtype=np.int64),
                )
                for one in document.bands
            )
            return cls(sets[0], sets[1], counts, document.source, bands)
        except (LabelError, OverflowError, ValueError) as error:
            raise LabelError(f"{what}: {error}") from error

    @classmethod
    def load(cls, name_or_path: str | Path) -> ConfusionMatrix:
        """A shipped matrix by the name of its model's profile, or one from a JSON file.

        Raises:
            ConfigError: If there is neither; the message lists the shipped names.
            LabelError: If it does not fit its label sets.
        """
        shipped = _shipped()
        if str(name_or_path) in shipped:
            return cls.from_json(shipped[str(name_or_path)], f"Confusion matrix {name_or_path}")
        path = Path(name_or_path)
        if not path.is_file():
            raise ConfigError(
                f"{str(name_or_path)!r} is neither a confusion matrix "
                f"({', '.join(sorted(shipped)) or 'none ship'}) nor a JSON file."
            )
        try:
            return cls.from_json(path.read_text(encoding="utf-8"), str(path))
        except (UnicodeDecodeError, OSError) as error:
            raise ConfigError(f"{path} is not a confusion matrix: {error}") from error


class BandDocument(BaseModel):
    """The counts of one band of distance.

    Attributes:
        min_m: Distance from the camera over level ground, from here on;
        max_m: and below this; null in the last band, which holds all beyond, and all
            pixels at or above the horizon.
        counts: As those of the whole, which they are part of.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_m: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    max_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    counts: tuple[tuple[int, ...], ...]


class ConfusionDocument(BaseModel):
    """A confusion matrix on disk.

    Attributes:
        true_set: Name of a shipped label set, or a whole one; of the rows.
        predicted_set: The same, of the columns.
        true_labels: Names of the rows, to be read by people and checked on loading.
        predicted_labels: Names of the columns.
        source: What it was measured on, and how.
        counts: Pixels; a row a true label, a column a predicted one.
        bands: The same by distance, nearest first, where that was measured.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    true_set: str | LabelSet
    predicted_set: str | LabelSet
    true_labels: tuple[str, ...]
    predicted_labels: tuple[str, ...]
    source: str = ""
    counts: tuple[tuple[int, ...], ...]
    bands: tuple[BandDocument, ...] = ()


def find_confusion(label_set: LabelSet, model: str | None = None) -> ConfusionMatrix | None:
    """The shipped matrix of a model, by the name of its profile.

    Without a match by name, the one shipped matrix that predicts that label set:
    label images on disk do not say which network made them. The matrix assumed for
    the simulated network is known by that name only: it describes no other.

    Returns:
        The matrix, or None where none or several fit.
    """
    matrices = {name: ConfusionMatrix.load(name) for name in sorted(_shipped())}
    fitting = {name: m for name, m in matrices.items() if m.predicted_set == label_set}
    if model in fitting:
        return fitting[model]
    fitting.pop("simulated", None)
    return next(iter(fitting.values())) if len(fitting) == 1 else None


def _shipped() -> dict[str, str]:
    folder = resources.files("hdmap_tools.segmentation") / "confusions"
    return {
        entry.name.removesuffix(".json"): entry.read_text(encoding="utf-8")
        for entry in folder.iterdir()
        if entry.name.endswith(".json")
    }


def _named_or_whole(label_set: LabelSet) -> Any:
    is_shipped = builtin_label_sets().get(label_set.name) == label_set
    return label_set.name if is_shipped else label_set


def _bands(edges_m: Sequence[float], counts: NDArrayInt) -> tuple[RangeBand, ...]:
    ends = [*edges_m[1:], np.inf]
    return tuple(
        RangeBand(float(a), float(b), part)
        for a, b, part in zip(edges_m, ends, counts, strict=True)
    )


def _rows(counts: NDArrayInt, indent: int) -> str:
    return ",\n".join(f"{' ' * indent}{json.dumps(row)}" for row in counts.tolist())


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
