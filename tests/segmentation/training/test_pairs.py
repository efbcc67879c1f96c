"""Pairs of images and labels: brought onto one set, joined, opened from drives and by name."""

import json
import logging
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.errors import ConfigError, DriveError, ImageError, LabelError
from hdmap_tools.labels.label_set import IGNORE_ID, LabelSet, load_label_set
from hdmap_tools.segmentation.label_png import read_label_png, write_label_png
from hdmap_tools.segmentation.training.pairs import joined, open_drives, open_pairs, relabelled


class Fake:
    """Pairs in memory: pixel (0, 0) of the image is its number."""

    def __init__(self, name: str, count: int, label_set: str = "paz2020", first: int = 0) -> None:
        self.name, self.count, self.first = name, count, first
        self.label_set: LabelSet = load_label_set(label_set)

    def __len__(self) -> int:
        return self.count

    def read(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        ids = np.arange(20, dtype=np.uint8).reshape(4, 5)
        ids[-1, -1] = IGNORE_ID
        return np.full((4, 5, 3), self.first + index, np.uint8), ids

    def describe(self, index: int) -> str:
        return f"{self.name} {index}"


def test_joined_pairs_follow_each_other() -> None:
    pairs = joined([Fake("a", 3), Fake("b", 0), Fake("c", 2, first=3)])
    assert len(pairs) == 5
    assert pairs.name == "a + b + c"
    assert [int(pairs.read(i)[0][0, 0, 0]) for i in range(5)] == [0, 1, 2, 3, 4]
    assert [pairs.describe(i) for i in range(5)] == ["a 0", "a 1", "a 2", "c 0", "c 1"]
    for outside in (-1, 5):
        with pytest.raises(IndexError, match="There are 5 pairs"):
            pairs.read(outside)
    assert len(pickle.loads(pickle.dumps(pairs))) == 5


def test_joining_refuses_nothing_and_two_label_sets() -> None:
    with pytest.raises(LabelError, match="no images to train on"):
        joined([])
    with pytest.raises(LabelError, match=r"a has label set 'paz2020' and b has 'street'"):
        joined([Fake("a", 1), Fake("b", 1, "street")])
    both = joined([relabelled(Fake("a", 1), "street"), Fake("b", 1, "street")])
    assert both.label_set.name == "street"


def test_relabelling_looks_each_id_up() -> None:
    pairs = relabelled(Fake("a", 1), "street")
    assert pairs.label_set == load_label_set("street")
    source, target = load_label_set("paz2020"), load_label_set("street")
    _, ids = pairs.read(0)
    assert ids.dtype == np.uint8
    assert ids[0, 0] == target.id_of("curb")
    flat = ids.reshape(-1)
    assert flat[source.id_of("manhole")] == target.id_of("road")
    assert flat[source.id_of("traffic sign")] == target.id_of("pole")
    assert flat[19] == IGNORE_ID
    assert pairs.describe(0) == "a 0"
    same = Fake("a", 1, "street")
    assert relabelled(same, "street") is same
    with pytest.raises(LabelError, match="No mapping from label set 'street' to 'paz2020'"):
        relabelled(same, "paz2020")


def num_images(drive: Path) -> int:
    number = len(list(drive.glob("sensors/cameras/*/*.jpg")))
    assert number > 2
    return number


def test_a_simulated_drive_has_its_own_labels(simulated_drive: Path) -> None:
    pairs = open_drives([simulated_drive])
    assert len(pairs) == num_images(simulated_drive)
    assert pairs.label_set == load_label_set("paz2020")
    truth = simulated_drive / "truth" / "label_images"
    stamps = sorted(path for path in truth.glob("*/*.png"))
    for index, path in enumerate(stamps):
        rgb, ids = pairs.read(index)
        assert rgb.shape == (300, 480, 3)
        np.testing.assert_array_equal(ids, read_label_png(path))
        assert path.stem in pairs.describe(index)
    # The label images belong to these images: what is called sky is the sky's colour.
    rgb, ids = relabelled(pairs, "street").read(0)
    sky = rgb[ids == load_label_set("street").id_of("sky")].astype(float)
    road = rgb[ids == load_label_set("street").id_of("road")].astype(float)
    assert len(sky) > 1000
    assert (sky[:, 2] - sky[:, 0]).mean() > (road[:, 2] - road[:, 0]).mean() + 5


def test_a_folder_of_drives_is_all_of_them(simulated_drive: Path, tmp_path: Path) -> None:
    for name in ("two", "one"):
        shutil.copytree(simulated_drive, tmp_path / name)
    (tmp_path / "notes").mkdir()
    pairs = open_pairs(f"drive:{tmp_path}")
    number = num_images(simulated_drive)
    assert (len(pairs), pairs.name) == (2 * number, "one + two")
    assert len(open_pairs(str(tmp_path / "one"))) == number
    assert len(open_drives([tmp_path / "one", tmp_path / "two", simulated_drive])) == 3 * number


@pytest.fixture
def recorded(simulated_drive: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A drive without truth, and a folder of labels of its first two images beside it."""
    drive, labels = tmp_path / "drive", tmp_path / "labels"
    shutil.copytree(simulated_drive, drive, ignore=shutil.ignore_patterns("truth"))
    shutil.copytree(simulated_drive / "truth" / "label_images", labels)
    for path in sorted(labels.glob("*/*.png"))[2:]:
        path.unlink()
    return drive, labels


def test_a_recorded_drive_has_labels_beside_it(
    recorded: tuple[Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    drive, labels = recorded
    with caplog.at_level(logging.INFO):
        pairs = open_pairs(f"drive:{drive}:{labels}")
    assert len(pairs) == 2
    assert f"2 of {num_images(drive)} images have labels" in caplog.text
    stray = sorted(labels.glob("*/*.png"))[0]
    shutil.copy(stray, stray.with_name("17.png"))
    with caplog.at_level(logging.WARNING):
        assert len(open_drives([drive], labels)) == 2
    assert "1 label images" in caplog.text
    with pytest.raises(ConfigError, match="has no label images of its own"):
        open_pairs(f"drive:{drive}")
    with pytest.raises(ConfigError, match="was given for 2 drives"):
        open_drives([drive, drive], labels)


def test_label_folders_that_do_not_fit(recorded: tuple[Path, Path]) -> None:
    drive, labels = recorded
    (labels / "label_set.json").rename(labels / "hidden.json")
    with pytest.raises(LabelError, match="does not say what its ids mean"):
        open_drives([drive], labels)
    (labels / "label_set.json").write_text("{}")
    with pytest.raises(LabelError, match="is not a label set"):
        open_drives([drive], labels)
    (labels / "hidden.json").replace(labels / "label_set.json")
    path = sorted(labels.glob("*/*.png"))[0]
    write_label_png(path, np.full((300, 480), 77, np.uint8))
    with pytest.raises(LabelError, match=rf"{path.name} holds label id 77 \(144000 pixels"):
        open_drives([drive], labels).read(0)
    write_label_png(path, np.zeros((300, 479), np.uint8))
    with pytest.raises(ImageError, match=r"480x300 pixels, but its labels .* are 479x300"):
        open_drives([drive], labels).read(0)
    for png in labels.glob("*/*.png"):
        png.unlink()
    with pytest.raises(
        ConfigError, match=rf"None of the {num_images(drive)} images .* has a label image"
    ):
        open_drives([drive], labels)
    with pytest.raises(ConfigError, match="no folder of label images"):
        open_drives([drive], labels / "nowhere")


def test_a_label_set_of_ones_own(recorded: tuple[Path, Path]) -> None:
    drive, labels = recorded
    document = json.loads((labels / "label_set.json").read_text())
    document["name"] = "ours"
    document["labels"][0]["name"] = "kerbstone"
    (labels / "label_set.json").write_text(json.dumps(document))
    pairs = open_drives([drive], labels)
    assert pairs.label_set.name == "ours"
    with pytest.raises(LabelError, match="No mapping from label set 'ours' to 'street'"):
        relabelled(pairs, "street")


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("kitti:somewhere", ConfigError, "'kitti' is unknown; expected drive:FOLDER"),
        ("vistas:", ConfigError, "names no folder"),
        ("", ConfigError, "names no folder"),
        ("drive:/no/such/drive", DriveError, "/no/such/drive does not exist"),
        ("/no/such/drive", DriveError, "/no/such/drive does not exist"),
        ("camvid:/no/such:val", ConfigError, "There is no folder /no/such/val"),
    ],
)
def test_text_that_names_no_data_is_refused(
    spec: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        open_pairs(spec)


def test_no_drives_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no drives"):
        open_drives([])
    with pytest.raises(DriveError, match="is empty"):
        open_drives([tmp_path])


def test_a_folder_with_a_colon_in_its_name(simulated_drive: Path, tmp_path: Path) -> None:
    folder, number = tmp_path / "drive:2024-05-01", num_images(simulated_drive)
    shutil.copytree(simulated_drive, folder)
    assert len(open_pairs(f"drive:{folder}")) == len(open_pairs(str(folder))) == number
