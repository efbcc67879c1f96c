"""Vistas, Cityscapes and CamVid in their own layouts, made small; and what is wrong with a folder."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hdmap_tools.errors import ConfigError, ImageError, LabelError
from hdmap_tools.labels.label_set import IGNORE_ID, load_label_set
from hdmap_tools.segmentation.label_png import write_label_png
from hdmap_tools.segmentation.training.labelled_files import read_palette_png
from hdmap_tools.segmentation.training.pairs import (
    ImagePairs,
    open_camvid,
    open_cityscapes,
    open_pairs,
    open_vistas,
    relabelled,
)

HEIGHT, WIDTH = 12, 20


def write_image(path: Path, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """A PNG or JPEG whose colours tell the channels apart; returns its RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rgb = np.full((height, width, 3), (200, 100, 20), dtype=np.uint8)
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))
    return rgb


def write_palette(path: Path, ids: np.ndarray) -> None:
    """As Vistas' labels are: indices into colours, of which two may be the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.frombytes("P", ids.shape[::-1], ids.tobytes())
    image.putpalette([7, 7, 7] * 256)
    image.save(path)


def ids_up_to(count: int, seed: int = 0) -> np.ndarray:
    ids = np.random.default_rng(seed).integers(0, count, (HEIGHT, WIDTH), dtype=np.uint8)
    ids.flat[:2] = 0, count - 1
    return ids


@pytest.fixture
def vistas(tmp_path: Path) -> Path:
    """Three images with the labels of both versions, as version 2.0 is handed out."""
    for key in "abc":
        write_image(tmp_path / "training" / "images" / f"{key}.jpg")
        for name, count in (("v1.2", 66), ("v2.0", 124)):
            folder = tmp_path / "training" / name / "labels"
            write_palette(folder / f"{key}.png", ids_up_to(count, ord(key)))
    return tmp_path


@pytest.fixture
def cityscapes(tmp_path: Path) -> Path:
    for city, number in (("aachen", 1), ("aachen", 2), ("bochum", 1)):
        stem = f"{city}_00000{number}_000019"
        write_image(tmp_path / "leftImg8bit" / "train" / city / f"{stem}_leftImg8bit.png")
        folder = tmp_path / "gtFine" / "train" / city
        write_label_png(folder / f"{stem}_gtFine_labelIds.png", ids_up_to(34, number))
        write_label_png(folder / f"{stem}_gtFine_instanceIds.png", ids_up_to(200, number))
    return tmp_path


@pytest.fixture
def camvid(tmp_path: Path) -> Path:
    for stem in ("0001TP_1", "0001TP_2"):
        write_image(tmp_path / "train" / f"{stem}.png")
        write_label_png(tmp_path / "trainannot" / f"{stem}.png", ids_up_to(12))
    return tmp_path


def check(pairs: ImagePairs, label_set: str, expected: np.ndarray) -> None:
    assert pairs.label_set == load_label_set(label_set)
    rgb, ids = pairs.read(0)
    assert (rgb.shape, rgb.dtype) == ((HEIGHT, WIDTH, 3), np.uint8)
    assert np.abs(rgb.astype(int) - (200, 100, 20)).max() < 6
    assert ids.dtype == np.uint8
    np.testing.assert_array_equal(ids, expected)
    again = pickle.loads(pickle.dumps(pairs))
    np.testing.assert_array_equal(again.read(len(pairs) - 1)[1], pairs.read(len(pairs) - 1)[1])


def test_vistas_of_both_versions(vistas: Path) -> None:
    assert len(open_vistas(vistas)) == 3
    check(open_vistas(vistas), "mapillary-vistas-66", ids_up_to(66, ord("a")))
    check(open_vistas(vistas, version="2.0"), "mapillary-vistas-124", ids_up_to(124, ord("a")))
    for spec in ("vistas", "vistas-v2"):
        for tail in ("", ":training"):
            assert len(open_pairs(f"{spec}:{vistas}{tail}")) == 3
    assert open_pairs(f"vistas-v2:{vistas}").label_set.name == "mapillary-vistas-124"


def test_vistas_as_version_1_is_handed_out(vistas: Path) -> None:
    (vistas / "training" / "v1.2" / "labels").rename(vistas / "training" / "labels")
    check(open_vistas(vistas, "training"), "mapillary-vistas-66", ids_up_to(66, ord("a")))
    (vistas / "training").rename(vistas / "validation")
    check(open_vistas(vistas, "validation"), "mapillary-vistas-66", ids_up_to(66, ord("a")))
    with pytest.raises(ConfigError, match=r"There is no folder .*training.images; expected Mapill"):
        open_vistas(vistas)


def test_vistas_with_its_own_list_of_labels(vistas: Path) -> None:
    for name, label_set in (("config_v1.2.json", 66), ("config_v2.0.json", 124)):
        names = load_label_set(f"mapillary-vistas-{label_set}").names
        document = {"labels": [{"name": n, "readable": n} for n in names]}
        (vistas / name).write_text(json.dumps(document))
    assert len(open_vistas(vistas)) == len(open_vistas(vistas, version="2.0")) == 3
    # The order of the traffic lights is the one thing that is not certain.
    lights = slice(names.index("object--traffic-light--general-single"), 96)
    document["labels"][lights] = document["labels"][lights][::-1]
    (vistas / "config_v2.0.json").write_text(json.dumps(document))
    assert len(open_vistas(vistas, version="2.0")) == 3
    document["labels"][5]["name"] = "construction--barrier--hedge"
    (vistas / "config_v2.0.json").write_text(json.dumps(document))
    with pytest.raises(LabelError, match=r"number 5 is 'construction--barrier--hedge', expected '"):
        open_vistas(vistas, version="2.0")
    (vistas / "config_v1.2.json").write_text(json.dumps({"labels": document["labels"][:30]}))
    with pytest.raises(LabelError, match="has 30 labels, expected the 66"):
        open_vistas(vistas)
    (vistas / "config_v1.2.json").write_text('{"labels": [1]}')
    with pytest.raises(ConfigError, match=r"config_v1\.2\.json is not the list of labels"):
        open_vistas(vistas)


def test_vistas_with_a_wrong_version(vistas: Path) -> None:
    with pytest.raises(ConfigError, match=r"'1\.1' is unknown"):
        open_vistas(vistas, version="1.1")
    (vistas / "training" / "v2.0").rename(vistas / "training" / "other")
    with pytest.raises(ConfigError, match=r"no folder of labels .*v2\.0.labels"):
        open_vistas(vistas, version="2.0")


def test_cityscapes(cityscapes: Path) -> None:
    pairs = open_cityscapes(cityscapes)
    assert len(pairs) == 3
    check(pairs, "cityscapes-ids", ids_up_to(34, 1))
    assert "bochum" in pairs.describe(2)
    check(open_pairs(f"cityscapes:{cityscapes}:train"), "cityscapes-ids", ids_up_to(34, 1))
    with pytest.raises(
        ConfigError, match=r"There is no folder .*leftImg8bit.val; expected Cityscap"
    ):
        open_cityscapes(cityscapes, "val")


def test_camvid_void_is_not_judged(camvid: Path) -> None:
    expected = ids_up_to(12)
    assert (expected == 11).any()
    expected[expected == 11] = IGNORE_ID
    check(open_camvid(camvid), "camvid-11", expected)
    check(open_pairs(f"camvid:{camvid}"), "camvid-11", expected)
    with pytest.raises(ConfigError, match=r"There is no folder .*val; expected CamVid"):
        open_camvid(camvid, "val")


def test_camvid_in_colours(tmp_path: Path) -> None:
    label_set = load_label_set("camvid-32")
    ids = ids_up_to(32)
    write_image(tmp_path / "701_StillsRaw_full" / "0001TP_1.png")
    label = tmp_path / "LabeledApproved_full" / "0001TP_1_L.png"
    label.parent.mkdir()
    colours = label_set.colors[ids]
    cv2.imwrite(str(label), np.ascontiguousarray(colours[..., ::-1]))
    expected = np.where(ids == label_set.id_of("Void"), IGNORE_ID, ids)
    check(open_pairs(f"camvid-32:{tmp_path}"), "camvid-32", expected)
    street = relabelled(open_pairs(f"camvid-32:{tmp_path}"), "street").read(0)[1]
    paint = np.isin(ids, [label_set.id_of(n) for n in ("LaneMkgsDriv", "LaneMkgsNonDriv")])
    np.testing.assert_array_equal(street == load_label_set("street").id_of("lane marking"), paint)
    for wrong in ((128, 64, 130), (0, 64, 0)):
        colours[3, 4] = wrong
        cv2.imwrite(str(label), np.ascontiguousarray(colours[..., ::-1]))
        with pytest.raises(
            LabelError,
            match=rf"_L\.png has the colour \({wrong[0]}, {wrong[1]}, {wrong[2]}\) \(1 pixels",
        ):
            open_pairs(f"camvid-32:{tmp_path}").read(0)


Damage = Callable[[Path, Path], None]


def smaller(image: Path, label: Path) -> None:
    write_image(image, HEIGHT - 1, WIDTH)


def foreign_id(image: Path, label: Path) -> None:
    write_label_png(label, np.full((HEIGHT, WIDTH), 200, np.uint8))


def truncated_image(image: Path, label: Path) -> None:
    image.write_bytes(image.read_bytes()[:-30])


def truncated_label(image: Path, label: Path) -> None:
    label.write_bytes(label.read_bytes()[:-10])


def no_image(image: Path, label: Path) -> None:
    image.unlink()


def no_label(image: Path, label: Path) -> None:
    label.unlink()


def colours(image: Path, label: Path) -> None:
    write_image(label)


def text(image: Path, label: Path) -> None:
    label.write_text("no picture")


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (smaller, ImageError, r"Image .* is 20x11 pixels, but its labels .* are 20x12"),
        (foreign_id, LabelError, r"Label image .* holds label id 200 \(240 pixels"),
        (truncated_image, ImageError, r"Image .* is damaged"),
        (truncated_label, ImageError, r"Label image .* is damaged"),
        (no_image, ImageError, r"Image .* cannot be read \(No such file"),
        (no_label, ImageError, r"Label image .* is missing"),
        (colours, ImageError, r"Label image .* is a .*RGB"),
        (text, ImageError, r"Label image .* (is not a PNG|does not decode)"),
    ],
)
@pytest.mark.parametrize("kind", ["vistas", "cityscapes", "camvid"])
def test_a_bad_pair_is_named_when_it_is_read(
    kind: str, damage: Damage, error: type[Exception], message: str, request: pytest.FixtureRequest
) -> None:
    pairs = open_pairs(f"{kind}:{request.getfixturevalue(kind)}")
    image, label = pairs.files[1]  # type: ignore[attr-defined]
    damage(image, label)
    pairs.read(0)
    with pytest.raises(error, match=message) as caught:
        pairs.read(1)
    assert str(image) in str(caught.value) or str(label) in str(caught.value)
    assert str(image) in pairs.describe(1)
    assert str(label) in pairs.describe(1)
    with pytest.raises(error, match=message):
        relabelled(pairs, "street").read(1)


@pytest.mark.parametrize("kind", ["vistas", "cityscapes", "camvid"])
def test_a_missing_label_is_told_before_training_begins(
    kind: str, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(kind)
    files = open_pairs(f"{kind}:{folder}").files  # type: ignore[attr-defined]
    files[1][1].unlink()
    with pytest.raises(ImageError, match=f"1 of {len(files)} images have no label file") as caught:
        open_pairs(f"{kind}:{folder}")
    assert str(files[1][1]) in str(caught.value)
    for image, _ in files:
        image.unlink()
    with pytest.raises(ConfigError, match="There are no images in"):
        open_pairs(f"{kind}:{folder}")


def test_palette_labels_are_indices_not_colours(tmp_path: Path) -> None:
    ids = ids_up_to(256)
    write_palette(tmp_path / "p.png", ids)
    np.testing.assert_array_equal(read_palette_png(tmp_path / "p.png"), ids)
    write_label_png(tmp_path / "g.png", ids)
    np.testing.assert_array_equal(read_palette_png(tmp_path / "g.png"), ids)
    few = ids_up_to(3)
    write_palette(tmp_path / "few.png", few)
    with Image.open(tmp_path / "few.png") as image:
        image.save(tmp_path / "packed.png", bits=2)
    np.testing.assert_array_equal(read_palette_png(tmp_path / "packed.png"), few)
    Image.fromarray(ids.astype(np.uint16) * 256).save(tmp_path / "instances.png")
    with pytest.raises(ImageError, match=r"instances\.png is a PNG of mode I;16"):
        read_palette_png(tmp_path / "instances.png")


@pytest.mark.realdata
def test_real_camvid(data_root: Path) -> None:
    pairs = open_camvid(data_root / "camvid")
    assert len(pairs) == 10
    street = relabelled(pairs, "street")
    names = street.label_set.names
    pixels = np.zeros(256, dtype=np.int64)
    for index in range(len(pairs)):
        rgb, ids = street.read(index)
        assert rgb.shape == (360, 480, 3)
        pixels += np.bincount(ids.reshape(-1), minlength=256)
        # The sky is bright and above the road, if both the labels and their order are right.
        rows = np.indices(ids.shape)[0]
        sky, road = ids == names.index("sky"), ids == names.index("road")
        assert rows[sky].mean() < rows[road].mean() - 100
        assert rgb[sky].mean() > rgb[road].mean() + 50
    assert pixels[names.index("road")] > 0.2 * pixels.sum()
    for absent in ("crosswalk", "lane marking", "curb"):
        assert pixels[names.index(absent)] == 0


@pytest.mark.realdata
def test_a_real_list_of_vistas_labels_is_accepted(vistas: Path, data_root: Path) -> None:
    config = (data_root / "mapillary_vistas" / "config.json").read_bytes()
    (vistas / "config.json").write_bytes(config)
    assert len(open_vistas(vistas)) == 3
    with pytest.raises(LabelError, match="has 66 labels, expected the 124"):
        open_vistas(vistas, version="2.0")
