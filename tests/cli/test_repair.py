"""A chunk that was damaged: named, and its tile counted again; nothing else changes."""

import json

import pytest

from hdmap_tools.fusion.semantic_map import SemanticMap

from .conftest import LABELS

BUILD = ("build", "drive", "-o", "map", *LABELS)


def damage(folder, number):
    """Flip a byte in the middle of the number-th largest chunk."""
    chunks = sorted((folder / "chunks").rglob("*"), key=lambda p: (-p.stat().st_size, p.name))
    path = [p for p in chunks if p.is_file()][number]
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x40
    path.write_bytes(bytes(content))


@pytest.fixture
def made(street, hdmap):
    code, _, err = hdmap(*BUILD)
    assert code == 0, err
    return street


@pytest.mark.parametrize("number", [0, 1])
def test_a_damaged_tile_is_named_and_counted_again(made, hdmap, fails, number):
    before = SemanticMap.open(made / "map")
    expected, history = before.read(), before.history()
    damage(made / "map", number)
    fails("vectorize", "map", "-o", "v.gpkg", says=("Tile (", "map", "--repair"))
    code, out, err = hdmap(*BUILD, "--repair", "--json", "report.json")
    assert code == 0, err
    assert "1 damaged" in out
    report = json.loads((made / "report.json").read_text())
    ((tile, layers),) = report["damaged"].items()
    assert f"Tile ({tile.replace(',', ', ')}) is damaged: {', '.join(layers)}" in err
    assert 0 < report["num_images"] <= 3
    after = SemanticMap.open(made / "map")
    assert after.read().equals(expected)
    assert after.drives == before.drives
    assert [v.id for v in after.history()[1:]] == [v.id for v in history]
    assert after.history()[0].metadata["repaired"] == [[int(k) for k in tile.split(",")]]
    code, out, _ = hdmap(*BUILD, "--repair")
    assert code == 0
    assert "0 damaged" in out
    assert len(SemanticMap.open(made / "map").history()) == len(history) + 1


def test_what_is_sound_of_the_tile_must_come_out_again(made, fails):
    versions = len(SemanticMap.open(made / "map").history())
    damage(made / "map", 0)
    other = ("--set", "association.max_range_m=9", "--set", "association.lookup_range_m=9")
    fails(*BUILD, *other, "--repair", says=("cannot be repaired", "built with"))
    assert len(SemanticMap.open(made / "map").history()) == versions


def test_a_map_of_several_drives_is_not_repaired_from_one(made, fails):
    several = SemanticMap.open(made / "map")
    several.add(several.read(), "other:drive")
    for number in range(4):  # those of the first version are among them
        damage(made / "map", number)
    versions = len(several.history())
    fails(*BUILD, "--repair", says=("other:drive", "merge them anew"))
    assert len(several.history()) == versions


def test_there_must_be_a_map_to_repair(street, fails):
    fails(*BUILD, "--repair", says=("No semantic map at map",))
