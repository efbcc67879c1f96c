"""What stops a command from outside: SIGTERM leaves nothing behind, errors of the system say what to do."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from .conftest import LABELS

# Waits where the drive is fused: by then the temporary folder is there.
WAITING = """
import sys, time
import hdmap_tools.pipeline, hdmap_tools.building
def wait(*_, **__):
    print("fusing", flush=True)
    time.sleep(60)
hdmap_tools.pipeline.build_map = hdmap_tools.building.build_map = wait
from hdmap_tools.cli.main import main
main(sys.argv[1:])
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows ends a process without a signal")
@pytest.mark.parametrize("command", ["run", "build"])
def test_termination_leaves_no_temporary_folder(street, command):
    before = set(street.iterdir())
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING, command, "drive", "-o", "out", *LABELS],
        cwd=street,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout.readline() == "fusing\n", process.stderr.read()
        assert list(street.glob(".out.*"))
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 143
    assert err.splitlines()[-1] == "Terminated."
    assert "Traceback" not in err
    assert {p for p in street.iterdir() if p.name != "cache"} == before


def test_the_caller_s_own_handler_stays(hdmap):
    def own(*_):
        raise AssertionError

    before = signal.signal(signal.SIGTERM, own)
    try:
        hdmap("plugins", "list")
        assert signal.getsignal(signal.SIGTERM) is own
    finally:
        signal.signal(signal.SIGTERM, before)
    hdmap("plugins", "list")
    assert signal.getsignal(signal.SIGTERM) is before


def test_ctrl_c_is_called_so(hdmap, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("hdmap_tools.registry.discover", interrupted)
    code, _, err = hdmap("plugins", "list")
    assert (code, err.split()) == (130, ["Interrupted."])


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (errno.EACCES, ("Permission denied: 'x.osm' (check that it can be read and written;",)),
        (errno.ENOSPC, ("No space left on device", "free some space")),
        (errno.EROFS, ("Read-only file system", "another folder")),
        (errno.EBUSY, ("Device or resource busy: 'x.osm' (-vv shows where)",)),
    ],
)
def test_errors_of_the_system_say_what_to_do(fails, monkeypatch, number, says):
    def failing(*_, **__):
        raise OSError(number, os.strerror(number), "x.osm")

    monkeypatch.setattr("hdmap_tools.registry.discover", failing)
    line = fails("plugins", "list", says=says)
    assert "Errno" not in line
