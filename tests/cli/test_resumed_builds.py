"""Builds that are killed, and go on: the map in the end is that of a build that was not."""

import json
import subprocess
import sys

import pytest
from filelock import FileLock

from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.unfinished import unfinished_folder

from .conftest import LABELS

SEGMENTS = ("--set", "fusion.images_per_segment=1")
BUILD = ("build", "drive", "-o", "map", *LABELS, *SEGMENTS)

KILLED = """
import os, signal, sys
from hdmap_tools.fusion import semantic_map
module, name, number = semantic_map, {name!r}, {number}
owner = module.SemanticMap if name == "add" else module
original, calls = getattr(owner, name), []
def dying(*arguments, **more):
    result = original(*arguments, **more)
    calls.append(1)
    if len(calls) == number:
        os.kill(os.getpid(), signal.SIGKILL)
    return result
setattr(owner, name, dying)
from hdmap_tools.cli.main import main
sys.argv = ["hdmap", *{arguments!r}]
main()
"""


@pytest.fixture
def whole(street, hdmap):
    """The map of a build that nobody disturbed."""
    code, _, err = hdmap("build", "drive", "-o", "whole", *LABELS, *SEGMENTS)
    assert code == 0, err
    return SemanticMap.open(street / "whole")


def told(semantic_map):
    """What the history says: messages and metadata, oldest first."""
    return [(v.message, v.metadata) for v in reversed(semantic_map.history())]


def nothing_is_left(street):
    return not unfinished_folder(street / "map").exists()


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_build_that_failed_goes_on_after_its_last_commit(
    street, hdmap, fails, whole, monkeypatch, number
):
    original, done = SemanticMap.add, []

    def failing(self, *arguments, **more):
        if len(done) + 1 == number:
            raise OSError(28, "No space left on device")
        done.append(more["segment"])
        return original(self, *arguments, **more)

    monkeypatch.setattr(SemanticMap, "add", failing)
    fails(*BUILD, says=("No space left", "is kept"))
    assert done == list(range(number - 1))
    assert not (street / "map").exists()
    committed = []

    def counting(self, *arguments, **more):
        committed.append(more["segment"])
        return original(self, *arguments, **more)

    monkeypatch.setattr(SemanticMap, "add", counting)
    code, out, err = hdmap(*BUILD)
    assert code == 0, err
    assert "3 images" in out
    assert committed == list(range(number - 1, 3))
    made = SemanticMap.open(street / "map")
    assert made.read().equals(whole.read())
    assert told(made) == told(whole)
    assert nothing_is_left(street)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"), [("add", 1), ("add", 3), ("write_tile", 1), ("write_tile", 4)]
)
def test_a_build_killed_at_any_point_goes_on(street, hdmap, whole, name, number):
    program = KILLED.format(name=name, number=number, arguments=list(BUILD))
    killed = subprocess.run([sys.executable, "-c", program], cwd=street, capture_output=True)
    assert killed.returncode == -9, killed.stderr.decode()
    assert not (street / "map").exists()
    code, _, err = hdmap(*BUILD)
    assert code == 0, err
    made = SemanticMap.open(street / "map")
    assert made.read().equals(whole.read())
    assert told(made) == told(whole)
    assert nothing_is_left(street)


def test_unfinished_work_is_not_mixed_with_another_build(street, hdmap, fails, whole, monkeypatch):
    original = SemanticMap.add

    def failing(self, *arguments, **more):
        if more["segment"] == 1:
            raise OSError(28, "No space left on device")
        return original(self, *arguments, **more)

    monkeypatch.setattr(SemanticMap, "add", failing)
    fails(*BUILD, says=("No space left",))
    monkeypatch.undo()
    monkeypatch.chdir(street)
    coarse = (*BUILD, "--resolution", "0.5")
    fails(*coarse, says=("configuration", "--no-resume"))
    code, _, err = hdmap(*coarse, "--no-resume")
    assert code == 0, err
    assert SemanticMap.open(street / "map").meta.resolution_m == 0.5
    assert nothing_is_left(street)


def test_two_builds_of_one_map_at_once(street, hdmap, fails):
    work = unfinished_folder(street / "map")
    work.mkdir()
    with FileLock(work / "lock"):
        fails(*BUILD, says=("Another process",))
    assert hdmap(*BUILD)[0] == 0
    assert nothing_is_left(street)


def test_a_plan_that_cannot_be_read_is_another_plan(street, hdmap, fails, monkeypatch):
    def never(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(SemanticMap, "add", never)
        fails(*BUILD, says=("No space left",))
    plan = unfinished_folder(street / "map") / "plan.json"
    assert json.loads(plan.read_text())["drive"] == "nuscenes:scene-0001"
    plan.write_text("{")
    fails(*BUILD, says=("--no-resume",))
    assert hdmap(*BUILD, "--no-resume")[0] == 0
