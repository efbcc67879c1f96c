"""How much faster than the drive lasted: the point map from its sweeps, the map from its label images.

Simulated, 13 images and 10 sweeps of 64 rings a second as on the paper's vehicle (its lidar
had 16). The command line is run as a user would, start-up, reading and writing included; the
label images are there already.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hdmap_tools.simulate.drive import simulate_drive
from hdmap_tools.simulate.read_world import shipped_world
from hdmap_tools.simulate.settings import LidarPreset, SimulationSettings

LENGTH_M, SPEED_MPS = 400.0, 8.0
POINTS_FASTER, MAP_FASTER = 10.0, 20.0


def hdmap(*arguments: object) -> float:
    """Seconds that a command takes."""
    program = "from hdmap_tools.cli.main import main; main()"
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", program, *map(str, arguments)], check=True)
    return time.perf_counter() - begin


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with its label images in ``labels`` beside it."""
    root = tmp_path_factory.mktemp("speed")
    settings = SimulationSettings(
        seed=5,
        length_m=LENGTH_M,
        speed_mps=SPEED_MPS,
        camera_hz=13.0,
        lidar=LidarPreset.RINGS64,
        true_map=False,
    )
    simulate_drive(shipped_world(), root / "drive", settings)
    hdmap("segment", root / "drive", "-o", root / "labels", "--model", "simulated", "-q")
    return root


@pytest.mark.benchmark_suite
def test_building_is_many_times_faster_than_driving(drive: Path) -> None:
    from hdmap_tools.readers.av2 import read_av2

    trajectory = read_av2(drive / "drive").trajectory
    lasted_s = float(trajectory.timestamps_ns[-1] - trajectory.timestamps_ns[0]) / 1e9
    root, figures = drive, {"drive_s": round(lasted_s, 1)}
    quiet = ("-q", "--overwrite")
    points = ("points", root / "drive", "-o", root / "points", "--no-refine-poses", *quiet)
    build = (
        *("build", root / "drive", "-o", root / "map", "--labels", root / "labels"),
        *("--points", root / "points", "--resolution", "0.2", *quiet),
    )
    for name, arguments in (("points", points), ("map", build)):
        seconds = min(hdmap(*arguments) for _ in range(2))
        figures[f"{name}_s"] = round(seconds, 2)
        figures[f"{name}_times_faster"] = round(lasted_s / seconds, 1)
    sys.stderr.write(f"\nload {os.getloadavg()[0]:.1f} {json.dumps(figures)}\n")
    assert figures["points_times_faster"] >= POINTS_FASTER
    assert figures["map_times_faster"] >= MAP_FASTER
