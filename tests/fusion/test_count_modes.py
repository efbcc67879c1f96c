"""Which count mode keeps thin marks: exact labels of a turned street, twenty frames, 0.2 m cells."""

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import LineString, box

from hdmap_tools.association.observations import Observations
from hdmap_tools.config import ObservationConfig
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.observation_model import observation_model
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import MAP_CLASSES
from hdmap_tools.testing.scenes import coverage

from .builders import meta

GRID = BevGrid.from_bounds((5, -8, 35, 18), 0.2)


def turned(geometry):
    return affinity.rotate(geometry, 17.0, origin=(20, 0))


# Lines 12 to 25 cm wide, at no particular offset to the cells.
MARKS = shapely.union_all(
    [
        turned(LineString([(-5, y), (45, y)]).buffer(width / 2, cap_style="flat"))
        for y, width in [(0.03, 0.15), (3.56, 0.15), (7.2, 0.12), (-3.4, 0.25)]
    ]
)
ROAD = turned(box(-5, -5.03, 45, 9.07))


def mark_iou(mode: str, points_per_m2: float, noise_m: float) -> float:
    """Lane-mark IoU over cells; a cell is truly mark when at least 35 % of it is paint."""
    rng = np.random.default_rng(1)
    counts = CellCounts(meta(count_mode=mode))
    for frame in range(20):
        number = int(points_per_m2 * 30 * 26)
        points = np.column_stack(
            [rng.uniform(5, 35, number), rng.uniform(-8, 18, number), np.zeros(number)]
        )
        on_road = shapely.contains_xy(ROAD, points[:, 0], points[:, 1])
        on_mark = shapely.contains_xy(MARKS, points[:, 0], points[:, 1])
        labels = np.where(on_mark, 3, on_road.astype(int)).astype(np.uint8)
        points[:, :2] += rng.normal(0, noise_m, 2)
        counts.add(Observations(points, labels), frame)
    model = observation_model(ObservationConfig(model="vanilla"), counts.meta, MAP_CLASSES, None)
    posterior = read_window(counts, GRID, model).dataset["posterior"].values
    is_mark = np.nan_to_num(posterior).argmax(axis=0) == model.classes.index("lane_mark")
    truth = coverage(MARKS, GRID, 8) >= 0.35
    return float((is_mark & truth).sum() / (is_mark | truth).sum())


@pytest.mark.parametrize(("points_per_m2", "noise_m"), [(200.0, 0.0), (200.0, 0.03), (30.0, 0.03)])
def test_sharing_a_vote_keeps_marks_best(points_per_m2, noise_m):
    shared, majority, each = (
        mark_iou(mode, points_per_m2, noise_m) for mode in ("share", "majority", "frame")
    )
    assert shared > majority
    assert shared > each
    assert shared > 0.68


def test_a_vote_for_each_label_seen_loses_marks_in_dense_frames():
    # A cell at the edge of a mark always sees both labels: every frame is a tie.
    assert mark_iou("frame", 200.0, 0.0) < mark_iou("share", 200.0, 0.0) - 0.1
