"""What classes look like in intensity: learned from truth, and from a map that knows only labels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdmap_tools.association.observations import Observations
from hdmap_tools.config import Config, ObservationConfig
from hdmap_tools.errors import ConfigError, LabelError, OutputExistsError, ShapeError
from hdmap_tools.fusion.cell_counts import CellCounts
from hdmap_tools.fusion.intensity_likelihood import IntensityLikelihood, default_bin_edges
from hdmap_tools.fusion.learn_intensity import learn_from_map, learn_from_truth
from hdmap_tools.fusion.observation_model import observation_model
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.labels.label_set import MAP_CLASSES
from hdmap_tools.map_reading import model_for
from hdmap_tools.segmentation.confusion import ConfusionMatrix

from .builders import ADAS, meta

NAMES = ("road", "lane_mark")
SIDE = 120


def drawn(rng: np.random.Generator, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Intensity around 20 on road (0) and around 90 on a tenth of paint (1), and which it is."""
    is_paint = rng.random(number) < 0.1
    return np.clip(rng.normal(np.where(is_paint, 90, 20), 8), 0, 255), is_paint


def learned(seed: int = 0, number: int = 20_000) -> IntensityLikelihood:
    values, is_paint = drawn(np.random.default_rng(seed), number)
    return IntensityLikelihood.estimate(
        values, np.stack([~is_paint, is_paint]).astype(float), NAMES
    )


def test_each_class_gets_its_own_histogram():
    likelihood = learned()
    np.testing.assert_allclose(np.exp(likelihood.log_probability).sum(axis=1), 1.0)
    at = np.array([20.0, 90.0, 50.0])
    road, mark = likelihood.log_likelihood(at)
    assert road[0] - mark[0] > 2.0
    assert mark[1] - road[1] > 2.0
    assert likelihood.num_cells.sum() == 20_000
    # Against the law they were drawn from, where there is data; the neutral share bounds the rest.
    values, is_paint = drawn(np.random.default_rng(9), 5000)
    said_paint = np.diff(likelihood.log_likelihood(values), axis=0)[0] + np.log(0.1 / 0.9) > 0
    assert (said_paint == is_paint).mean() > 0.995


def test_a_cell_without_intensity_says_nothing():
    silent = learned().log_likelihood(np.array([[np.nan, 90.0]]))
    assert silent.shape == (2, 1, 2)
    assert (silent[:, 0, 0] == 0.0).all()


@given(st.floats(0.0, 255.0), st.integers(0, 200))
def test_no_intensity_rules_a_class_out(value, number):
    values, is_paint = drawn(np.random.default_rng(number), number + 5)
    weights = np.stack([~is_paint, is_paint]).astype(float)
    weights[:, 0] = 0.5
    likelihood = IntensityLikelihood.estimate(values, weights, NAMES)
    gap = np.diff(likelihood.log_likelihood(np.array([value])), axis=0)
    assert np.isfinite(gap).all()
    assert abs(float(gap[0, 0])) < 12.0


def test_a_class_never_seen_looks_like_the_average():
    values, _ = drawn(np.random.default_rng(1), 3000)
    weights = np.stack([np.ones(3000), np.zeros(3000)])
    likelihood = IntensityLikelihood.estimate(values, weights, NAMES)
    np.testing.assert_allclose(likelihood.log_probability[1], likelihood.log_neutral)
    asked = likelihood.for_classes(("sidewalk", "road"))
    np.testing.assert_array_equal(asked.log_probability[0], likelihood.log_neutral)
    np.testing.assert_array_equal(asked.log_probability[1], likelihood.log_probability[0])
    with pytest.raises(LabelError, match="sidewalk"):
        likelihood.for_classes(("sidewalk",))


def test_intensities_at_the_ends_have_a_bin():
    edges = default_bin_edges()
    assert edges[0] == 0.0
    assert edges[-1] == 256.0
    assert (np.diff(edges) > 0).all()
    assert np.isfinite(learned().log_likelihood(np.array([0.0, 255.0, 256.0, -1.0]))).all()


def test_json_comes_back(tmp_path):
    likelihood = learned()
    path = tmp_path / "i.json"
    likelihood.save(path)
    back = IntensityLikelihood.load(path)
    assert back.classes == NAMES
    np.testing.assert_allclose(back.log_probability, likelihood.log_probability, atol=1e-7)
    assert back.to_json() == likelihood.to_json()
    with pytest.raises(OutputExistsError):
        likelihood.save(path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.replace('"road"', "3", 1), "classes"),
        (lambda t: t[: len(t) // 2], "not an intensity likelihood"),
        (lambda t: t.replace('"neutral":[', '"neutral":[0.5,', 1), "arrays of"),
        (lambda t: t.replace('"probability"', '"chance"'), "probability"),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, says):
    path = tmp_path / "i.json"
    text = learned().to_json().replace(" ", "").replace("\n", "")
    changed = change(text)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(ConfigError, match=says):
        IntensityLikelihood.load(path)


def test_nothing_to_learn_from_is_said():
    nothing = np.full(10, np.nan)
    with pytest.raises(ShapeError, match=r"observation\.intensity"):
        IntensityLikelihood.estimate(nothing, np.ones((2, 10)), NAMES)
    with pytest.raises(ShapeError, match="Weights"):
        IntensityLikelihood.estimate(np.zeros(10), np.ones((3, 10)), NAMES)
    counts = CellCounts(meta())
    counts.add(Observations(np.zeros((1, 3)), np.array([1], np.uint8)), 0)
    with pytest.raises(ShapeError, match="No cell of the map has a lidar intensity"):
        learn_from_map(counts, plain_model())


# A map whose labels hardly tell paint from road, and whose intensity does.


def confusion() -> ConfusionMatrix:
    counts = np.zeros((len(ADAS), len(ADAS)), dtype=np.int64)
    counts[0] = [94, 2, 2, 2]
    counts[2] = [10, 10, 70, 10]
    counts[1] = [4, 80, 1, 15]
    counts[3] = [4, 46, 1, 49]
    return ConfusionMatrix(ADAS, ADAS, counts, "made")


def plain_model():
    config = ObservationConfig(model="confusion")
    return observation_model(config, meta(), MAP_CLASSES, confusion())


@pytest.fixture(scope="module")
def street() -> tuple[CellCounts, BevGrid, np.ndarray]:
    """A map of one vote a cell and frame from that confusion, its grid, and which cells are paint."""
    rng = np.random.default_rng(11)
    grid = BevGrid(0.2, 0, 0, SIDE, SIDE)
    is_paint = np.zeros((SIDE, SIDE), dtype=bool)
    is_paint[:, ::10] = True
    rows, cols = (a.ravel() for a in np.mgrid[0:SIDE, 0:SIDE])
    true = np.where(is_paint.ravel(), 3, 1)
    rates = confusion().counts / 100.0
    counts = CellCounts(meta(count_mode="majority"))
    points = np.column_stack([(cols + 0.5) * 0.2, (rows + 0.5) * 0.2, 0.0 * rows])
    for key in range(3):
        chance = rng.random(len(true))
        labels = (chance[:, None] > np.cumsum(rates[true], axis=1)).sum(axis=1).astype(np.uint8)
        intensity = np.clip(rng.normal(np.where(true == 3, 80, 25), 12), 0, 255).astype(np.uint8)
        counts.add(Observations(points, labels, intensity, rng.random(len(true)) < 0.9), key)
    return counts, grid, is_paint


def mark_iou(window, is_paint) -> float:
    said = window.dataset["posterior"].values.argmax(axis=0) == window.classes.index("lane_mark")
    return float((said & is_paint).sum() / (said | is_paint).sum())


def majority_model(intensity: str):
    config = Config(observation={"model": "confusion", "intensity": intensity})
    return observation_model(
        config.observation, meta(count_mode="majority"), MAP_CLASSES, confusion()
    )


def test_a_map_teaches_itself_what_paint_looks_like(street):
    counts, grid, is_paint = street
    plain = majority_model("off")
    from_map = learn_from_map(counts, plain)
    shares = np.stack([~is_paint, is_paint]).astype(float)
    from_truth = learn_from_truth(counts, grid, shares, NAMES)
    mark, road = (from_map.classes.index(n) for n in ("lane_mark", "road"))
    peak = from_map.bin_edges[from_map.log_probability[mark].argmax()]
    assert 65 < peak < 90
    assert 15 < from_map.bin_edges[from_map.log_probability[road].argmax()] < 32
    np.testing.assert_allclose(from_truth.num_cells.sum(), np.isfinite(means(counts, grid)).sum())
    before = mark_iou(read_window(counts, grid, plain), is_paint)
    of_map = mark_iou(read_window(counts, grid, plain.with_intensity(from_map, 1.0)), is_paint)
    of_truth = mark_iou(read_window(counts, grid, plain.with_intensity(from_truth, 1.0)), is_paint)
    assert before < 0.6
    assert of_map > 0.9
    assert of_truth > 0.9


def test_more_rounds_sharpen_what_was_learned(street):
    counts, _, _ = street
    gaps = []
    for rounds in (1, 3):
        one = learn_from_map(counts, majority_model("off"), rounds=rounds)
        at = one.log_likelihood(np.array([80.0]))[:, 0]
        gaps.append(at[one.classes.index("lane_mark")] - at[one.classes.index("road")])
    assert gaps[1] > gaps[0] > 0.5


def test_fewer_cells_learn_the_same(street):
    counts, _, _ = street
    every, some = (
        learn_from_map(counts, majority_model("off"), max_cells=n) for n in (10**6, 4000)
    )
    assert some.num_cells.sum() < 0.5 * every.num_cells.sum()
    mark = every.classes.index("lane_mark")
    top = [one.bin_edges[one.log_probability[mark].argmax()] for one in (every, some)]
    assert abs(top[0] - top[1]) < 20


def test_the_configuration_asks_for_it(street, tmp_path):
    counts, grid, _ = street
    matrix = tmp_path / "confusion.json"
    matrix.write_text(confusion().to_json())
    base = {"model": "confusion", "confusion": matrix, "intensity": "learned"}
    config = Config(observation=base)
    itself = model_for(counts.meta, config, counts)
    assert itself.intensity is not None
    assert model_for(counts.meta, config).intensity is None
    itself.intensity.save(tmp_path / "i.json")
    from_file = model_for(
        counts.meta, Config(observation=base | {"intensity_likelihood": tmp_path / "i.json"})
    )
    a, b = (read_window(counts, grid, m).dataset["posterior"].values for m in (itself, from_file))
    np.testing.assert_allclose(a, b, atol=1e-5)
    silent = model_for(counts.meta, Config(observation=base | {"intensity_weight": 0.0}), counts)
    plain = majority_model("off")
    np.testing.assert_allclose(
        read_window(counts, grid, silent).dataset["posterior"].values,
        read_window(counts, grid, plain).dataset["posterior"].values,
        atol=1e-6,
    )


def test_filled_cells_take_the_mean_intensity_of_their_neighbours(street):
    counts = CellCounts(meta())
    cells = np.array([[1, 1], [3, 1], [2, 3]])
    points = np.column_stack([(cells + 0.5) * 0.2, np.zeros(3)])
    seen = Observations(
        points,
        np.full(3, 1, np.uint8),
        np.array([80, 100, 7], np.uint8),
        np.array([True, True, False]),
    )
    counts.add(seen, 0)
    model = plain_model().with_intensity(learned(), 1.0)
    window = read_window(counts, BevGrid(0.2, 0, 0, 6, 6), model, 1)
    one_vote = counts.window(BevGrid(0.2, 1, 1, 2, 2)).layers["counts"].astype(float)
    both = np.zeros_like(one_vote)
    both[1, :] = one_vote[1, :].sum() / 2
    both[1, 0] = 0.0
    both[1, 1] = 16.0
    expected = model.posterior(both, np.array([[90.0]]))[:, 0, 0]
    np.testing.assert_allclose(window.dataset["posterior"].values[:, 1, 2], expected, atol=1e-6)
    # Next to a cell without a return only, intensity says nothing.
    low = np.zeros_like(one_vote)
    low[1, 0] = 16.0
    expected = model.posterior(low, np.array([[np.nan]]))[:, 0, 0]
    np.testing.assert_allclose(window.dataset["posterior"].values[:, 4, 2], expected, atol=1e-6)
    assert np.isnan(window.layer("intensity")[1, 2])


def means(counts: CellCounts, grid: BevGrid) -> np.ndarray:
    layers = counts.window(grid).layers
    with np.errstate(invalid="ignore"):
        return layers["intensity_sum"] / layers["intensity_n"]
