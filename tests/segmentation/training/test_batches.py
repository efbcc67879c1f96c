"""Batches follow from seed and step alone."""

import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from hdmap_tools.errors import LabelError  # noqa: E402
from hdmap_tools.segmentation.training.augmentation import Augment, Augmentation  # noqa: E402
from hdmap_tools.segmentation.training.batches import Batches, Kept, indices_of_step  # noqa: E402
from hdmap_tools.segmentation.training.class_weights import class_weights  # noqa: E402

AUGMENT = Augment(Augmentation(crop_px=32, scale=(0.8, 1.25), noise=0.05))


@pytest.mark.parametrize(("batch", "number"), [(4, 8), (3, 7), (5, 2)])
def test_every_image_comes_once_an_epoch(batch, number):
    steps = [indices_of_step(step, batch, number, 0) for step in range(3 * number)]
    stream = np.concatenate(steps)
    epochs = stream[: len(stream) // number * number].reshape(-1, number)
    assert (np.sort(epochs, axis=1) == np.arange(number)).all()
    if number > 5:
        assert len({tuple(epoch) for epoch in epochs}) > len(epochs) // 2  # not one order for all


def test_another_seed_gives_another_order():
    a, b = (indices_of_step(0, 50, 50, seed) for seed in (0, 1))
    assert (a != b).any()


def taken(batches, step, number):
    stream = batches.from_step(step)
    try:
        return list(itertools.islice(stream, number))
    finally:
        stream.close()


@pytest.mark.parametrize("workers", [0, 2])
def test_going_on_gives_what_would_have_come(toy_pairs, workers):
    whole = taken(Batches(toy_pairs(), AUGMENT, 4, 3, workers=0), 0, 5)
    rest = taken(Batches(toy_pairs(), AUGMENT, 4, 3, workers=workers), 2, 3)
    for (image, ids), (again, ids_again) in zip(whole[2:], rest, strict=True):
        assert torch.equal(image, again)
        assert torch.equal(ids, ids_again)
    assert not torch.equal(whole[0][0], whole[2][0])  # an epoch later: other crops


def test_processes_share_a_batch_without_overlap(toy_pairs):
    (whole,) = taken(Batches(toy_pairs(), AUGMENT, 4, 3), 1, 1)
    parts = [
        taken(Batches(toy_pairs(), AUGMENT, 4, 3, rank=rank, world=2), 1, 1)[0] for rank in (0, 1)
    ]
    for k in (0, 1):
        assert torch.equal(whole[k][0::2], parts[0][k])
        assert torch.equal(whole[k][1::2], parts[1][k])


@pytest.mark.parametrize("workers", [0, 1])
def test_a_mask_with_a_wrong_id_is_named(toy_pairs, workers):
    class Wrong(toy_pairs):
        def read(self, index):
            rgb, ids = super().read(index)
            if index == 5:
                ids[10, 10] = 3
            return rgb, ids

    with pytest.raises(LabelError, match=r"toy image 5 holds label id 3"):
        taken(Batches(Wrong(), AUGMENT, 4, 3, workers=workers), 0, 2)


def test_rare_labels_weigh_more_and_the_mean_pixel_weighs_one(toy_pairs):
    pairs = toy_pairs()
    counts = sum(np.bincount(pairs.read(k)[1].ravel(), minlength=256)[:3] for k in range(8))
    for power in (0.25, 1.0):
        weights = class_weights(pairs, power, 0)
        assert (weights * counts).sum() / counts.sum() == pytest.approx(1)
        assert weights[0] / weights[1] == pytest.approx((counts[1] / counts[0]) ** power)
    assert (class_weights(pairs, 0, 0) == 1).all()


def test_a_label_that_never_occurs_weighs_as_the_rarest_that_does(toy_pairs):
    class Dark(toy_pairs):
        def read(self, index):
            rgb, ids = super().read(index)
            ids[ids == 2] = 1
            return rgb, ids

    weights = class_weights(Dark(), 0.5, 0)
    assert np.isfinite(weights).all()
    assert weights[2] == weights[1]


class Counted:
    """Pairs that know how often they were read."""

    name, label_set = "counted", None

    def __init__(self, number):
        self.reads = [0] * number

    def __len__(self):
        return len(self.reads)

    def read(self, index):
        self.reads[index] += 1
        return np.full((10, 10, 3), index, np.uint8), np.full((10, 10), index, np.uint8)

    def describe(self, index):
        return f"number {index}"


def test_what_fits_stays_in_memory():
    pairs = Counted(5)
    kept = Kept(pairs, 2 * 400 + 399)
    for _ in range(3):
        for index in range(5):
            rgb, ids = kept.read(index)
            assert (rgb == index).all()
            assert (ids == index).all()
    assert pairs.reads == [1, 1, 3, 3, 3]
    assert (len(kept), kept.name, kept.describe(2)) == (5, "counted", "number 2")
    with pytest.raises(ValueError, match="read-only"):
        kept.read(0)[0][:] = 0
