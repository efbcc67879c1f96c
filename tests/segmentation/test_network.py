"""Images into numbers and answers into label images: exact on pictures whose labels are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from hdmap_tools.errors import CalibrationError, ConfigError, LabelError, ShapeError
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.answers import labels_from_ids, labels_from_scores
from hdmap_tools.segmentation.inputs import batch_from_image
from hdmap_tools.segmentation.network import (
    Network,
    NetworkSegmenter,
)

blocks = npst.arrays(np.uint8, st.tuples(st.just(3), st.just(4)), elements=st.integers(0, 3))


def network(run, shape=(1, 3, 6, 8)):
    return Network("colours.onnx", "none 1", "0" * 64, shape, run)


def scores_of(batch):
    """What the tiny network gives: black, red, green, blue."""
    return np.concatenate([1 - batch.sum(axis=1, keepdims=True), batch], axis=1)


# Sizes whose ratio is whole, so that no pixel of one straddles two blocks of the other.
# Scores enlarged more than twice are rounded off where four blocks meet, rightly.
SIZES = [
    (output, net_px, image_px)
    for output in ("scores", "ids")
    for net_px in (2, 4, 6, 8)
    for image_px in (2, 4, 8, 16)
    if max(net_px, image_px) % min(net_px, image_px) == 0
    and (output == "ids" or image_px <= 2 * net_px)
]


@given(blocks=blocks)
@pytest.mark.parametrize(("output", "net_px", "image_px"), SIZES)
def test_labels_stay_at_their_pixels_whatever_the_sizes(
    output, net_px, image_px, blocks, make_profile, paint
):
    rgb, expected = paint(blocks, image_px)
    profile = make_profile(input_size_px=(4 * net_px, 3 * net_px), output=output)

    def run(batch):
        scores = scores_of(batch)
        return scores if output == "scores" else scores.argmax(axis=1)

    segmenter = NetworkSegmenter(network(run, (1, 3, None, None)), profile, {})
    np.testing.assert_array_equal(segmenter.segment_rgb(rgb), expected)


@given(blocks=blocks)
@pytest.mark.parametrize("output", ["scores", "ids"])
@pytest.mark.parametrize("mirror", [np.s_[:, ::-1], np.s_[::-1]], ids=["sideways", "upright"])
def test_a_mirrored_image_gives_the_mirrored_labels(mirror, output, blocks, make_profile, paint):
    # Sizes at which no pixel centre falls on an edge of the other grid.
    rgb, _ = paint(blocks, 5)
    profile = make_profile(input_size_px=(13, 9), output=output)

    def run(batch):
        scores = scores_of(batch)
        return scores if output == "scores" else scores.argmax(axis=1)

    segmenter = NetworkSegmenter(network(run, (1, 3, 9, 13)), profile, {})
    labels = segmenter.segment_rgb(rgb)
    mirrored = segmenter.segment_rgb(np.ascontiguousarray(rgb[mirror]))
    np.testing.assert_array_equal(mirrored, labels[mirror])


def test_input_is_scaled_then_normalized_in_the_order_of_the_channels(make_profile):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    profile = make_profile(
        input_size_px=None, channels="bgr", scale=0.5, mean=(1.0, 2.0, 3.0), std=(4.0, 5.0, 6.0)
    )
    batch = batch_from_image(rgb, profile)
    expected = (rgb[:, :, ::-1] * 0.5 - (1.0, 2.0, 3.0)) / (4.0, 5.0, 6.0)
    assert batch.shape == (1, 3, 5, 7)
    assert batch.dtype == np.float32
    np.testing.assert_allclose(batch[0].transpose(1, 2, 0), expected, rtol=1e-6, atol=1e-5)


def test_raw_input_is_the_very_pixel_values(make_profile):
    rgb = np.random.default_rng(1).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    batch = batch_from_image(rgb, make_profile(input_size_px=None, scale=1.0))
    np.testing.assert_array_equal(batch[0].transpose(1, 2, 0), rgb)


@given(
    scores=npst.arrays(
        np.float32, (1, 4, 3, 5), elements=st.floats(-5, 5, width=32).map(lambda v: round(v, 1))
    )
)
def test_the_best_score_wins_and_of_equal_ones_the_first(scores, label_set):
    labels = labels_from_scores(scores, label_set, (5, 3), "N")
    np.testing.assert_array_equal(labels, scores[0].argmax(axis=0))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_scores_that_are_no_numbers_are_refused(bad, label_set):
    scores = np.zeros((1, 4, 3, 5), np.float32)
    scores[0, 2, 1, 1] = bad
    with pytest.raises(LabelError, match="Network N gave 1 scores that are NaN or infinite"):
        labels_from_scores(scores, label_set, (5, 3), "Network N")


def test_a_wrong_number_of_channels_names_both(label_set):
    with pytest.raises(LabelError, match=r"gave 5 channels, but label set 'colours' has 4 labels"):
        labels_from_scores(np.zeros((1, 5, 3, 5)), label_set, (5, 3), "N")


@pytest.mark.parametrize("shape", [(4, 3, 5), (2, 4, 3, 5), (60,)])
def test_scores_of_another_shape_are_refused(shape, label_set):
    with pytest.raises(LabelError, match="scores must be"):
        labels_from_scores(np.zeros(shape, np.float32), label_set, (5, 3), "N")


@pytest.mark.parametrize("bad", [4, 254, 256, -1, 0.5, np.nan, np.inf])
def test_ids_outside_the_label_set_are_refused(bad, label_set):
    ids = np.zeros((1, 3, 5))
    ids[0, 1, 1] = bad
    with pytest.raises(LabelError, match="label id"):
        labels_from_ids(ids, label_set, (5, 3), "N")


def test_ids_come_with_or_without_a_channel_axis(label_set):
    ids = np.arange(4, dtype=np.int64).reshape(1, 2, 2)
    for answer in (ids, ids[:, None], ids.astype(np.float32)):
        np.testing.assert_array_equal(labels_from_ids(answer, label_set, (2, 2), "N"), ids[0])
    with pytest.raises(LabelError, match="output: scores"):
        labels_from_ids(np.zeros((1, 4, 2, 2)), label_set, (2, 2), "N")


@pytest.mark.parametrize(
    ("shape", "size", "message"),
    [
        ((1, 6, 8, 3), (8, 6), "channels first"),
        ((1, 1, 6, 8), (8, 6), r"expected \(1, 3, H, W\)"),
        ((4, 3, 6, 8), (8, 6), r"expected \(1, 3, H, W\)"),
        ((1, 3, 48), (8, 6), r"expected \(1, 3, H, W\)"),
        ((1, 3, 8, 6), (8, 6), r"feeds \(1, 3, 6, 8\) from its input_size_px \[8, 6\]"),
        ((1, 3, 6, 8), None, "set its input_size_px"),
    ],
)
def test_a_network_whose_input_does_not_fit_its_profile_is_refused(
    shape, size, message, make_profile
):
    with pytest.raises(ConfigError, match=message):
        NetworkSegmenter(network(scores_of, shape), make_profile(input_size_px=size), {})


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)],
)
def test_only_rgb_images_of_bytes_are_taken(image, make_profile):
    segmenter = NetworkSegmenter(network(scores_of), make_profile(), {})
    with pytest.raises(ShapeError, match="uint8"):
        segmenter.segment_rgb(image)


def test_an_image_of_an_unknown_camera_names_the_known_ones(make_profile, camera, tmp_path):
    segmenter = NetworkSegmenter(network(scores_of), make_profile(), {"front": camera})
    with pytest.raises(CalibrationError, match=r"'rear'.*calibrated are front"):
        segmenter.segment(ImageRef("rear", 0, tmp_path / "0.png"))


def test_the_fingerprint_follows_what_changes_results_and_nothing_else(make_profile):
    def fingerprint(weights="0" * 64, runtime="none 1", **changes):
        net = Network("m.onnx", runtime, weights, (1, 3, None, None), scores_of)
        return NetworkSegmenter(net, make_profile(**changes), {}).fingerprint

    base = fingerprint()
    assert fingerprint() == base
    assert fingerprint(source="told elsewhere", name="renamed") == base
    others = [
        fingerprint(weights="1" * 64),
        fingerprint(runtime="none 2"),
        fingerprint(channels="bgr"),
        fingerprint(scale=1.0),
        fingerprint(mean=(0.0, 0.0, 0.1)),
        fingerprint(std=(1.0, 1.0, 2.0)),
        fingerprint(input_size_px=(16, 12)),
        fingerprint(output="ids"),
        fingerprint(label_set="adas-0001"),
    ]
    assert len({base, *others}) == len(others) + 1
