from collections import Counter

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from hdmap_tools.association.observations import Observations
from hdmap_tools.config import ObservationConfig
from hdmap_tools.fusion.cell_counts import TILE_CELLS, CellCounts
from hdmap_tools.fusion.observation_model import observation_model
from hdmap_tools.fusion.read_window import box_mean_at, read_counts, read_window
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import MAP_CLASSES

from .builders import meta

GRID = BevGrid(0.2, 0, 0, 6, 4)


def model(of_meta):
    return observation_model(ObservationConfig(model="vanilla"), of_meta, MAP_CLASSES, None)


def seen(cells, labels, z=0.5, intensity=50):
    """One point in the middle of each cell (ix, iy)."""
    xy = (np.array(cells) + 0.5) * 0.2
    return Observations(
        np.column_stack([xy, np.full(len(xy), z)]),
        np.array(labels, np.uint8),
        np.full(len(xy), intensity, np.uint8),
    )


def test_layers_of_a_known_cell():
    counts = CellCounts(meta())
    counts.add(seen([(4, 1)], [1], z=0.5, intensity=50), 0)
    counts.add(seen([(4, 1)], [1], z=0.7, intensity=60), 1)
    window = read_window(counts, GRID, model(counts.meta))
    assert window.grid.shape == (4, 6)
    assert np.argwhere(window.is_known).tolist() == [[1, 4]]
    assert window.layer("observations")[1, 4] == 2.0
    assert window.layer("height")[1, 4] == pytest.approx(0.6)
    assert window.layer("intensity")[1, 4] == pytest.approx(55.0)
    posterior = window.dataset["posterior"].values[:, 1, 4]
    assert posterior.sum() == pytest.approx(1.0, abs=1e-6)
    expected = -(posterior[posterior > 0] * np.log(posterior[posterior > 0])).sum()
    assert window.layer("entropy")[1, 4] == pytest.approx(expected, abs=1e-6)
    assert float(window.dataset["x"][4]) == pytest.approx(0.9)
    assert float(window.dataset["y"][1]) == pytest.approx(0.3)


def test_heights_count_from_the_reference():
    counts = CellCounts(meta(reference_height_m=5.0))
    counts.add(seen([(4, 1)], [1], z=6.5), 0)
    window = read_window(counts, GRID, model(counts.meta))
    assert window.layer("height")[1, 4] == pytest.approx(6.5)


def test_reading_in_tiles_equals_reading_in_one_piece():
    # Evidence around a corner of four tiles, and a tile that is only reached by filling.
    corner = TILE_CELLS
    cells = [(corner + dx, corner + dy) for dx, dy in [(-1, -1), (0, -1), (1, 1), (-3, 2)]]
    counts = CellCounts(meta())
    counts.add(seen([*cells, (2 * corner - 1, corner + 5)], [1, 3, 1, 0, 1]), 0)
    grid = BevGrid(0.2, corner - 40, corner - 40, 2 * corner + 10, corner + 40)
    for radius in (0, 1, 3):
        got = read_window(counts, grid, model(counts.meta), radius)
        layers = counts.window(grid.expand(radius)).layers
        whole = model(counts.meta).posterior(layers["counts"])
        if radius:
            filled = model(counts.meta).posterior(box_mean(layers["counts"], radius))
            whole = np.where(np.isnan(whole[0]), filled, whole)
            whole = whole[:, radius:-radius, radius:-radius]
        np.testing.assert_allclose(got.dataset["posterior"].values, whole, atol=1e-6)
        assert got.is_known.sum() == np.isfinite(whole[0]).sum() > 0


def test_unknown_stays_unknown_without_filling():
    counts = CellCounts(meta())
    counts.add(seen([(0, 0)], [1]), 0)
    window = read_window(counts, GRID, model(counts.meta), fill_radius_cells=0)
    assert window.is_known.sum() == 1
    assert np.isnan(window.layer("entropy")[2, 2])
    assert np.isnan(window.layer("height")[2, 2])


def test_filling_reaches_the_radius_and_claims_no_observations():
    counts = CellCounts(meta())
    counts.add(seen([(3, 2)], [1]), 0)
    window = read_window(counts, GRID, model(counts.meta), fill_radius_cells=1)
    assert sorted(map(tuple, np.argwhere(window.is_known))) == [
        (r, c) for r in (1, 2, 3) for c in (2, 3, 4)
    ]
    assert window.layer("observations").sum() == 1.0
    assert window.dataset["posterior"].values[0, 1, 2] == pytest.approx(
        window.dataset["posterior"].values[0, 2, 3]
    )


def test_filling_leaves_observed_cells_alone():
    counts = CellCounts(meta())
    counts.add(seen([(1, 1), (2, 1)], [1, 3]), 0)
    plain = read_window(counts, GRID, model(counts.meta), 0).dataset["posterior"].values
    filled = read_window(counts, GRID, model(counts.meta), 1).dataset["posterior"].values
    np.testing.assert_array_equal(plain[:, 1, 1:3], filled[:, 1, 1:3])


def test_filling_sees_beyond_the_window():
    counts = CellCounts(meta())
    counts.add(seen([(6, 1)], [1]), 0)
    window = read_window(counts, GRID, model(counts.meta), fill_radius_cells=1)
    assert window.is_known[:, 5].tolist() == [True, True, True, False]


def box_mean(counts, radius):
    """The plain form: mean counts of the observed cells in a box around each cell."""
    size = 2 * radius + 1
    observed = counts.any(axis=(0, 1)).astype(np.float64)
    share = uniform_filter(observed, size, mode="constant")
    channels = counts.reshape(-1, *counts.shape[2:]).astype(np.float64)
    sums = np.stack([uniform_filter(one, size, mode="constant") for one in channels])
    there = share > 0.5 / size**2
    return np.where(there, sums.reshape(counts.shape) / np.where(there, share, 1.0), 0.0)


def test_box_mean_is_the_mean_over_observed_cells_of_the_box():
    counts = np.zeros((1, 1, 5, 5))
    counts[0, 0, 1, 1], counts[0, 0, 1, 2] = 6.0, 2.0
    observed = counts[0, 0] > 0
    found = box_mean_at(counts, observed, 1, np.array([2, 1]), np.array([2, 3]))
    assert found[0, 0].tolist() == [4.0, 2.0]


@pytest.mark.parametrize("radius", [1, 2, 7])
def test_filling_some_cells_equals_filtering_all(radius):
    rng = np.random.default_rng(radius)
    counts = CellCounts(meta())
    cells = np.unique(rng.integers(0, 60, (300, 2)) * (4, 1), axis=0)
    # Huge counts beside small ones: running sums must not lose the small.
    for _ in range(4):
        some = cells[rng.random(len(cells)) < 0.6]
        counts.add(seen(some, rng.integers(0, 4, len(some)), intensity=rng.integers(0, 255)), 0)
    counts.tiles[(0, 0)].layers["counts"][:, :, 3] *= 2**26
    block = BevGrid(0.2, 0, 0, 256, 256)
    read = read_counts(counts, block, radius)
    layers = counts.window(block.expand(radius)).layers
    unknown = ~layers["counts"].any(axis=(0, 1))
    inner = (..., slice(radius, -radius), slice(radius, -radius))
    expected = np.where(unknown, box_mean(layers["counts"], radius), layers["counts"])[inner]
    np.testing.assert_allclose(read.counts, expected, rtol=1e-9, atol=1e-6)
    with np.errstate(divide="ignore", invalid="ignore"):
        intensity = layers["intensity_sum"] / layers["intensity_n"]
    known = np.isfinite(intensity)
    both = np.stack([known, np.where(known, intensity, 0.0)])[:, None]
    number, total = box_mean(both, radius)[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        filled = np.where(number > 0, total / number, np.nan)
    expected = np.where(unknown, filled, intensity)[inner]
    np.testing.assert_allclose(read.mean_intensity, expected, rtol=1e-9)
    assert np.isfinite(expected).sum() > known.sum() > 100


class CountingSource:
    """A map that says how often each tile was read."""

    def __init__(self, counts):
        self.meta, self._counts, self.read = counts.meta, counts, Counter()

    def tile_indices(self):
        return self._counts.tile_indices()

    def window(self, grid):
        first, last = grid.x_min // TILE_CELLS, (grid.x_max - 1) // TILE_CELLS
        self.read.update((x, grid.y_min // TILE_CELLS) for x in range(first, last + 1))
        return self._counts.window(grid)


def test_a_tile_is_read_once_though_its_neighbours_want_its_edge():
    counts = CellCounts(meta())
    places = [(x * TILE_CELLS, y * TILE_CELLS) for x in range(3) for y in range(2)]
    counts.add(seen(places, [1] * 6), 0)
    source = CountingSource(counts)
    read_window(source, counts.grid, model(counts.meta), 1)
    assert set(source.read.values()) == {1}
    assert len(source.read) == 6


def test_a_window_is_read_only():
    counts = CellCounts(meta())
    counts.add(seen([(0, 0)], [1]), 0)
    window = read_window(counts, GRID, model(counts.meta))
    with pytest.raises(ValueError, match="read-only"):
        window.dataset["posterior"].values[0, 0, 0] = 1.0
