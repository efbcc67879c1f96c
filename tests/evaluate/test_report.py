"""Tables and documents of an evaluation, from a made-up one."""

import csv
import io

import numpy as np
import pytest

from hdmap_tools.compare.paper import ANY_PAINT, PAPER_TABLE, paper_scores
from hdmap_tools.compare.reliability import reliability
from hdmap_tools.evaluate.methods import MODE_METHODS, OUR_METHODS, PAPER_METHODS
from hdmap_tools.evaluate.report import SIMULATED, DriveEvaluation, MethodScores
from hdmap_tools.labels.label_set import MAP_CLASSES

NAMES = [str(c) for c in MAP_CLASSES]


def scores(wrong: int, paint_share: float = 0.35):
    """Of 12 cells, 4 of each drivable class, the first so many of which are said to be sidewalk."""
    shares = np.zeros((5, 1, 12))
    said = np.full((5, 1, 12), 0.05)
    for k in range(12):
        shares[k % 3, 0, k] = 1.0
        said[4 if k < wrong else k % 3, 0, k] = 0.8
    return paper_scores(said, NAMES, shares, NAMES, paint_share=paint_share)


@pytest.fixture(scope="module")
def evaluation() -> DriveEvaluation:
    methods = {
        method.name: MethodScores(
            filled=scores(k), unfilled=scores(k + 1), any_paint=scores(k, ANY_PAINT)
        )
        for k, method in enumerate((*PAPER_METHODS, *OUR_METHODS, *MODE_METHODS)[:10])
    }
    posterior = np.array([[0.9, 0.6, 0.2], [0.1, 0.4, 0.8]])
    curve = reliability(posterior, np.array([0, 1, 1]), names=("road", "lane_mark"))
    return DriveEvaluation(
        world="town",
        drive="av2:town",
        calibration=("av2:other",),
        segmenter="simulated",
        length_m=40.0,
        num_images=25,
        resolution_m=0.2,
        methods=methods,
        by_range={"dense": {"0 to 10 m": scores(0), "10 to 15 m": scores(3)}},
        by_terrain={"planar": {"sloped": scores(6)}},
        temperature=2.0,
        decision={"lane_mark": 1.4},
        priors={"road": 0.5},
        reliability_before=curve,
        reliability_after=curve,
        recall={"road": 0.9},
        seconds={"fuse": 1.0},
    )


def test_the_document_reads_back_and_says_that_it_is_simulated(evaluation):
    text = evaluation.to_json()
    assert DriveEvaluation.model_validate_json(text) == evaluation
    assert evaluation.data == SIMULATED
    assert "SIMULATED" in text


def test_the_text_has_the_papers_figures_below_its_methods_and_no_others(evaluation):
    lines = evaluation.to_text().splitlines()
    assert "SIMULATED" in lines[1]
    tables = 3
    assert sum("in the paper" in line for line in lines) == tables * len(PAPER_TABLE)
    for name, row in PAPER_TABLE.items():
        beside = [lines[k + 1] for k, line in enumerate(lines) if line.split("  ")[0] == name]
        assert len(beside) == tables
        for line in beside:
            assert line.split()[3:] == [f"{v:.3f}" for v in (*row.iou, row.miou, *row.accuracy)] + [
                "-"
            ]
    for name in evaluation.methods:
        assert sum(line.startswith(name + " ") for line in lines) >= tables
    assert any(line.startswith("dense, 10 to 15 m") for line in lines)
    assert any(line.startswith("planar, sloped") for line in lines)
    assert "2.00" in lines[-1]


def test_the_csv_has_a_line_for_each_table_method_and_class(evaluation):
    rows = list(csv.DictReader(io.StringIO(evaluation.to_csv())))
    assert list(rows[0]) == [
        *("world", "table", "method", "class", "iou", "accuracy", "precision", "coverage")
    ]
    per_table = len(evaluation.methods) * 3
    assert len(rows) == 3 * per_table + 2 * 3 + 3
    found = {(row["table"], row["method"], row["class"]): row for row in rows}
    assert len(found) == len(rows)
    one = found["filled", "Vanilla+I", "road"]  # one of four road cells is missed
    assert [one[k] for k in ("iou", "accuracy", "precision", "coverage")] == [
        *("0.7500", "0.7500", "1.0000", "1.0000")
    ]
    assert found["by_range", "dense, 0 to 10 m", "lane_mark"]["iou"] == "1.0000"


def test_a_figure_that_cannot_be_had_is_empty(evaluation):
    nothing = paper_scores(np.full((5, 1, 1), np.nan), NAMES, np.full((5, 1, 1), np.nan), NAMES)
    empty = evaluation.model_copy(update={"by_terrain": {"dense": {"bent": nothing}}})
    row = empty.to_csv().splitlines()[-1]
    assert row == 'town,by_terrain,"dense, bent",lane_mark,,,,'
    assert "dense, bent" in empty.to_text()
