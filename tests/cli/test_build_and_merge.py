"""Maps of several drives, and what is checked before the long work begins."""

import json

import numpy as np
import pytest

from hdmap_tools.fusion.semantic_map import SemanticMap

from .conftest import LABELS

BUILD = ("build", "drive", "-o")


def another_drive(street):
    """The same street with brighter returns and another name: what a second drive may be."""
    for table, change in (
        ("scene", lambda row: row | {"name": "scene-0002"}),
        ("log", lambda row: row | {"logfile": "scene-0002"}),
    ):
        path = street / "drive" / "v1.0-mini" / f"{table}.json"
        path.write_text(json.dumps([change(row) for row in json.loads(path.read_text())]))
    for sweep in (street / "drive").rglob("*.bin"):
        points = np.fromfile(sweep, np.float32).reshape(-1, 5)
        points[:, 3] += 7.0
        points.tofile(sweep)


def test_a_second_drive_is_built_like_the_first_and_added(street, hdmap, fails):
    assert hdmap(*BUILD, "monday", *LABELS)[0] == 0
    another_drive(street)
    assert hdmap(*BUILD, "alone", *LABELS)[0] == 0
    fails("merge", "monday", "alone", "-o", "week", says=("intensity_threshold", "--like"))
    code, _, err = hdmap(*BUILD, "tuesday", "--like", "monday", *LABELS)
    assert code == 0, err
    code, out, err = hdmap("merge", "monday", "tuesday", "-o", "week")
    assert code == 0, err
    assert "scene-0001 (3 images), nuscenes:scene-0002 (3 images)" in out
    monday, tuesday, week = (
        SemanticMap.open(street / name) for name in ("monday", "tuesday", "week")
    )
    assert week.read().equals(monday.read().merge(tuesday.read()))
    code, _, err = hdmap("merge", "week", "-o", "without", "--subtract", "tuesday")
    assert code == 0, err
    assert SemanticMap.open(street / "without").read().equals(monday.read())
    line = fails(
        "merge", "monday", "-o", "x", "--subtract", "tuesday", says=("tuesday", "scene-0002")
    )
    assert ".partial" not in line


def test_a_map_like_one_with_other_labels(street, hdmap, fails):
    assert hdmap(*BUILD, "adas", *LABELS)[0] == 0
    city = ("--labels", "labels", "--label-set", "cityscapes")
    fails(*BUILD, "x", "--like", "adas", *city, says=("label_set",))


def test_many_segments_give_the_map_of_one(street, hdmap):
    assert hdmap("run", "drive", "-o", "one", *LABELS)[0] == 0
    one_each = ("--set", "fusion.images_per_segment=1")
    assert hdmap("run", "drive", "-o", "many", *LABELS, *one_each)[0] == 0
    one, many = (SemanticMap.open(street / n / "semantic_map") for n in ("one", "many"))
    assert len(many.history()) == len(one.history()) + 2
    assert many.read().equals(one.read())
    scores = [
        {
            m: c["groups"]
            for m, c in json.loads((street / n / "metrics.json").read_text())["comparisons"].items()
        }
        for n in ("one", "many")
    ]
    assert scores[0] == scores[1]
    for name in ("overview.png", "lanelet2_map.osm"):
        assert (street / "one" / name).read_bytes() == (street / "many" / name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--set", "vectorize.vectorizers=[nonsense]"), "nonsense"),
        (("--reference", "nothere.png"), "nothere.png"),
        (("--set", "observation.priors={road: 0.9, lane_mark: 0.8}"), "observation.priors"),
        (("--confusion", "nothere.json"), "nothere.json"),
        (("--set", "observation.model=confusion", "--label-set", "cityscapes"), "cityscapes"),
        (("--json", "labels/label_set.json"), "label_set.json"),
    ],
)
def test_what_is_wrong_is_said_before_the_images_are_read(
    street, fails, monkeypatch, arguments, word
):
    def never(*_, **__):
        raise AssertionError("the long work began")

    (street / "labels" / "label_set.json").write_text("{}")
    monkeypatch.setattr("hdmap_tools.pipeline.build_map", never)
    fails("run", "drive", "-o", "out", *LABELS, *arguments, says=(word,))


def test_a_memory_budget(street, hdmap, fails):
    assert hdmap(*BUILD, "free", *LABELS)[0] == 0
    code, _, err = hdmap(*BUILD, "bound", *LABELS, "--memory", "700MB")
    assert code == 0, err
    one, other = (SemanticMap.open(street / name) for name in ("free", "bound"))
    assert one.read().equals(other.read())
    fails(*BUILD, "map", *LABELS, "--memory", "300MB", says=("too few", "allow at least"))
    assert not list(street.glob(".*unfinished"))
    fails(*BUILD, "map", *LABELS, "--memory", "much", says=("a size such as 2GB",), code=2)
    both = ("--memory", "1GB", "--workers", 2)
    fails(*BUILD, "map", *LABELS, *both, says=("--worker-memory",), code=2)


def test_labels_without_a_known_confusion_are_believed_alike(street, hdmap):
    # In Cityscapes' numbering 0 is road and 1, 3 are sidewalk and wall.
    city = ("--labels", "labels", "--label-set", "cityscapes")
    code, _, err = hdmap("run", "drive", "-o", "out", *city)
    assert code == 0, err
    assert "No confusion matrix is known" in err


def test_a_drive_that_sees_no_ground(street, fails):
    for sweep in (street / "drive").rglob("*.bin"):
        points = np.fromfile(sweep, np.float32).reshape(-1, 5)
        points[:, :3] = 0.0
        points.tofile(sweep)
    fails("build", "drive", "-o", "x", *LABELS, says=("no ground was seen", "FRONT"))


def test_planar_uses_images_that_have_no_sweep(street, hdmap):
    tables = street / "drive" / "v1.0-mini" / "sample_data.json"
    rows = json.loads(tables.read_text())
    sweeps = sorted(r["filename"] for r in rows if r["filename"].endswith(".bin"))
    tables.write_text(json.dumps([r for r in rows if r["filename"] not in sweeps[1:]]))
    code, out, err = hdmap("run", "drive", "-o", "out", *LABELS, "--association", "planar")
    assert code == 0, err
    assert "3 images" in out
    code, out, err = hdmap("build", "drive", "-o", "map", *LABELS)
    assert code == 0, err
    assert "1 images" in out
    assert "2 of 3 images left out: no lidar sweep near in time" in err


def test_a_gap_in_the_middle_of_the_poses(street, hdmap):
    # The middle image has no pose near it: it is left out, also as the overview's photo.
    for table in ("ego_pose", "sample_data"):
        path = street / "drive" / "v1.0-mini" / f"{table}.json"
        rows = json.loads(path.read_text())
        times = sorted({r["timestamp"] for r in rows})
        if table == "ego_pose":
            rows = [r for r in rows if r["timestamp"] != times[1]]
        path.write_text(json.dumps(rows))
    code, out, err = hdmap("run", "drive", "-o", "out", *LABELS)
    assert code == 0, err
    assert "2 images" in out


def test_where_the_map_came_from_is_settled(street, hdmap):
    assert hdmap("run", "drive", "-o", "out", *LABELS)[0] == 0
    from hdmap_tools.config import load_config

    config = load_config(street / "out" / "hdmap.yaml")
    assert config.segmentation.labels == street / "labels"
