"""Maps in S3: built, killed, gone on with, read by every command that reads maps."""

import json
import subprocess
import sys

import pytest

from hdmap_tools.fusion.map_location import map_location
from hdmap_tools.fusion.semantic_map import SemanticMap
from tests.s3_server import watch_writes_of_refs

from .conftest import LABELS
from .test_resumed_builds import KILLED, told

SEGMENTS = ("--set", "fusion.images_per_segment=1")
BUILD = ("build", "drive", *LABELS, *SEGMENTS)


@pytest.fixture
def address(s3, street, request):
    """Of a map of the street, for this test alone."""
    name = "".join(c if c.isalnum() else "-" for c in request.node.name)
    return f"s3://maps/{name}/map"


@pytest.fixture
def whole(street, hdmap):
    """The map of a build in a folder."""
    code, _, err = hdmap(*BUILD, "-o", "whole")
    assert code == 0, err
    return SemanticMap.open(street / "whole")


def opened(address):
    return SemanticMap.open(map_location(address))


def branches_of(s3, address):
    keys = s3.keys(address.removeprefix("s3://maps/"))
    return {key.split("/")[1].removeprefix("branch.") for key in keys if key.startswith("refs/")}


def test_a_map_in_s3_is_that_of_a_folder(s3, address, hdmap, whole):
    code, out, err = hdmap(*BUILD, "-o", address)
    assert code == 0, err
    assert f"3 images fused into {len(whole.tile_indices())} tiles at {address}" in out
    made = opened(address)
    assert made.read().equals(whole.read())
    assert made.drives == whole.drives
    assert [m for m, _ in told(made)] == [m for m, _ in told(whole)]
    assert branches_of(s3, address) == {"main"}


def test_a_map_is_replaced_only_when_asked_to(s3, address, hdmap, fails):
    assert hdmap(*BUILD, "-o", address)[0] == 0
    first = opened(address)
    fails(*BUILD, "-o", address, says=(address, "--overwrite"))
    code, _, err = hdmap(*BUILD, "-o", address, "--overwrite", "--resolution", "0.5")
    assert code == 0, err
    assert opened(address).meta.resolution_m == 0.5
    assert first.meta.resolution_m != 0.5
    assert {m for m, _ in told(opened(address))} == {m for m, _ in told(first)}
    assert branches_of(s3, address) == {"main"}


def test_something_else_is_left_alone(s3, address, street, fails):
    key = address.removeprefix("s3://") + "/notes.txt"
    s3.request("PUT", f"/{key}", b"mine")
    fails(*BUILD, "-o", address, "--overwrite", says=("not a map", address))
    assert s3.request("GET", f"/{key}") == "mine"


@pytest.mark.slow
def test_readers_see_the_earlier_map_until_the_new_one_is_whole(
    s3, address, hdmap, fails, monkeypatch
):
    original, seen = SemanticMap.add, []

    def looking(self, *arguments, **more):
        made = original(self, *arguments, **more)
        code, out, err = hdmap("history", address)
        seen.append((code, len(out.splitlines()), "not finished" in err))
        return made

    monkeypatch.setattr(SemanticMap, "add", looking)
    assert hdmap(*BUILD, "-o", address)[0] == 0
    assert seen == [(1, 0, True)] * 3
    seen.clear()
    assert hdmap(*BUILD, "-o", address, "--overwrite")[0] == 0
    assert seen == [(0, 4, False)] * 3


def stopped_build(address, fails, monkeypatch, segment=1, *more):
    """Have a build fail at a segment."""
    original = SemanticMap.add

    def failing(self, *arguments, **given):
        if given["segment"] == segment:
            raise OSError(28, "No space left on device")
        return original(self, *arguments, **given)

    with monkeypatch.context() as patched:
        patched.setattr(SemanticMap, "add", failing)
        fails(*BUILD, "-o", address, *more, says=("No space left",))


def test_a_build_that_failed_goes_on(s3, address, hdmap, fails, whole, monkeypatch):
    stopped_build(address, fails, monkeypatch)
    fails("info", address, says=("not finished",))
    original, committed = SemanticMap.add, []

    def counting(self, *arguments, **more):
        committed.append(more["segment"])
        return original(self, *arguments, **more)

    monkeypatch.setattr(SemanticMap, "add", counting)
    assert hdmap(*BUILD, "-o", address)[0] == 0
    assert committed == [1, 2]
    assert opened(address).read().equals(whole.read())
    assert branches_of(s3, address) == {"main"}


def test_unfinished_work_is_not_mixed_with_another_build(
    s3, address, street, hdmap, fails, monkeypatch
):
    stopped_build(address, fails, monkeypatch)
    coarse = (*BUILD, "-o", address, "--resolution", "0.5")
    fails(*coarse, says=("configuration", "--no-resume"))
    assert hdmap(*coarse, "--no-resume")[0] == 0
    assert opened(address).meta.resolution_m == 0.5
    assert len(told(opened(address))) == 4
    assert branches_of(s3, address) == {"main"}


@pytest.mark.slow
def test_two_builds_of_one_map_at_once(s3, address, street, hdmap, fails, whole, monkeypatch):
    """The second goes on where the first is; the first sees it at its next commit, and stops."""
    original, done = SemanticMap.add, []

    def interrupted(self, *arguments, **more):
        if not done:
            done.append(True)
            assert hdmap(*BUILD, "-o", address)[0] == 0
        return original(self, *arguments, **more)

    monkeypatch.setattr(SemanticMap, "add", interrupted)
    fails(*BUILD, "-o", address, says=(address, "other process"))
    assert opened(address).read().equals(whole.read())


def test_two_builds_that_take_turns(s3, address, street, hdmap, fails, whole, monkeypatch):
    original, order = SemanticMap.add, []

    def meddling(self, *arguments, **more):
        order.append(more["segment"])
        if order == [0, 1]:
            original(SemanticMap.open(self.location), *arguments, **more)  # another process
        return original(self, *arguments, **more)

    with monkeypatch.context() as patched:
        patched.setattr(SemanticMap, "add", meddling)
        fails(*BUILD, "-o", address, says=("Another process is making", address))
    assert hdmap(*BUILD, "-o", address)[0] == 0
    assert opened(address).read().equals(whole.read())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"), [("add", 1), ("add", 3), ("write_tile", 1), ("write_tile", 4)]
)
def test_a_build_killed_at_any_point_goes_on(s3, address, street, hdmap, whole, name, number):
    program = KILLED.format(name=name, number=number, arguments=[*BUILD, "-o", address])
    killed = subprocess.run([sys.executable, "-c", program], cwd=street, capture_output=True)
    assert killed.returncode == -9, killed.stderr.decode()
    code, _, err = hdmap(*BUILD, "-o", address)
    assert code == 0, err
    assert opened(address).read().equals(whole.read())
    assert [m for m, _ in told(opened(address))] == [m for m, _ in told(whole)]
    assert branches_of(s3, address) == {"main"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "is_lost"),
    [(1, True), (2, True), (2, False), (3, True), (5, True), (6, False), (7, True), (7, False)],
)
def test_a_build_killed_at_a_write_of_a_branch(
    s3, address, street, hdmap, fails, whole, monkeypatch, number, is_lost
):
    """These decide what is there: 1 repository, 2 branch, 3 empty map, 4 to 6 segments, 7 publishing."""
    killed = []

    def told(writes):
        if writes == number and not killed:
            killed.append(True)
            build.kill()
            build.wait()
            return is_lost
        return False

    program = "from hdmap_tools.cli.main import main; main()"
    with monkeypatch.context() as patched:
        watch_writes_of_refs(patched, told)
        build = subprocess.Popen(
            [sys.executable, "-c", program, *BUILD, "-o", address], stderr=subprocess.PIPE
        )
        _, err = build.communicate()
    assert killed, err.decode()
    if (number, is_lost) == (1, True):
        # The one moment that is not gone on from: Icechunk's own making of a repository.
        fails(*BUILD, "-o", address, says=("not a map", "first moment"))
        return
    if (number, is_lost) == (7, False):  # published already
        fails(*BUILD, "-o", address, says=("--overwrite",))
    else:
        fails("info", address, says=("not finished",))
        assert hdmap(*BUILD, "-o", address)[0] == 0
        assert branches_of(s3, address) == {"main"}
    assert opened(address).read().equals(whole.read())
    assert len(opened(address).history()) == len(whole.history())


@pytest.mark.slow
def test_workers_write_to_s3(s3, address, hdmap, whole):
    pytest.importorskip("distributed", reason="needs the extra `distributed`")
    code, _, err = hdmap(*BUILD, "-o", address, "--workers", "2")
    assert code == 0, err
    assert opened(address).read().equals(whole.read())
    assert opened(address).drives == whole.drives


def test_every_command_that_reads_maps_reads_them_in_s3(s3, address, street, hdmap, whole):
    assert hdmap(*BUILD, "-o", address)[0] == 0

    def alike(*command):
        """What a command says of both maps, but for their names and the times of commits."""
        told = []
        for place, name in (("whole", "one_made"), (address, "other_made")):
            code, out, err = hdmap(*[c.format(map=place, name=name) for c in command])
            assert code == 0, err
            told.append(out.replace(place, "MAP").replace(name, "NAME"))
        return told

    here, there = alike("info", "{map}")
    assert here.split("history")[0] == there.split("history")[0]
    assert "semantic map" in there
    here, there = alike("vectorize", "{map}", "-o", "{name}.gpkg")
    assert here == there
    mask = ("whole", "-o", "marks.gpkg")
    assert hdmap("vectorize", *mask)[0] == 0
    here, there = alike("compare", "{map}", "marks.gpkg", "--json", "{name}.json")
    assert here == there
    assert json.loads((street / "one_made.json").read_text()) == json.loads(
        (street / "other_made.json").read_text()
    )
    here, there = alike("reliability", "{map}", "--truth", "marks.gpkg", "-o", "{name}")
    assert here == there
    code, _, err = hdmap(*BUILD, "-o", "like", "--like", address)
    assert code == 0, err


def test_maps_are_merged_from_and_into_s3(s3, address, hdmap, fails, whole):
    assert hdmap(*BUILD, "-o", address)[0] == 0
    twice = address + "-twice"
    fails("merge", address, "whole", "-o", twice, says=("twice",))
    assert branches_of(s3, twice) == {"main"}
    code, out, err = hdmap("merge", address, "whole", "-o", twice, "--force")
    assert code == 0, err
    assert f"{twice} holds" in out
    once = hdmap("merge", twice, "--subtract", address, "-o", twice, "--overwrite")
    assert once[0] == 0, once[2]
    assert opened(twice).read().equals(whole.read())
    fails("merge", address, "-o", twice, says=("--overwrite",))
    assert branches_of(s3, twice) == {"main"}


@pytest.mark.slow
def test_a_merge_leaves_an_unfinished_build_alone(s3, address, street, hdmap, fails, monkeypatch):
    assert hdmap(*BUILD, "-o", "whole")[0] == 0
    stopped_build(address, fails, monkeypatch)
    assert hdmap("merge", "whole", "-o", address)[0] == 0
    assert branches_of(s3, address) == {"main", "unfinished"}
    assert hdmap(*BUILD, "-o", address, "--overwrite")[0] == 0
    assert opened(address).read().equals(SemanticMap.open(street / "whole").read())


@pytest.mark.slow
def test_history_is_changed_in_s3(s3, address, hdmap, whole):
    assert hdmap(*BUILD, "-o", address)[0] == 0
    (drive,) = whole.drives
    code, out, err = hdmap("history", address, "--take-out", drive)
    assert code == 0, err
    assert not opened(address).drives
    code, out, err = hdmap("history", address, "--diff", "1", "0")
    assert code == 0, err
    assert "-3 images" in out
    code, _, err = hdmap("history", address, "--roll-back", "1")
    assert code == 0, err
    assert opened(address).read().equals(whole.read())


def test_a_damaged_tile_in_s3_is_counted_again(s3, address, hdmap, whole):
    in_one_commit = (
        "build",
        "drive",
        *LABELS,
        "-o",
        address,
    )  # all chunks are of the newest version
    assert hdmap(*in_one_commit)[0] == 0
    prefix = address.removeprefix("s3://maps/")
    chunk = max(key for key in s3.keys(prefix) if key.startswith("chunks/"))
    s3.request("DELETE", f"/maps/{prefix}/{chunk}")
    code, out, err = hdmap(*in_one_commit, "--repair")
    assert code == 0, err
    assert " damaged, counted again from" in out
    assert opened(address).read().equals(whole.read())


@pytest.mark.parametrize("bad", ["s3://", "s3://maps", "s3://maps/", "s3:///map", "s3://maps//map"])
def test_addresses_that_name_no_map(fails, bad):
    fails("info", bad, says=(bad, "s3://BUCKET/PREFIX"))


def test_what_is_no_map_does_not_go_to_s3(hdmap):
    code, _, err = hdmap("vectorize", "map", "-o", "s3://maps/features.gpkg")
    assert code == 2
    assert "only semantic maps" in err
