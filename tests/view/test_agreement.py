from pathlib import Path

import cv2
import numpy as np
import pytest
from shapely.geometry import box

from hdmap_tools.compare.raster import RasterComparison, compare_raster
from hdmap_tools.compare.reference import Reference, ReferenceGroup
from hdmap_tools.errors import OutputExistsError, ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MapClass
from hdmap_tools.testing.scenes import window_from_shapes
from hdmap_tools.view.agreement import agreement_colors, agreement_picture
from hdmap_tools.view.palette import (
    AGREEMENT,
    BOTH_NEGATIVE,
    FALSE_ALARM,
    MISS,
    NOT_OBSERVED,
    OUTSIDE,
    TRUTH_NOT_OBSERVED,
)

GRID = BevGrid.from_bounds((0.0, 0.0, 8.0, 8.0), 1.0)


def scene() -> tuple:
    """The map: road in the west, x 0..4. The truth: road in the south, y 0..4."""
    window = window_from_shapes({"road": box(0, 0, 4, 8)}, GRID, unknown=box(6, 0, 8, 8))
    truth = np.zeros(GRID.shape, dtype=bool)
    truth[:4] = True
    covered = np.ones(GRID.shape, dtype=bool)
    covered[:, 0] = False
    group = ReferenceGroup("drivable", DRIVABLE_CLASSES, truth)
    reference = Reference(GRID, (group,), covered, "made.png", "by hand")
    return window, reference, compare_raster(window, reference)


def test_each_cell_has_the_colour_of_what_happened_there() -> None:
    window, reference, comparison = scene()
    colors = agreement_colors(window, reference, reference.groups[0], comparison.compared)
    south, north = colors[1], colors[6]
    assert [tuple(c) for c in south] == [
        OUTSIDE, AGREEMENT, AGREEMENT, AGREEMENT, MISS, MISS, TRUTH_NOT_OBSERVED, TRUTH_NOT_OBSERVED,
    ]  # fmt: skip
    assert [tuple(c) for c in north] == [
        OUTSIDE, FALSE_ALARM, FALSE_ALARM, FALSE_ALARM, BOTH_NEGATIVE, BOTH_NEGATIVE, NOT_OBSERVED,
        NOT_OBSERVED,
    ]  # fmt: skip


def test_colours_add_up_to_the_counts_and_north_is_up(tmp_path: Path) -> None:
    window, reference, comparison = scene()
    path = tmp_path / "agreement.png"
    agreement_picture(window, reference, comparison, path, bounds_m=GRID.bounds_m, panel_px=320)
    page = cv2.imread(str(path))[..., ::-1].astype(int)
    score = comparison.groups["drivable"]
    found = {}
    for color in (AGREEMENT, MISS, FALSE_ALARM):
        rows, cols = np.nonzero((page == color).all(axis=2))
        in_map = rows < page.shape[0] - 70  # above the legend
        found[color] = (rows[in_map].mean(), cols[in_map].mean(), in_map.sum() / 40**2)
    # The scale bar hides part of the south-west, so agreement is not counted exactly.
    assert found[MISS][2] == score.false_negatives == 8
    assert found[FALSE_ALARM][2] == score.false_positives == 12
    assert 0 < found[AGREEMENT][2] < score.true_positives == 12
    assert found[FALSE_ALARM][0] < found[AGREEMENT][0]  # the north-west is above the south-west
    assert found[AGREEMENT][1] < found[MISS][1]  # and the west left of the east


def test_the_picture_is_repeatable_and_not_overwritten_unasked(tmp_path: Path) -> None:
    window, reference, comparison = scene()
    path = tmp_path / "agreement.png"
    agreement_picture(window, reference, comparison, path)
    first = path.read_bytes()
    with pytest.raises(OutputExistsError):
        agreement_picture(window, reference, comparison, path)
    agreement_picture(window, reference, comparison, path, overwrite=True)
    assert path.read_bytes() == first


def test_a_comparison_from_a_file_needs_the_cells(tmp_path: Path) -> None:
    window, reference, comparison = scene()
    read = RasterComparison.from_json(comparison.to_json())
    path = tmp_path / "agreement.png"
    with pytest.raises(ShapeError, match="pass compared"):
        agreement_picture(window, reference, read, path)
    assert not path.exists()
    agreement_picture(window, reference, read, path, compared=comparison.compared)
    assert path.exists()


def test_many_groups_and_nothing_compared(tmp_path: Path) -> None:
    window = window_from_shapes({}, GRID, unknown=box(-1, -1, 9, 9))
    groups = tuple(ReferenceGroup(str(c), (c,), np.ones(GRID.shape, dtype=bool)) for c in MapClass)
    reference = Reference(GRID, groups, np.ones(GRID.shape, dtype=bool), "made.png", "by hand")
    path = tmp_path / "agreement.png"
    agreement_picture(window, reference, compare_raster(window, reference), path, panel_px=100)
    assert cv2.imread(str(path)) is not None
