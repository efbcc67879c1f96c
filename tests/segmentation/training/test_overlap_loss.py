"""The soft overlap against a count of pixels."""

import pytest

torch = pytest.importorskip("torch")

from hdmap_tools.labels.label_set import IGNORE_ID  # noqa: E402
from hdmap_tools.segmentation.training.overlap_loss import overlap_loss  # noqa: E402


def certain(ids, num_labels):
    """Logits of a network that is sure of these."""
    return 100.0 * torch.nn.functional.one_hot(ids, num_labels).permute(0, 3, 1, 2).float()


def test_certain_predictions_give_the_dice_of_their_pixels():
    torch.manual_seed(1)
    truth, said = torch.randint(0, 4, (2, 2, 9, 11))
    dice = [
        2 * ((truth == k) & (said == k)).sum() / ((truth == k).sum() + (said == k).sum())
        for k in range(4)
    ]
    expected = 1 - torch.stack(dice).mean()
    assert overlap_loss(certain(said, 4), truth).item() == pytest.approx(expected.item(), abs=1e-6)


def test_labels_that_are_not_there_and_pixels_that_are_not_judged_do_not_count():
    truth = torch.tensor([[[0, 0, 1, IGNORE_ID]]])
    said = torch.tensor([[[0, 0, 1, 2]]])
    assert overlap_loss(certain(said, 3), truth).item() == pytest.approx(0.0, abs=1e-6)


def test_a_label_of_one_pixel_counts_as_much_as_one_of_many():
    truth = torch.zeros((1, 1, 100), dtype=torch.int64)
    truth[..., 0] = 1
    missed = overlap_loss(certain(torch.zeros_like(truth), 2), truth).item()
    assert missed == pytest.approx(1 - (2 * 99 / 199) / 2, abs=1e-6)


def test_its_gradient_leads_to_the_truth():
    torch.manual_seed(2)
    truth = torch.randint(0, 3, (1, 8, 8))
    logits = torch.zeros((1, 3, 8, 8), requires_grad=True)
    for _ in range(200):
        loss = overlap_loss(logits, truth)
        (gradient,) = torch.autograd.grad(loss, logits)
        logits = (logits - 50 * gradient).detach().requires_grad_(True)
    assert (logits.argmax(dim=1) == truth).all()
