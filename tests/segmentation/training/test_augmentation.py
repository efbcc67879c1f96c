"""Augmentation: image and labels stay on one another, and a seed gives one result."""

import numpy as np
import pytest
from pydantic import ValidationError

from hdmap_tools.errors import ShapeError
from hdmap_tools.labels.label_set import IGNORE_ID

torch = pytest.importorskip("torch")
pytest.importorskip("torchvision")

from hdmap_tools.segmentation.training.augmentation import Augment, Augmentation  # noqa: E402

PLAIN = Augmentation(flip=0.0, scale=(1.0, 1.0), crop_px=64)


def scene(height: int = 150, width: int = 220, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Areas of five labels, at least eight pixels wide, and an image whose red is 40 times the label."""
    import cv2

    rng = np.random.default_rng(seed)
    coarse = rng.random((height // 40, width // 40)).astype(np.float32)
    ids = (cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR) * 5).clip(0, 5)
    ids = ids.astype(np.uint8)
    rgb = np.stack([ids * 40, np.full_like(ids, 90), np.full_like(ids, 200)], axis=-1)
    return rgb, ids


def unnormalized(image: "torch.Tensor", settings: Augmentation) -> np.ndarray:
    mean, std = np.array(settings.mean), np.array(settings.std)
    return (image.permute(1, 2, 0).numpy() * std + mean) * 255


def test_the_papers_settings_are_the_defaults() -> None:
    paper = Augmentation()
    assert (paper.flip, paper.scale, paper.crop_px) == (0.5, (0.5, 2.0), 640)
    assert (paper.mean, paper.std) == ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    assert not any(
        (paper.brightness, paper.contrast, paper.saturation, paper.white_balance, paper.blur_px)
    )
    assert paper.noise == 0


def test_at_scale_one_the_crop_is_a_piece_of_the_image() -> None:
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (90, 100, 3), dtype=np.uint8)
    ids = rng.integers(0, 5, (90, 100), dtype=np.uint8)
    image, labels = Augment(PLAIN)(rgb, ids, 7)
    assert (image.shape, image.dtype) == ((3, 64, 64), torch.float32)
    assert (labels.shape, labels.dtype) == ((64, 64), torch.int64)
    given = np.rint(unnormalized(image, PLAIN)).astype(np.uint8)
    fits = [
        (top, left)
        for top in range(27)
        for left in range(37)
        if np.array_equal(rgb[top : top + 64, left : left + 64], given)
    ]
    assert len(fits) == 1
    top, left = fits[0]
    np.testing.assert_array_equal(labels.numpy(), ids[top : top + 64, left : left + 64])


@pytest.mark.parametrize("scale", [0.5, 0.63, 0.8, 1.0, 1.37, 2.0])
@pytest.mark.parametrize("flip", [0.0, 1.0])
def test_labels_stay_on_the_image_at_every_scale(scale: float, flip: float) -> None:
    import cv2

    settings = Augmentation(flip=flip, scale=(scale, scale), crop_px=96)
    augment = Augment(settings)
    for seed in range(6):
        rgb, ids = scene(seed=seed)
        image, labels = augment(rgb, ids, seed)
        found = labels.numpy().astype(np.uint8)
        red = unnormalized(image, settings)[..., 0] / 40
        # Away from edges nothing is blended; padding has no edge that counts.
        square = np.ones((5, 5), np.uint8)
        inside = (cv2.erode(found, square) == cv2.dilate(found, square)) & (found != IGNORE_ID)
        assert inside.sum() > 300
        np.testing.assert_allclose(red[inside], found[inside], atol=0.02)
        # At an edge a blend of two neighbours, never a third.
        judged = found != IGNORE_ID
        assert np.abs(red - found)[judged].max() < 1.01


@pytest.mark.parametrize("scale", [0.55, 0.7, 0.9, 1.9])
def test_no_edge_moves_to_one_side(scale: float) -> None:
    """Stripes: where the image's brightness crosses the half, the label changes, on average."""
    width = 400
    columns = np.arange(width)
    ids = np.broadcast_to(((columns + 3) // 23 % 2).astype(np.uint8), (160, width)).copy()
    rgb = np.repeat((ids * 200)[..., None], 3, axis=2)
    settings = Augmentation(flip=0.0, scale=(scale, scale), crop_px=128)
    shifts = []
    for seed in range(40):
        image, labels = Augment(settings)(rgb, ids, seed)
        inside = labels.numpy() != IGNORE_ID
        judged, row = inside.any(axis=0), int(np.flatnonzero(inside.any(axis=1))[0])
        bright = unnormalized(image, settings)[row, judged, 0] / 200
        label = labels[row].numpy()[judged]
        # Only rising edges: with the falling ones a shift would cancel.
        for edge in np.flatnonzero(np.diff(label) > 0):
            near = slice(max(edge - 4, 0), edge + 6)
            if len(bright[near]) == 10:
                shifts.append(float(bright[near].sum() - label[near].sum()))
    assert len(shifts) > 50
    # Three standard errors of that many edges anywhere within a pixel; torchvision's own
    # way with masks is 0.45 to 0.51 off.
    assert abs(np.mean(shifts)) < 3 * 0.29 / np.sqrt(50) + 0.05


def test_what_an_image_lacks_is_the_mean_colour_and_not_judged() -> None:
    rgb, ids = scene(60, 80)
    settings = Augmentation(flip=0.0, scale=(0.5, 0.5), crop_px=64)
    image, labels = Augment(settings)(rgb, ids, 3)
    judged = labels.numpy() != IGNORE_ID
    assert judged.sum() == 30 * 40
    rows, columns = np.flatnonzero(judged.any(axis=1)), np.flatnonzero(judged.any(axis=0))
    assert (len(rows), len(columns)) == (30, 40)
    assert judged[np.ix_(rows, columns)].all()
    outside = image.permute(1, 2, 0).numpy()[~judged]
    assert len(outside) == 64 * 64 - 1200
    assert not outside.any()


def test_the_place_of_a_small_image_and_of_a_crop_is_left_to_chance() -> None:
    rgb, ids = scene(60, 300)
    settings = Augmentation(flip=0.0, scale=(1.0, 1.0), crop_px=64)
    tops, lefts = set(), set()
    for seed in range(60):
        _, labels = Augment(settings)(rgb, ids, seed)
        judged = labels.numpy() != IGNORE_ID
        tops.add(int(np.flatnonzero(judged.any(axis=1))[0]))
        lefts.add(labels.numpy().tobytes())
    assert tops == set(range(5))
    assert len(lefts) > 50


def test_half_of_the_images_are_mirrored() -> None:
    ids = np.zeros((64, 64), dtype=np.uint8)
    ids[:, 40:] = 1
    rgb = np.repeat((ids * 255)[..., None], 3, axis=2)
    augment = Augment(Augmentation(flip=0.5, scale=(1.0, 1.0), crop_px=64))
    mirrored = 0
    for seed in range(200):
        image, labels = augment(rgb, ids, seed)
        np.testing.assert_array_equal(image[0].numpy() > 0, labels.numpy() == 1)
        mirrored += int(labels[0, 0])
    assert 70 < mirrored < 130  # 4 sigma of 200 throws


def test_scales_fill_their_range_evenly() -> None:
    """What is judged of the crop is the whole image at the scale drawn."""
    rgb, ids = scene_of(100, 100)
    augment = Augment(Augmentation(flip=0.0, scale=(0.5, 2.0), crop_px=220))
    sides = [np.sqrt(float((augment(rgb, ids, seed)[1] == 0).sum())) / 100 for seed in range(300)]
    assert min(sides) < 0.56
    assert max(sides) > 1.94
    assert np.mean(sides) == pytest.approx(1.25, abs=0.1)


def test_a_long_side_makes_images_of_all_sizes_alike() -> None:
    settings = Augmentation(flip=0.0, scale=(1.0, 1.0), crop_px=200, long_side_px=100)
    for height, width in ((150, 300), (600, 1200), (20, 40)):
        _, labels = Augment(settings)(*scene_of(height, width), 0)
        assert int((labels != IGNORE_ID).sum()) == 100 * 50


def scene_of(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8)


COLOURFUL = Augmentation(
    crop_px=96,
    brightness=0.3,
    contrast=0.3,
    saturation=0.3,
    white_balance=0.1,
    blur_px=1.5,
    noise=0.05,
)


def test_a_seed_gives_one_result_and_another_seed_another() -> None:
    rgb, ids = scene()
    augment, again = Augment(COLOURFUL), Augment(COLOURFUL)
    torch.manual_seed(1)
    first = augment(rgb, ids, 11)
    torch.manual_seed(2)
    np.random.random()  # noqa: NPY002, RUF100 - the global state must not matter
    augment(rgb, ids, 5)
    second = again(rgb, ids, np.random.default_rng(11))
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
    assert not torch.equal(first[0], augment(rgb, ids, 12)[0])


def test_the_inputs_stay_as_they_were() -> None:
    rgb, ids = scene()
    before = rgb.copy(), ids.copy()
    rgb.setflags(write=False)
    ids.setflags(write=False)
    for seed in range(5):
        Augment(COLOURFUL)(rgb, ids, seed)
    np.testing.assert_array_equal(rgb, before[0])
    np.testing.assert_array_equal(ids, before[1])


def test_colours_change_and_labels_do_not() -> None:
    rgb, ids = scene()
    plain = Augment(
        COLOURFUL.model_copy(
            update=dict.fromkeys(
                ("brightness", "contrast", "saturation", "white_balance", "blur_px", "noise"), 0.0
            )
        )
    )
    changed = 0
    for seed in range(20):
        image, labels = Augment(COLOURFUL)(rgb, ids, seed)
        same, same_labels = plain(rgb, ids, seed)
        pixels = unnormalized(image, COLOURFUL)
        assert pixels.min() > -0.01
        assert pixels.max() < 255.01
        assert int((labels != IGNORE_ID).sum()) == int((same_labels != IGNORE_ID).sum())
        changed += not torch.equal(image, same)
    assert changed >= 19


@pytest.mark.parametrize(
    ("name", "statistic", "low", "high"),
    [
        ("brightness", lambda p: p.mean() / 100, 0.7, 1.3),
        ("contrast", lambda p: p.std() / 40, 0.7, 1.3),
        ("noise", lambda p: p.std() / 40, 1.0, 1.5),
    ],
)
def test_each_change_does_what_it_is_named_for(name, statistic, low: float, high: float) -> None:
    """Grey of mean 100 and deviation 40, in halves of 60 and 140."""
    rgb = np.full((64, 64, 3), 60, dtype=np.uint8)
    rgb[:, ::2] = 140
    ids = np.zeros((64, 64), dtype=np.uint8)
    settings = PLAIN.model_copy(update={name: 0.3, "colour_probability": 1.0})
    found = []
    for seed in range(100):
        pixels = unnormalized(Augment(settings)(rgb, ids, seed)[0], settings)
        found.append(statistic(pixels))
        if name == "contrast":
            assert pixels.mean() == pytest.approx(100, abs=0.01)
    assert low - 1e-3 <= min(found) < low + 0.1
    assert max(found) > high - 0.1
    if name != "noise":
        assert max(found) <= high + 1e-3


def test_saturation_spares_grey_and_white_balance_tints_it() -> None:
    rgb, ids = np.full((64, 64, 3), 120, dtype=np.uint8), np.zeros((64, 64), dtype=np.uint8)
    kept = PLAIN.model_copy(update={"saturation": 1.0, "colour_probability": 1.0})
    tinted = PLAIN.model_copy(update={"white_balance": 0.2, "colour_probability": 1.0})
    for seed in range(5):
        np.testing.assert_allclose(
            unnormalized(Augment(kept)(rgb, ids, seed)[0], kept), 120, atol=1e-3
        )
        colour = unnormalized(Augment(tinted)(rgb, ids, seed)[0], tinted)[0, 0] / 120
        assert np.ptp(colour) > 0.01
        assert np.all(np.abs(colour - 1) <= 0.2 + 1e-6)


@pytest.mark.parametrize(
    ("rgb", "ids"),
    [
        (np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4), np.uint8)),
        (np.zeros((4, 5), np.uint8), np.zeros((4, 5), np.uint8)),
        (np.zeros((4, 5, 3), np.float32), np.zeros((4, 5), np.uint8)),
        (np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), np.int64)),
        (np.zeros((0, 5, 3), np.uint8), np.zeros((0, 5), np.uint8)),
    ],
)
def test_images_and_labels_that_do_not_fit_are_refused(rgb, ids) -> None:
    with pytest.raises(ShapeError):
        Augment(PLAIN)(rgb, ids, 0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"flip": 1.5},
        {"scale": (2.0, 0.5)},
        {"scale": (0.0, 1.0)},
        {"crop_px": 0},
        {"std": (0.0, 1.0, 1.0)},
        {"noise": float("nan")},
        {"hue": 0.1},
    ],
)
def test_settings_without_sense_are_refused(wrong) -> None:
    with pytest.raises(ValidationError):
        Augmentation(**wrong)


def test_of_several_crops_the_one_with_the_most_even_mix_of_labels_is_taken():
    rgb = np.zeros((60, 400, 3), np.uint8)
    ids = np.zeros((60, 400), np.uint8)
    ids[:, 300:] = np.arange(100) // 10  # ten labels at one end, one label elsewhere
    shares = []
    for tried in (1, 16):
        augment = Augment(Augmentation(flip=0, scale=(1, 1), crop_px=60, windows_tried=tried))
        labels = [len(np.unique(augment(rgb, ids, seed)[1])) for seed in range(60)]
        shares.append(np.mean(np.array(labels) > 3))
    assert shares[0] < 0.4
    assert shares[1] > 0.85
