import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.config import ObservationConfig
from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.fusion.intensity_likelihood import IntensityLikelihood
from hdmap_tools.fusion.observation_model import (
    OTHER,
    confusion_likelihood,
    observation_model,
    vanilla_likelihood,
)
from hdmap_tools.labels.label_set import MAP_CLASSES, MapClass, load_label_set
from hdmap_tools.segmentation.confusion import ConfusionMatrix, RangeBand

from .builders import ADAS, meta

CITYSCAPES = load_label_set("cityscapes")
NAMES = (*(str(c) for c in MAP_CLASSES), OTHER)


def random_confusion(rng: np.random.Generator) -> ConfusionMatrix:
    counts = rng.integers(0, 50, (len(CITYSCAPES), len(ADAS)))
    return ConfusionMatrix(CITYSCAPES, ADAS, counts, "drawn")


def sequential_bayes(log_likelihood, log_prior, votes):
    """One observation after the other, normalized each time, in linear space."""
    belief = np.exp(log_prior)
    for label, intensity_bin in votes:
        belief = belief * np.exp(log_likelihood[:, label, intensity_bin])
        belief = belief / belief.sum()
    return belief


@given(
    seed=st.integers(0, 10_000),
    votes=st.lists(st.tuples(st.integers(0, 3), st.integers(0, 1)), min_size=1, max_size=40),
    kind=st.sampled_from(["vanilla", "confusion"]),
    intensity=st.booleans(),
)
@settings(max_examples=100, deadline=None)
def test_counts_give_what_sequential_bayes_gives(seed, votes, kind, intensity):
    confusion = random_confusion(np.random.default_rng(seed))
    config = ObservationConfig(model=kind, intensity=intensity, gamma=0.7)
    model = observation_model(config, meta(count_mode="point"), MAP_CLASSES, confusion)
    counts = np.zeros((len(ADAS), 2, 1, 1), dtype=np.uint32)
    for label, intensity_bin in votes:
        counts[label, intensity_bin, 0, 0] += 1
    expected = sequential_bayes(model.log_likelihood, model.log_prior, votes)
    np.testing.assert_allclose(model.posterior(counts)[:, 0, 0], expected, atol=1e-9, rtol=0)


@given(
    seed=st.integers(0, 10_000),
    votes=st.lists(st.tuples(st.integers(0, 3), st.integers(0, 1)), min_size=1, max_size=30),
    intensity=st.floats(0, 255),
    weight=st.floats(0, 3),
)
@settings(max_examples=25, deadline=None)
def test_the_mean_intensity_is_one_more_observation(seed, votes, intensity, weight):
    rng = np.random.default_rng(seed)
    learned = IntensityLikelihood.estimate(
        rng.uniform(0, 255, 400), rng.dirichlet(np.ones(3), 400).T, ("road", "lane_mark", OTHER)
    )
    config = ObservationConfig(model="confusion")
    plain = observation_model(config, meta(count_mode="point"), MAP_CLASSES, random_confusion(rng))
    model = plain.with_intensity(learned, weight)
    counts = np.zeros((len(ADAS), 2, 1, 1), dtype=np.uint32)
    for label, intensity_bin in votes:
        counts[label, intensity_bin, 0, 0] += 1
    belief = sequential_bayes(model.log_likelihood, model.log_prior, votes)
    # One more factor of Bayes' rule, by hand from the histogram.
    column = np.searchsorted(learned.bin_edges, intensity, side="right") - 1
    rows = learned.for_classes(model.classes).log_probability[:, column]
    belief = belief * np.exp(weight * rows)
    belief /= belief.sum()
    got = model.posterior(counts, np.array([[intensity]]))[:, 0, 0]
    np.testing.assert_allclose(got, belief, atol=1e-9, rtol=0)
    # Without a return it says nothing.
    np.testing.assert_allclose(
        model.posterior(counts, np.array([[np.nan]])), plain.posterior(counts), atol=1e-12
    )


def test_share_votes_weigh_as_one_vote_a_frame():
    config = ObservationConfig(model="vanilla")
    share = observation_model(config, meta(count_mode="share"), MAP_CLASSES, None)
    single = observation_model(config, meta(count_mode="majority"), MAP_CLASSES, None)
    counts = np.zeros((4, 2, 1, 1), dtype=np.uint32)
    counts[1, 0] = 3
    np.testing.assert_allclose(share.posterior(counts * 16), single.posterior(counts), atol=1e-12)


def test_vanilla_is_mu_identity_plus_lambda_when_labels_and_classes_agree():
    likelihood, can_tell = vanilla_likelihood(ADAS, ("road", "lane_mark", OTHER), 0.1)
    mu = 1.0 / (1.0 + 4 * 0.1)
    np.testing.assert_allclose(likelihood[0], mu * np.array([0.1, 1.1, 0.1, 0.1]))
    np.testing.assert_allclose(likelihood[1], mu * np.array([0.1, 0.1, 0.1, 1.1]))
    # Background and curb are none of the classes: both stand for OTHER.
    np.testing.assert_allclose(likelihood[2], np.array([1.1, 0.1, 1.1, 0.1]) / 2.4)
    assert can_tell == [True, True, True]


def test_confusion_rows_of_one_class_are_added_before_they_are_normalized():
    counts = np.zeros((len(CITYSCAPES), len(ADAS)), dtype=np.int64)
    # Cityscapes has two labels that are vegetation: vegetation and terrain.
    counts[CITYSCAPES.id_of("vegetation")] = [90, 10, 0, 0]
    counts[CITYSCAPES.id_of("terrain")] = [300, 100, 0, 0]
    matrix = ConfusionMatrix(CITYSCAPES, ADAS, counts, "")
    likelihood, can_tell = confusion_likelihood(matrix, NAMES, 0.04)
    row = likelihood[NAMES.index("vegetation")]
    np.testing.assert_allclose(row, 0.96 * np.array([0.78, 0.22, 0, 0]) + 0.01)
    assert can_tell == [name == "vegetation" for name in NAMES]


@given(st.integers(0, 1000), st.floats(1e-4, 0.5))
@settings(max_examples=50, deadline=None)
def test_likelihoods_are_positive_and_sum_to_one(seed, smoothing):
    likelihood, _ = confusion_likelihood(
        random_confusion(np.random.default_rng(seed)), NAMES, smoothing
    )
    assert (likelihood > 0).all()
    np.testing.assert_allclose(likelihood.sum(axis=1), 1.0)


def test_a_class_that_no_label_tells_gets_probability_zero():
    model = observation_model(ObservationConfig(model="vanilla"), meta(), MAP_CLASSES, None)
    counts = np.ones((4, 2, 1, 1), dtype=np.uint32)
    posterior = dict(zip(model.classes, model.posterior(counts)[:, 0, 0], strict=True))
    assert posterior["crosswalk"] == posterior["vegetation"] == posterior["sidewalk"] == 0.0
    assert posterior["road"] > 0.0
    assert sum(posterior.values()) == pytest.approx(1.0)


def test_a_cell_without_evidence_is_unknown_never_class_zero():
    model = observation_model(ObservationConfig(model="vanilla"), meta(), MAP_CLASSES, None)
    posterior = model.posterior(np.zeros((4, 2, 2, 3), dtype=np.uint32))
    assert posterior.shape == (len(NAMES), 2, 3)
    assert np.isnan(posterior).all()


def test_a_hundred_thousand_votes_do_not_underflow():
    model = observation_model(ObservationConfig(model="vanilla"), meta(), MAP_CLASSES, None)
    counts = np.zeros((4, 2, 1, 1), dtype=np.uint32)
    counts[1], counts[3] = 4_000_000_000, 3_999_999_000
    posterior = model.posterior(counts)
    assert np.isfinite(posterior).all()
    assert posterior.sum() == pytest.approx(1.0)
    assert posterior[0, 0, 0] > 0.99


def test_intensity_is_evidence_for_paint():
    counts = np.zeros((4, 2, 1, 2), dtype=np.uint32)
    counts[1, 0, 0, 0] = counts[1, 1, 0, 1] = 16
    plain = observation_model(ObservationConfig(model="vanilla"), meta(), MAP_CLASSES, None)
    with_i = observation_model(
        ObservationConfig(model="vanilla", intensity=True, gamma=2.0), meta(), MAP_CLASSES, None
    )
    mark = plain.classes.index("lane_mark")
    assert plain.posterior(counts)[mark, 0, 0] == plain.posterior(counts)[mark, 0, 1]
    assert with_i.posterior(counts)[mark, 0, 0] == plain.posterior(counts)[mark, 0, 0]
    road = plain.classes.index("road")
    gain = np.log(with_i.posterior(counts)[mark, 0, 1] / with_i.posterior(counts)[road, 0, 1])
    before = np.log(plain.posterior(counts)[mark, 0, 1] / plain.posterior(counts)[road, 0, 1])
    assert gain - before == pytest.approx(2.0)


def test_temperature_makes_the_posterior_more_careful():
    counts = np.zeros((4, 2, 1, 1), dtype=np.uint32)
    counts[1, 0] = 16
    sharp, careful = (
        observation_model(
            ObservationConfig(model="vanilla", temperature=t), meta(), MAP_CLASSES, None
        ).posterior(counts)[0, 0, 0]
        for t in (1.0, 3.0)
    )
    assert 1.0 / 3.0 < careful < sharp


def test_priors_decide_without_telling_evidence():
    config = ObservationConfig(model="vanilla", priors={MapClass.ROAD: 0.9})
    model = observation_model(config, meta(), MAP_CLASSES, None)
    assert np.exp(model.log_prior[0]) == pytest.approx(0.9)
    assert np.exp(model.log_prior).sum() == pytest.approx(1.0)


def test_priors_above_one_are_refused():
    config = ObservationConfig(
        model="vanilla", priors={MapClass.ROAD: 0.8, MapClass.LANE_MARK: 0.5}
    )
    with pytest.raises(ConfigError, match=r"observation\.priors"):
        observation_model(config, meta(), MAP_CLASSES, None)


def test_confusion_without_a_matrix_is_refused():
    with pytest.raises(ConfigError, match=r"hdmap confusion.*--confusion"):
        observation_model(ObservationConfig(model="confusion"), meta(), MAP_CLASSES, None)


def test_auto_believes_labels_alike_where_no_matrix_is_known(caplog):
    auto = observation_model(ObservationConfig(), meta(), MAP_CLASSES, None)
    vanilla = observation_model(ObservationConfig(model="vanilla"), meta(), MAP_CLASSES, None)
    np.testing.assert_array_equal(auto.log_likelihood, vanilla.log_likelihood)
    assert "No confusion matrix is known" in caplog.text


@pytest.mark.parametrize("kind", ["vanilla", "confusion"])
def test_classes_that_are_left_out_are_none_of_these(kind):
    # A map of road and lane mark alone: what is labelled sidewalk is OTHER, not road.
    matrix = ConfusionMatrix(CITYSCAPES, CITYSCAPES, 100 * np.eye(19, dtype=np.int64) + 1, "")
    of = meta(label_set=CITYSCAPES)
    model = observation_model(
        ObservationConfig(model=kind), of, (MapClass.ROAD, MapClass.LANE_MARK), matrix
    )
    counts = np.zeros((19, 2, 1, 1), dtype=np.uint32)
    counts[CITYSCAPES.id_of("sidewalk")] = 3 * 16
    posterior = dict(zip(model.classes, model.posterior(counts)[:, 0, 0], strict=True))
    assert posterior[OTHER] > 0.95
    assert posterior["road"] < 0.05


def test_labels_of_moving_objects_do_not_weigh_in_the_rows():
    # Association never counts them, so a row must sum to 1 without them.
    is_counted = np.array([not label.moves for label in CITYSCAPES.labels])
    assert not is_counted.all()
    counts = np.ones((19, 19), dtype=np.int64)
    counts[CITYSCAPES.id_of("building"), CITYSCAPES.id_of("car")] = 10_000
    matrix = ConfusionMatrix(CITYSCAPES, CITYSCAPES, counts, "")
    for likelihood in (
        confusion_likelihood(matrix, NAMES, 0.01)[0],
        vanilla_likelihood(CITYSCAPES, NAMES, 0.1)[0],
    ):
        np.testing.assert_allclose(likelihood[:, is_counted].sum(axis=1), 1.0)
        assert (likelihood > 0).all()


def test_a_matrix_for_other_labels_is_refused():
    other = ConfusionMatrix(ADAS, CITYSCAPES, np.ones((4, 19), dtype=np.int64), "")
    with pytest.raises(LabelError, match=r"predicts 'cityscapes'.*counted 'adas-0001'"):
        observation_model(ObservationConfig(model="confusion"), meta(), MAP_CLASSES, other)


def test_each_band_of_range_is_read_with_its_own_matrix():
    near = np.full((len(CITYSCAPES), len(ADAS)), 1000)
    far = near.copy()
    near[:, 0], far[:, 1] = 9000, 9000
    bands = (RangeBand(0.0, 6.0, near), RangeBand(6.0, np.inf, far))
    whole = ConfusionMatrix(CITYSCAPES, ADAS, near + far, "drawn", bands)
    config = ObservationConfig(model="confusion", intensity="gamma", gamma=0.7)
    apart = observation_model(config, meta(range_edges_m=(6.0,)), MAP_CLASSES, whole)
    one = [
        observation_model(config, meta(), MAP_CLASSES, ConfusionMatrix(CITYSCAPES, ADAS, counts))
        for counts in (near, far)
    ]
    np.testing.assert_allclose(apart.log_likelihood[:, :, :2], one[0].log_likelihood)
    np.testing.assert_allclose(apart.log_likelihood[:, :, 2:], one[1].log_likelihood)
    assert not np.allclose(apart.log_likelihood[:, :, :2], apart.log_likelihood[:, :, 2:])
    # A matrix without bands is read the same at any range.
    bare = observation_model(
        config, meta(range_edges_m=(6.0,)), MAP_CLASSES, ConfusionMatrix(CITYSCAPES, ADAS, near)
    )
    np.testing.assert_allclose(bare.log_likelihood[:, :, :2], bare.log_likelihood[:, :, 2:])


def test_a_label_hardly_seen_in_a_band_is_read_with_its_whole_row():
    near = np.full((len(CITYSCAPES), len(ADAS)), 1000)
    far = near.copy()
    road = CITYSCAPES.id_of("road")
    far[road] = [3, 0, 0, 0]
    bands = (RangeBand(0.0, 6.0, near), RangeBand(6.0, np.inf, far))
    whole = ConfusionMatrix(CITYSCAPES, ADAS, near + far, "drawn", bands)
    model = observation_model(
        ObservationConfig(model="confusion"), meta(range_edges_m=(6.0,)), MAP_CLASSES, whole
    )
    row = model.log_likelihood[NAMES.index("road"), :, 2]
    assert np.ptp(row) < 0.01  # three pixels do not make a network that always errs
