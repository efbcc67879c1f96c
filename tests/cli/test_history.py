"""The versions of a map from the command line: listed, compared, undone."""

import json

import pytest

from hdmap_tools.fusion.semantic_map import SemanticMap

from .conftest import LABELS


@pytest.fixture
def made(street, hdmap):
    """A map in three commits, one for each image."""
    segments = ("--set", "fusion.images_per_segment=1")
    code, _, err = hdmap("build", "drive", "-o", "map", *LABELS, *segments)
    assert code == 0, err
    return street / "map"


def test_versions_are_listed_compared_and_undone(made, hdmap, fails):
    code, out, _ = hdmap("history", "map")
    lines = out.splitlines()
    assert code == 0
    assert len(lines) == 4
    assert lines[0].endswith("Add nuscenes:scene-0001, segment 2")
    assert lines[3].endswith("Empty map")
    listed = json.loads(hdmap("history", "map", "--json")[1])
    assert [v["id"] for v in listed] == [line.split()[1] for line in lines]
    assert listed[0]["metadata"]["segments"] == [2]

    code, out, _ = hdmap("history", "map", "--diff", "2", "0")
    assert code == 0
    assert "nuscenes:scene-0001: +2 images" in out
    changes = json.loads(hdmap("history", "map", "--diff", "2", "0", "--json")[1])
    assert changes["frames"] == {"nuscenes:scene-0001": 2}
    assert changes["cells"] == sum(tile[2] for tile in changes["tiles"]) > 0

    whole = SemanticMap.open(made).read()
    first = listed[2]["id"]
    code, out, err = hdmap("history", "map", "--roll-back", first[:10])
    assert code == 0, err
    assert SemanticMap.open(made).read().equals(SemanticMap.open(made, first).read())
    assert hdmap("history", "map", "--roll-back", "1")[0] == 0
    assert SemanticMap.open(made).read().equals(whole)
    code, out, err = hdmap("history", "map", "--take-out", "nuscenes:scene-0001")
    assert code == 0, err
    assert SemanticMap.open(made).tile_indices() == ()
    fails("history", "map", "--take-out", "nuscenes:scene-0001", says=("does not hold",))
    fails("history", "map", "--diff", "0", "99", says=("no version '99'", "7 versions"))


def test_one_thing_at_a_time(made, fails):
    fails("history", "map", "--roll-back", "1", "--take-out", "x", says=("Give one of",))
    fails("history", "nothere", says=("No semantic map at nothere",))


def test_a_drive_is_merged_twice_only_by_force(made, hdmap, fails):
    fails("merge", "map", "map", "-o", "twice", says=("count it twice",))
    code, _, err = hdmap("merge", "map", "map", "-o", "twice", "--force")
    assert code == 0, err
    one, two = SemanticMap.open(made).read(), SemanticMap.open(made.parent / "twice").read()
    assert two.equals(one.merge(one))
