"""What an evaluation found: evaluation.json, a table for people, and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict

from hdmap_tools.compare.paper import EVALUATED, PaperScores, paper_table, pooled_scores
from hdmap_tools.compare.reliability import ReliabilityCurve
from hdmap_tools.errors import ConfigError

SIMULATED: str = "SIMULATED drives with exact truth; the paper's figures are from a recorded drive on a private campus"


class MethodScores(BaseModel):
    """One method on one drive.

    Attributes:
        filled, unfilled: The paper's measures with and without hole filling; a cell is lane mark
            when at least 35 % of it is paint.
        any_paint: With hole filling, by the reference's rule: any paint at all.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    filled: PaperScores
    unfilled: PaperScores
    any_paint: PaperScores


class DriveEvaluation(BaseModel):
    """All methods on one simulated drive.

    Attributes:
        world: Name of its map.
        drive: ``<layout>:<name>``.
        calibration: Drives on which confusion, intensity and temperature were measured.
        segmenter: What labelled the images.
        length_m: Driven.
        num_images: Fused.
        resolution_m: Cell size.
        methods: By name, in the order of the table.
        by_range: By method of association and band ahead, over the cells it knows; with
            the share of the road there that it knows.
        by_terrain: By method of association and part of the terrain.
        temperature: Fitted on the calibration drive.
        decision: Weights of classes with which ``ours`` decides, fitted there.
        priors: Share of each class in what the calibration drive saw.
        reliability_before, reliability_after: Of our map, at temperature 1 and at that one.
        recall: Share of the true pixels of the calibration drives that the segmenter labels
            so, by map class.
        seconds: Wall time by step.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    data: str = SIMULATED
    world: str
    drive: str
    calibration: tuple[str, ...]
    segmenter: str
    length_m: float
    num_images: int
    resolution_m: float
    methods: dict[str, MethodScores]
    by_range: dict[str, dict[str, PaperScores]]
    by_terrain: dict[str, dict[str, PaperScores]]
    temperature: float
    decision: dict[str, float]
    priors: dict[str, float]
    reliability_before: ReliabilityCurve
    reliability_after: ReliabilityCurve
    recall: dict[str, float]
    seconds: dict[str, float]

    def to_json(self) -> str:
        """The document, indented, with a line break at its end."""
        return self.model_dump_json(indent=2) + "\n"

    def to_text(self) -> str:
        """The tables, for people."""
        head = (
            f"{self.drive}: {self.length_m:.0f} m, {self.num_images} images, {self.resolution_m} m cells, "
            f"labels by {self.segmenter}"
        )
        parts = [head, f"{self.data}.", ""]
        parts += ["With hole filling, " + next(iter(self.methods.values())).filled.truth_rule + ":"]
        parts += [paper_table({n: m.filled for n, m in self.methods.items()}), ""]
        parts += ["Without hole filling:"]
        parts += [paper_table({n: m.unfilled for n, m in self.methods.items()}), ""]
        parts += [
            "With hole filling, " + next(iter(self.methods.values())).any_paint.truth_rule + ":"
        ]
        parts += [paper_table({n: m.any_paint for n, m in self.methods.items()}), ""]
        parts += ["By distance ahead of the ego origin, over the cells that each method knows:"]
        parts += [paper_table(_flat(self.by_range)), ""]
        parts += ["By terrain, over the cells that each method knows:"]
        parts += [paper_table(_flat(self.by_terrain)), ""]
        before, after = self.reliability_before, self.reliability_after
        parts += [
            f"Expected calibration error {before.ece:.3f} at temperature 1, {after.ece:.3f} at "
            f"{self.temperature:.2f} (fitted on another drive); of lane marks alone "
            f"{before.class_ece.get('lane_mark', float('nan')):.3f} and "
            f"{after.class_ece.get('lane_mark', float('nan')):.3f}."
        ]
        return "\n".join(parts) + "\n"

    def to_csv(self) -> str:
        """One line a method, rule and class."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(
            ["world", "table", "method", "class", "iou", "accuracy", "precision", "coverage"]
        )
        tables: dict[str, Mapping[str, PaperScores]] = {
            "filled": {n: m.filled for n, m in self.methods.items()},
            "unfilled": {n: m.unfilled for n, m in self.methods.items()},
            "any_paint": {n: m.any_paint for n, m in self.methods.items()},
            "by_range": _flat(self.by_range),
            "by_terrain": _flat(self.by_terrain),
        }
        for table, rows in tables.items():
            for name, scores in rows.items():
                for one in EVALUATED:
                    score = scores.classes[str(one)]
                    writer.writerow(
                        [
                            self.world,
                            table,
                            name,
                            str(one),
                            *(_figure(v) for v in (score.iou, score.accuracy, score.precision)),
                            _figure(scores.coverage),
                        ]
                    )
        return out.getvalue()


def pooled(evaluations: Sequence[DriveEvaluation]) -> dict[str, PaperScores]:
    """Scores of each method over the cells of several drives, with hole filling.

    Raises:
        ConfigError: If there is none.
    """
    if not evaluations:
        raise ConfigError("There is no evaluated drive to add up.")
    return {
        name: pooled_scores([one.methods[name].filled for one in evaluations])
        for name in evaluations[0].methods
    }


def _flat(nested: Mapping[str, Mapping[str, PaperScores]]) -> dict[str, PaperScores]:
    return {f"{outer}, {inner}": s for outer, row in nested.items() for inner, s in row.items()}


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
