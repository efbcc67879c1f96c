"""Validation counts what a network says of whole images."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from hdmap_tools.errors import ConfigError, LabelError  # noqa: E402
from hdmap_tools.segmentation.confusion import ConfusionMatrix  # noqa: E402
from hdmap_tools.segmentation.training.augmentation import Augmentation  # noqa: E402
from hdmap_tools.segmentation.training.validation import confusion_on, label_ious, mean_iou  # noqa: E402

CPU = torch.device("cpu")


class ByBrightness(torch.nn.Module):
    """Tells the toy labels apart exactly; undoes the normalization to do so."""

    def __init__(self, augmentation):
        super().__init__()
        self.mean, self.std = augmentation.mean[0], augmentation.std[0]

    def forward(self, images):
        red = (images[:, :1] * self.std + self.mean) * 255
        return -(red - torch.tensor([20.0, 120.0, 230.0]).view(1, 3, 1, 1)).abs()


def test_a_perfect_network_has_counts_on_the_diagonal_only(toy_pairs):
    augmentation = Augmentation(mean=(0.4, 0.5, 0.6), std=(0.1, 0.2, 0.3))
    pairs = toy_pairs(3)
    matrix = confusion_on(ByBrightness(augmentation), pairs, range(3), augmentation, CPU)
    counts = sum(np.bincount(pairs.read(k)[1].ravel(), minlength=256)[:3] for k in range(3))
    assert (matrix.counts == np.diag(counts)).all()
    assert mean_iou(matrix) == 1


def test_only_the_images_asked_for_are_judged(toy_pairs):
    augmentation = Augmentation()
    model = ByBrightness(augmentation)
    whole = confusion_on(model, toy_pairs(4), range(4), augmentation, CPU)
    parts = [
        confusion_on(model, toy_pairs(4), part, augmentation, CPU) for part in ([0, 2], [1, 3])
    ]
    assert whole == parts[0] + parts[1]


def test_large_images_are_judged_shrunk_but_at_their_own_size(toy_pairs):
    augmentation = Augmentation()
    sizes = []

    class Seen(ByBrightness):
        def forward(self, images):
            sizes.append(tuple(images.shape[-2:]))
            return super().forward(images)

    model = Seen(augmentation)
    matrix = confusion_on(model, toy_pairs(1), [0], augmentation, CPU, long_side_px=22)
    assert sizes == [(16, 22)]
    assert matrix.counts.sum() == 46 * 64
    assert 0.8 < mean_iou(matrix) < 1


def test_a_label_without_truth_does_not_count(toy_pairs):
    labels = toy_pairs().label_set
    matrix = ConfusionMatrix(labels, labels, np.array([[6, 0, 2], [2, 2, 0], [0, 0, 0]]))
    ious = label_ious(matrix)
    assert ious["dark"] == pytest.approx(6 / 10)
    assert ious["middle"] == pytest.approx(2 / 4)
    assert np.isnan(ious["bright"])
    assert mean_iou(matrix) == pytest.approx(0.55)


def test_masks_without_a_labelled_pixel_are_refused(toy_pairs):
    labels = toy_pairs().label_set
    with pytest.raises(ConfigError, match="no labelled pixel"):
        mean_iou(ConfusionMatrix(labels, labels, np.zeros((3, 3))))


def test_a_wrong_id_is_named_with_its_file(toy_pairs):
    class Wrong(toy_pairs):
        def read(self, index):
            rgb, ids = super().read(index)
            ids[5, 5] = 9
            return rgb, ids

    augmentation = Augmentation()
    with pytest.raises(LabelError, match=r"toy image 1: .*label id 9"):
        confusion_on(ByBrightness(augmentation), Wrong(), [1], augmentation, CPU)
