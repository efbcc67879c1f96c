import json
import shutil

import numpy as np
import pytest

from hdmap_tools.errors import MapMismatchError, OutputExistsError, StoreError
from hdmap_tools.fusion.map_store import is_semantic_map
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.geometry.grid import BevGrid

from .builders import counts_of, frames_of, meta, random_frame


@pytest.fixture
def stored(tmp_path):
    semantic_map = SemanticMap.create(tmp_path / "map", meta())
    semantic_map.add(counts_of(frames_of(1, 3)), "drive-1")
    return semantic_map


def test_what_is_stored_comes_back_exactly(stored):
    opened = SemanticMap.open(stored.location)
    assert opened.meta == meta()
    assert opened.read().equals(counts_of(frames_of(1, 3)))
    assert opened.tile_indices() == tuple(sorted(counts_of(frames_of(1, 3)).tiles))
    assert opened.drives == {"drive-1": {"num_frames": 3}}


def test_commits_add_up_to_the_map_built_in_one_go(stored):
    stored.add(counts_of(frames_of(2, 2)), "drive-1")
    stored.add(counts_of(frames_of(3, 2)), "drive-2")
    whole = counts_of(frames_of(1, 3) + frames_of(2, 2) + frames_of(3, 2))
    assert stored.read().equals(whole)
    assert stored.drives == {"drive-1": {"num_frames": 5}, "drive-2": {"num_frames": 2}}


def test_a_window_equals_the_window_of_the_counts(stored):
    grid = BevGrid(0.2, -300, -280, 270, 300)
    in_memory = counts_of(frames_of(1, 3)).window(grid)
    assert stored.window(grid).equals(in_memory)
    assert not in_memory.is_empty


def test_merge_and_subtract_on_disk(stored, tmp_path):
    other = SemanticMap.create(tmp_path / "other", meta())
    other.add(counts_of(frames_of(7, 2)), "drive-7")
    before = stored.read()
    stored.merge(other)
    assert stored.read().equals(before.merge(other.read()))
    stored.subtract(other)
    assert stored.read().equals(before)
    assert stored.drives == {"drive-1": {"num_frames": 3}}


def test_old_versions_stay_readable(stored):
    first = stored.history()[0]
    stored.add(counts_of(frames_of(2, 1)), "drive-2")
    assert [v.message for v in stored.history()][:3] == ["Add drive-2", "Add drive-1", "Empty map"]
    old = SemanticMap.open(stored.location, first.id)
    assert old.read().equals(counts_of(frames_of(1, 3)))
    with pytest.raises(StoreError, match="old version"):
        old.add(counts_of(frames_of(3, 1)), "drive-3")


def test_adding_the_same_drive_twice_by_merging_is_refused(stored, tmp_path):
    other = SemanticMap.create(tmp_path / "other", meta())
    other.add(counts_of(frames_of(9, 1)), "drive-1")
    with pytest.raises(MapMismatchError, match="drive-1; adding it twice"):
        stored.merge(other)


def test_subtracting_a_drive_that_is_not_there_is_refused(stored, tmp_path):
    other = SemanticMap.create(tmp_path / "other", meta())
    other.add(counts_of(frames_of(9, 1)), "drive-9")
    with pytest.raises(
        MapMismatchError, match=r"holds drive-9, which the map does not hold; the map holds drive-1"
    ):
        stored.subtract(other)


@pytest.mark.parametrize("changes", [{"resolution_m": 0.1}, {"count_mode": "point"}])
def test_maps_of_another_kind_are_refused_and_change_nothing(stored, tmp_path, changes):
    other = SemanticMap.create(tmp_path / "other", meta(**changes))
    other.add(counts_of(frames_of(9, 1), meta(**changes)), "drive-9")
    versions = len(stored.history())
    with pytest.raises(MapMismatchError, match="cannot be added"):
        stored.merge(other)
    assert len(stored.history()) == versions
    assert stored.read().equals(counts_of(frames_of(1, 3)))


def test_a_refused_subtraction_changes_nothing(stored, tmp_path):
    other = SemanticMap.create(tmp_path / "other", meta())
    other.add(counts_of(frames_of(9, 1)), "drive-1")
    with pytest.raises(MapMismatchError, match="below zero"):
        stored.subtract(other)
    assert stored.read().equals(counts_of(frames_of(1, 3)))


def test_an_existing_map_is_never_overwritten(stored):
    with pytest.raises(OutputExistsError, match="exists already"):
        SemanticMap.create(stored.location, meta())
    assert SemanticMap.open(stored.location).drives


def test_what_has_other_things_in_it_is_no_map(stored):
    assert is_semantic_map(stored.location)
    (stored.location / "thesis.txt").write_text("x")
    assert not is_semantic_map(stored.location)


def test_opening_nothing_says_so(tmp_path):
    with pytest.raises(StoreError, match="No semantic map at"):
        SemanticMap.open(tmp_path / "none")


@pytest.mark.parametrize("part", ["snapshots", "refs"])
def test_a_damaged_map_says_so(stored, part):
    for file in (stored.location / part).rglob("*"):
        if file.is_file():
            file.write_bytes(b"not what it was")
    with pytest.raises(StoreError, match="Cannot open the map"):
        SemanticMap.open(stored.location)


def flip_a_byte(path):
    content = bytearray(path.read_bytes())
    content[len(content) * 2 // 3] ^= 0x55
    path.write_bytes(bytes(content))


def error_of_reading(path, expected) -> str | None:
    """What reading a map complains of; None if it gives what it should."""
    try:
        read = SemanticMap.open(path).read()
    except StoreError as error:
        return str(error)
    assert read.equals(expected)
    return None


@pytest.mark.parametrize("harm", ["flip", "truncate", "empty", "delete"])
@pytest.mark.parametrize("part", ["chunks", "manifests"])
def test_damage_to_the_counts_is_found_never_read(tmp_path, part, harm):
    stored = SemanticMap.create(tmp_path / "map", meta())
    # Enough points that chunks become files; small ones lie inside the manifests.
    dense = [(k, random_frame(np.random.default_rng(k), 3000, 12.0)) for k in range(2)]
    stored.add(counts_of(dense), "drive-1")
    expected = stored.read()
    found = 0
    for file in sorted((stored.location / part).rglob("*")):
        if not file.is_file():
            continue
        content = file.read_bytes()
        if harm == "flip":
            flip_a_byte(file)
        elif harm == "truncate":
            file.write_bytes(content[: len(content) // 2])
        elif harm == "empty":
            file.write_bytes(b"")
        else:
            file.unlink()
        said = error_of_reading(stored.location, expected)
        if said is not None:
            found += 1
            assert str(stored.location) in said
            assert "\n" not in said
        file.write_bytes(content)
    # Every chunk and manifest of the newest version is read, so its damage is found.
    assert found > 0
    assert SemanticMap.open(stored.location).read().equals(expected)


def test_two_that_write_at_once_do_not_overwrite_each_other(stored):
    other, more = (
        SemanticMap.open(stored.location),
        counts_of([(7, random_frame(np.random.default_rng(7)))]),
    )
    expected = stored.read().merge(more)

    def tiles_while_another_commits():
        other.add(more, "drive-of-another")
        yield from more.tiles.items()

    with pytest.raises(StoreError, match="no other process writes it"):
        stored.replace(tiles_while_another_commits(), {}, "Replace", {})
    for one in (stored, other, SemanticMap.open(stored.location)):
        assert one.read().equals(expected)
        assert one.history()[0].message == "Add drive-of-another"


def test_an_empty_map_adds_nothing_and_takes_nothing_out(stored, tmp_path):
    empty = SemanticMap.create(tmp_path / "empty", meta())
    versions = len(stored.history())
    stored.merge(empty)
    assert len(stored.history()) == versions
    empty.merge(stored)
    assert empty.read().equals(stored.read())


def test_stored_maps_with_other_reference_heights_merge_exactly(tmp_path):
    low = SemanticMap.create(tmp_path / "low", meta())
    low.add(counts_of(frames_of(1, 2)), "drive-1")
    high = SemanticMap.create(tmp_path / "high", meta(reference_height_m=7.0))
    high.add(counts_of(frames_of(2, 2), meta(reference_height_m=7.0)), "drive-2")
    low.merge(high)
    assert low.read().equals(counts_of(frames_of(1, 2) + frames_of(2, 2)))


def test_the_history_says_what_was_added(stored):
    newest = stored.history()[0]
    assert newest.metadata == {"drives": {"drive-1": {"num_frames": 3}}, "sign": 1}


def test_a_window_of_another_resolution_is_refused(stored):
    with pytest.raises(MapMismatchError, match=r"0\.1 m was asked of a map of 0\.2 m"):
        stored.window(BevGrid(0.1, 0, 0, 5, 5))


def test_a_newer_schema_is_refused(tmp_path):
    import zarr

    semantic_map = SemanticMap.create(tmp_path / "map", meta())
    session = semantic_map._repository.writable_session("main")
    group = zarr.open_group(session.store)
    group.attrs["meta"] = json.loads(json.dumps(group.attrs["meta"])) | {"schema_version": 99}
    session.commit("from the future")
    with pytest.raises(StoreError, match="schema version 99"):
        SemanticMap.open(semantic_map.location)


def test_an_empty_map_has_no_grid(tmp_path):
    semantic_map = SemanticMap.create(tmp_path / "map", meta())
    assert semantic_map.tile_indices() == ()
    assert semantic_map.grid is None
    assert np.array_equal(
        semantic_map.window(BevGrid(0.2, 0, 0, 3, 3)).layers["height_n"], np.zeros((3, 3))
    )


def test_a_map_that_was_moved_still_opens(stored, tmp_path):
    shutil.move(stored.location, tmp_path / "moved")
    assert SemanticMap.open(tmp_path / "moved").read().equals(counts_of(frames_of(1, 3)))
