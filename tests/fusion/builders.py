"""Small maps and frames for the fusion tests."""

import numpy as np

from hdmap_tools.association.observations import Observations
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.labels.label_set import load_label_set

ADAS = load_label_set("adas-0001")


def meta(**changes) -> MapMeta:
    fields = {
        "resolution_m": 0.2,
        "label_set": ADAS,
        "count_mode": "share",
        "intensity_threshold": 40,
        "model": "road-segmentation-adas-0001",
    }
    return MapMeta(**(fields | changes))


def random_frame(
    rng: np.random.Generator, num_points: int = 60, extent_m: float = 28.0
) -> Observations:
    """Points over several tiles, also left and below of the origin."""
    points = np.column_stack(
        [rng.uniform(-extent_m, extent_m, (num_points, 2)), rng.normal(0.0, 2.0, num_points)]
    )
    return Observations(
        points,
        rng.integers(0, len(ADAS), num_points).astype(np.uint8),
        rng.integers(0, 256, num_points).astype(np.uint8),
    )


def counts_of(frames, of_meta: MapMeta | None = None) -> CellCounts:
    """Frames are (key, Observations)."""
    counts = CellCounts(of_meta or meta())
    for key, frame in frames:
        counts.add(frame, key)
    return counts


def frames_of(seed: int, number: int) -> list[tuple[int, Observations]]:
    rng = np.random.default_rng(seed)
    return [(seed * 1000 + k, random_frame(rng)) for k in range(number)]
