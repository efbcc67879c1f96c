"""Builds killed at any moment: a hundred times, the same map each time."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hdmap_tools.fusion.semantic_map import SemanticMap

from .long_street import write_long_street

PROGRAM = "import sys; sys.argv[0] = 'hdmap'; from hdmap_tools.cli.main import main; main()"
NUM_KILLS = 100


def build(root: Path, out: str) -> subprocess.Popen[bytes]:
    arguments = ("build", "drive", "-o", out, "--labels", "labels", "--points", "points", "-q")
    arguments += ("--resolution", "0.2", "--set", "fusion.images_per_segment=8")
    command = [sys.executable, "-c", PROGRAM, *arguments]
    return subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


@pytest.mark.benchmark_suite
def test_a_build_killed_at_a_random_moment_ends_with_the_same_map(tmp_path):
    write_long_street(tmp_path, 60, rings=16)
    points = ("points", "drive", "-o", "points", "--no-refine-poses", "-q")
    subprocess.run([sys.executable, "-c", PROGRAM, *points], cwd=tmp_path, check=True)
    begin = time.perf_counter()
    with build(tmp_path, "whole") as undisturbed:
        assert undisturbed.wait() == 0
    lasts_s = time.perf_counter() - begin
    whole = SemanticMap.open(tmp_path / "whole")
    expected, told = whole.read(), [(v.message, v.metadata) for v in whole.history()]
    rng = random.Random(0)
    killed = resumed = 0
    while killed < NUM_KILLS:
        with build(tmp_path, "map") as running:
            time.sleep(rng.uniform(0.0, lasts_s))
            if running.poll() is None:
                os.kill(running.pid, signal.SIGKILL)
                killed += 1
        if running.returncode == -signal.SIGKILL and rng.random() < 0.3:
            continue  # killed again before it is done
        if not (tmp_path / "map").exists():
            again = build(tmp_path, "map")
            said = again.communicate()[0].decode()
            assert again.returncode == 0, said
            resumed += 1
        made = SemanticMap.open(tmp_path / "map")
        assert made.read().equals(expected)
        assert [(v.message, v.metadata) for v in made.history()] == told
        shutil.rmtree(tmp_path / "map")
        assert not list(tmp_path.glob(".map*"))
    sys.stderr.write(f"\n{killed} kills, {resumed} builds that went on, all alike\n")
