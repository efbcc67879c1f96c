"""`hdmap evaluate`: on a small simulated drive, and what it refuses."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hdmap_tools.evaluate.report import DriveEvaluation
from hdmap_tools.simulate.drive import simulate_drive
from hdmap_tools.simulate.read_world import shipped_world
from hdmap_tools.simulate.settings import LidarPreset, SimulationSettings

SMALL = SimulationSettings(
    length_m=25,
    camera_hz=2,
    image_width_px=240,
    image_height_px=150,
    lidar=LidarPreset.VLP16,
)
WRITTEN = {
    *("evaluation.json", "evaluation.csv", "evaluation.txt", "confusion.json", "hdmap.yaml"),
    *("maps.png", "close.png", "local_and_global.png", "reliability.png", ".hdmap-result.json"),
}


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the drives ``drive`` and ``other``, 25 m each, by different seeds."""
    root = tmp_path_factory.mktemp("drives")
    for name, seed in (("drive", 3), ("other", 4)):
        settings = SMALL.model_copy(update={"seed": seed})
        simulate_drive(shipped_world(), root / name, settings)
    return root


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def left_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} - {"cache"}


@pytest.mark.slow
def test_two_runs_give_the_same_and_replace_only_when_asked(hdmap, fails, here, drives):
    given = ("evaluate", drives / "drive", "--calibration", drives / "other", "-o", "out")
    code, out, err = hdmap(*given)
    assert code == 0, err
    assert "SIMULATED" in out
    assert "in the paper" in out
    made = here / "out"
    assert {path.name for path in made.iterdir()} == WRITTEN
    first = {path.name: path.read_bytes() for path in made.iterdir()}
    one = DriveEvaluation.model_validate_json(first["evaluation.json"])
    assert one.calibration == ("av2:other",)
    assert one.length_m == pytest.approx(25, abs=0.5)
    assert first["evaluation.txt"].decode().strip() in out
    assert left_in(here) == {"out"}

    fails(*given, says=("out", "--overwrite"))
    code, _, err = hdmap(*given, "--overwrite")
    assert code == 0, err
    second = {path.name: path.read_bytes() for path in made.iterdir()}
    other = DriveEvaluation.model_validate_json(second["evaluation.json"])
    # All but the seconds that it took is the same, to the last figure.
    assert other.model_copy(update={"seconds": one.seconds}) == one
    for name in WRITTEN - {"evaluation.json"}:
        assert first[name] == second[name], name
    assert left_in(here) == {"out"}


@pytest.mark.slow
def test_what_it_cannot_evaluate_on_is_said_and_nothing_is_left(fails, here, drives):
    drive, other = drives / "drive", drives / "other"
    run = ("evaluate", drive, "-o", "out", "--calibration")
    fails("evaluate", drive, "-o", "out", says=("--calibration",))
    fails(*run, drive, says=("measured on itself",))
    shutil.copytree(other, here / "recorded", ignore=shutil.ignore_patterns("truth"))
    fails(*run, "recorded", says=("recorded", "no truth"))
    shutil.copytree(other, here / "blind")
    for image in (here / "blind" / "sensors" / "cameras").rglob("*.jpg"):
        image.unlink()
    fails(*run, "blind", says=("blind", "image"))
    assert left_in(here) == {"recorded", "blind"}


def test_maps_that_are_no_world_are_refused_before_anything_is_made(fails, here):
    fails("evaluate", "nowhere.osm", "-o", "out", says=("nowhere.osm",))
    (here / "picture.png").write_bytes(b"x")
    fails("evaluate", "picture.png", "-o", "out", says=("picture.png",))
    (here / "out").mkdir()
    (here / "out" / "mine.txt").write_text("keep")
    fails("evaluate", "demo_town", "-o", "out", "--overwrite", says=("left alone",))
    assert (here / "out" / "mine.txt").read_text() == "keep"
    assert left_in(here) == {"picture.png", "out"}


# Waits where the first drive is simulated: by then the temporary folder is there.
WAITING = """
import sys, time
import hdmap_tools.evaluate.run as run
def wait(*_, **__):
    print("simulating", flush=True)
    time.sleep(60)
run.simulate_drive = wait
from hdmap_tools.cli.main import main
main(sys.argv[1:])
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows ends a process without a signal")
def test_a_killed_evaluation_leaves_nothing(here):
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING, "evaluate", "demo_town", "-o", "out"],
        cwd=here,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout.readline() == "simulating\n", process.stderr.read()
        assert list(here.glob(".out.*.partial"))
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 143
    assert "Traceback" not in err
    assert left_in(here) == set()


def test_the_simulated_drives_of_an_evaluation_differ(here, monkeypatch, hdmap):
    """A drive for the figures, others with other seeds for the calibration, all of one kind."""
    made = []

    def noted(_world, out, settings, **_):
        made.append((out.name, json.loads(settings.model_dump_json())))
        if len(made) == 3:
            raise KeyboardInterrupt
        return out

    monkeypatch.setattr("hdmap_tools.evaluate.run.simulate_drive", noted)
    code, _, _ = hdmap(
        *("evaluate", "demo_town", "-o", "out", "--length-m", "50", "--seed", "7"),
        *("--difficulty", "hard", "--pose-noise-m", "0.1"),
    )
    assert code == 130
    assert len({settings["seed"] for _, settings in made}) == 3
    assert {settings["difficulty"] for _, settings in made} == {"hard"}
    assert {settings["pose_errors"]["noise_m"] for _, settings in made} == {0.1}
    assert made[-1][0] == "demo_town"
    assert made[-1][1]["seed"] == 7
    assert left_in(here) == set()
