"""A disk that is really full: a file system of a few hundred KiB in memory, seen by one process alone."""

import json
import shutil
import subprocess
import sys

import pytest

from .conftest import LABELS

SEGMENTS = ("--set", "fusion.images_per_segment=1")

PROGRAM = """
import json, os, pathlib, subprocess, sys
disk, arguments, free_kib = pathlib.Path("disk"), {arguments!r}, {free_kib!r}
disk.mkdir()
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=32m", "tmpfs", str(disk)], check=True)

def hdmap(*given):
    program = "from hdmap_tools.cli.main import main; main()"
    run = subprocess.run([sys.executable, "-c", program, *given], capture_output=True, text=True)
    return run.returncode, run.stderr

def left_kib():
    found = os.statvfs(disk)
    return found.f_bavail * found.f_frsize // 1024

from hdmap_tools.fusion.semantic_map import SemanticMap
def told(path):
    made = SemanticMap.open(path)
    return [version.message for version in made.history()], made.read()

results = {{}}
if {beside!r}:  # a map that is there already must stay readable
    results["before"] = hdmap("build", "drive", "-o", "disk/earlier", *arguments)
filler = disk / "filler"
with filler.open("wb") as file:
    while left_kib() > free_kib:
        file.write(bytes(1024 * min(64, left_kib() - free_kib)))
        file.flush()
results["full"] = hdmap({command!r}, *{operands!r}, "-o", "disk/map", *({command!r} == "build") * arguments)
results["left"] = sorted(path.name for path in disk.iterdir())
results["is_there"] = (disk / "map").exists()
if {beside!r}:
    results["earlier"] = told(disk / "earlier")[0]
filler.unlink()
results["again"] = hdmap({command!r}, *{operands!r}, "-o", "disk/map", *({command!r} == "build") * arguments)
messages, counts = told(disk / "map")
results["messages"], results["equal"] = messages, bool(counts.equals(told(pathlib.Path("whole"))[1]))
print(json.dumps(results))
"""


def own_disk(street, **given):
    """What the program found, in a process that may mount."""
    if shutil.which("unshare") is None:
        pytest.skip("needs unshare")
    arguments = list((*LABELS, *SEGMENTS))
    program = PROGRAM.format(arguments=arguments, **given)
    run = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", sys.executable, "-c", program],
        cwd=street,
        capture_output=True,
        text=True,
    )
    if run.returncode and ("unshare" in run.stderr or "mount" in run.stderr):
        pytest.skip(f"may not mount here: {run.stderr.strip().splitlines()[-1]}")
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.parametrize("free_kib", [0, 60, 140])
def test_a_build_says_that_the_disk_is_full_and_goes_on_when_it_is_not(street, hdmap, free_kib):
    code, _, err = hdmap("build", "drive", "-o", "whole", *LABELS, *SEGMENTS)
    assert code == 0, err
    found = own_disk(street, command="build", operands=["drive"], free_kib=free_kib, beside=False)
    code, err = found["full"]
    assert code == 1, err
    assert "space" in err.lower()
    assert "Traceback" not in err
    assert not found["is_there"]
    assert found["again"][0] == 0, found["again"]
    assert found["equal"]
    assert len(found["messages"]) == 4  # each segment once, whatever was done before


def test_a_map_on_a_full_disk_can_be_read(street, hdmap):
    code, _, err = hdmap("build", "drive", "-o", "whole", *LABELS, *SEGMENTS)
    assert code == 0, err
    found = own_disk(street, command="merge", operands=["disk/earlier"], free_kib=8, beside=True)
    code, err = found["full"]
    assert code == 1, err
    assert "space" in err.lower()
    assert not found["is_there"]
    assert found["left"] == ["earlier", "filler"]
    assert len(found["earlier"]) == 4
    assert found["equal"]
