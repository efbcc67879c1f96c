"""Versions of a map: found, compared, gone back to; and a drive taken out of the sum."""

import pytest

from hdmap_tools.errors import MapMismatchError, StoreError
from hdmap_tools.fusion.map_history import (
    changes_between,
    find_version,
    roll_back,
    take_out,
)
from hdmap_tools.fusion.semantic_map import SemanticMap

from .builders import counts_of, frames_of, meta

FRAMES = {"monday": frames_of(1, 3), "tuesday": frames_of(2, 2)}
LATER = frames_of(3, 4)


@pytest.fixture
def week(tmp_path):
    """Monday, tuesday, and monday once more."""
    made = SemanticMap.create(tmp_path / "week", meta())
    made.add(counts_of(FRAMES["monday"]), "monday")
    made.add(counts_of(FRAMES["tuesday"]), "tuesday")
    made.add(counts_of(LATER), "monday")
    return made


def test_versions_are_found_by_id_beginning_and_number(week):
    versions = week.history()
    assert [find_version(week, str(k)) for k in range(4)] == versions
    assert find_version(week, versions[2].id) == versions[2]
    assert find_version(week, versions[2].id[:8]) == versions[2]
    for wrong in ("4", versions[2].id[:2], "nothere", ""):
        with pytest.raises(StoreError, match="no version"):
            find_version(week, wrong)


def test_a_difference_is_what_the_commits_between_added(week):
    newest, middle = find_version(week, "0"), find_version(week, "2")
    changes = changes_between(week, middle, newest)
    added = counts_of(FRAMES["tuesday"] + LATER)
    assert changes.frames == {"monday": 4, "tuesday": 2}
    assert changes.votes == sum(int(t.layers["counts"].sum()) for t in added.tiles.values())
    assert changes.tiles == {
        index: int(tile.layers["height_n"].astype(bool).sum())
        for index, tile in added.tiles.items()
    }
    back = changes_between(week, newest, middle)
    assert back.votes == -changes.votes
    assert back.frames == {"monday": -4, "tuesday": -2}
    assert back.tiles == changes.tiles
    assert changes_between(week, newest, newest).num_cells == 0


def test_going_back_is_a_new_version_and_loses_nothing(week):
    before = week.history()
    for number, frames in ((2, FRAMES["monday"]), (0, [])):
        target = before[::-1][1] if number else before[-1]
        roll_back(week, target)
        assert week.read().equals(counts_of(frames))
        assert week.tile_indices() == tuple(sorted(counts_of(frames).tiles))
    assert week.drives == {}
    assert week.history()[2:] == before
    roll_back(week, before[0])
    assert week.read().equals(counts_of(FRAMES["monday"] + FRAMES["tuesday"] + LATER))
    assert week.drives == {"monday": {"num_frames": 7}, "tuesday": {"num_frames": 2}}


def test_taking_a_drive_out_leaves_the_map_of_the_others(week):
    take_out(week, "monday")
    assert week.read().equals(counts_of(FRAMES["tuesday"]))
    assert week.drives == {"tuesday": {"num_frames": 2}}
    with pytest.raises(MapMismatchError, match="does not hold 'monday'"):
        take_out(week, "monday")
    week.add(counts_of(LATER), "monday")
    take_out(week, "monday")
    assert week.read().equals(counts_of(FRAMES["tuesday"]))


def test_what_was_rolled_back_is_not_taken_out_again(week):
    without_the_last = week.history()[1]
    roll_back(week, without_the_last)
    take_out(week, "monday")
    assert week.read().equals(counts_of(FRAMES["tuesday"]))


def test_a_drive_that_came_with_others_cannot_be_told_apart(week, tmp_path):
    month = SemanticMap.create(tmp_path / "month", meta())
    month.merge(week)
    before = month.read()
    with pytest.raises(MapMismatchError, match="together with others"):
        take_out(month, "monday")
    assert month.read().equals(before)


def test_a_drive_is_added_twice_only_where_that_is_asked_for(week, tmp_path):
    other = SemanticMap.create(tmp_path / "other", meta())
    other.add(counts_of(FRAMES["monday"]), "monday")
    with pytest.raises(MapMismatchError, match="count it twice"):
        week.merge(other)
    week.merge(other, allow_repeats=True)
    assert week.drives["monday"] == {"num_frames": 10}
    everything = counts_of(FRAMES["monday"] + FRAMES["tuesday"] + LATER)
    assert week.read().equals(everything.merge(counts_of(FRAMES["monday"])))


def test_an_old_version_cannot_be_changed(week):
    old = SemanticMap.open(week.location, week.history()[1].id)
    with pytest.raises(StoreError, match="old version"):
        roll_back(old, week.history()[2])
