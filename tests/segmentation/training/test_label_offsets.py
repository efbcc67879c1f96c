"""Offsets of scores: they undo a known bias, and leave a fair network alone."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from hdmap_tools.segmentation.training.label_offsets import fit_offsets  # noqa: E402
from hdmap_tools.segmentation.training.models import StreetNet, shift_scores  # noqa: E402


def fair_scores(seed: int = 0, number: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    """Scores whose highest is mostly the true label's; the third label is rare."""
    rng = np.random.default_rng(seed)
    truth = rng.choice(3, number, p=[0.6, 0.37, 0.03])
    scores = rng.normal(0, 1, (number, 3)).astype(np.float32)
    scores[np.arange(number), truth] += 3.0
    return scores, truth


def mean_iou(scores: np.ndarray, truth: np.ndarray) -> float:
    said = scores.argmax(axis=1)
    return float(
        np.mean(
            [
                ((said == k) & (truth == k)).sum() / ((said == k) | (truth == k)).sum()
                for k in range(3)
            ]
        )
    )


def test_a_bias_is_undone() -> None:
    scores, truth = fair_scores()
    biased = scores + np.array([0.0, 0.0, 2.5], dtype=np.float32)
    offsets = fit_offsets(biased, truth)
    assert mean_iou(biased + offsets.astype(np.float32), truth) >= mean_iou(scores, truth)
    assert mean_iou(biased, truth) < mean_iou(scores, truth) - 0.1
    assert offsets[2] < offsets[:2].min() - 1.5
    other, other_truth = fair_scores(1)
    other += np.array([0.0, 0.0, 2.5], dtype=np.float32)
    # What was fitted on some pixels holds on others.
    assert (
        mean_iou(other + offsets.astype(np.float32), other_truth)
        > mean_iou(other, other_truth) + 0.1
    )


def test_labels_that_are_not_there_stay_as_they_are() -> None:
    scores, truth = fair_scores()
    kept = truth < 2
    assert fit_offsets(scores[kept], truth[kept])[2] == 0.0


def test_offsets_become_part_of_the_network() -> None:
    model = StreetNet(3).eval()
    images = torch.randn(1, 3, 48, 64)
    with torch.inference_mode():
        before = model(images)
        shift_scores(model, [1.0, 0.0, -2.0])
        moved = (model(images) - before).numpy()
    np.testing.assert_allclose(
        moved[0].reshape(3, -1),
        np.array([[1.0], [0.0], [-2.0]]) + 0 * moved[0].reshape(3, -1),
        atol=1e-5,
    )
