"""Time and peak memory by the length of the drive, and with two workers in place of one.

`make bench ARGS=tests/benchmarks/test_scaling.py` takes about an hour on two cores; it writes
``.benchmarks/scaling.json`` and ``scaling.png``.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.label_png import read_label_png, write_label_png

from .long_street import SPEED_MPS, write_long_street

LENGTHS_M = (250, 500, 1000, 2000, 5000, 10000)
OUT = Path(__file__).parents[2] / ".benchmarks"
PROGRAM = """
import json, resource, sys, time
from hdmap_tools.cli.main import main
begin = time.perf_counter()
sys.argv[0] = "hdmap"
try:
    main()
except SystemExit as end:
    code = end.code or 0
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({"s": time.perf_counter() - begin, "mib": used.ru_maxrss / 1024, "code": code}), file=sys.stderr)
"""


def hdmap(*arguments: object) -> dict[str, float]:
    """Seconds and peak memory (MiB, of the process that was started) of a command."""
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, arguments)], capture_output=True, text=True
    )
    found = json.loads(run.stderr.strip().splitlines()[-1])
    assert found["code"] == 0, run.stderr
    return found


def measured(folder: Path, length_m: float, *more: object, **street: float) -> dict[str, float]:
    """Both steps of a street of some length."""
    write_long_street(folder, length_m, **street)
    quiet = ("-q", "--overwrite")
    drive, labels, points = folder / "drive", folder / "labels", folder / "points"
    made = hdmap("points", drive, "-o", points, "--no-refine-poses", *quiet)
    given = ("--labels", labels, "--points", points, "--resolution", "0.2")
    built = hdmap("build", drive, "-o", folder / "map", *given, *quiet, *more)
    return {
        "length_m": length_m,
        "points_s": made["s"],
        "points_mib": made["mib"],
        "build_s": built["s"],
        "build_mib": built["mib"],
    }


@pytest.mark.slow
def test_memory_does_not_grow_with_the_drive(tmp_path):
    """Small: two images and two sweeps a second, 16 rings; segments as long as at 13 images a second."""
    street = {"rings": 16, "camera_hz": 2.0, "lidar_hz": 2.0}
    segments = ("--set", "fusion.images_per_segment=37")
    short = measured(tmp_path / "short", 800, *segments, **street)
    long = measured(tmp_path / "long", 3000, *segments, **street)
    for step in ("points", "build"):
        assert long[f"{step}_mib"] <= 1.2 * short[f"{step}_mib"], (step, short, long)


@pytest.mark.slow
def test_a_memory_budget_holds(tmp_path):
    """With 124 labels, all of which occur, a tile takes 67 MB, and the segment has two dozen."""
    write_long_street(tmp_path, 250, rings=16, camera_hz=2.0, lidar_hz=4.0)
    drive, labels, points = (tmp_path / name for name in ("drive", "labels", "points"))
    label_set = load_label_set("mapillary-vistas-124")
    (labels / "label_set.json").write_text(label_set.model_dump_json())
    some = next(labels.glob("*/*.png"))
    shape = read_label_png(some).shape
    ids = np.random.default_rng(0).integers(0, len(label_set), shape).astype(np.uint8)
    write_label_png(tmp_path / "noise.png", ids)
    some.write_bytes((tmp_path / "noise.png").read_bytes())  # one file with many names
    hdmap("points", drive, "-o", points, "--no-refine-poses", "-q")
    given = ("--labels", labels, "--points", points, "-q", "--resolution", "0.1")
    free = hdmap("build", drive, "-o", tmp_path / "free", *given)
    bound = hdmap("build", drive, "-o", tmp_path / "bound", *given, "--memory", "1.4GB")
    assert free["mib"] * 2**20 > 1.8e9
    assert bound["mib"] * 2**20 < 1.4e9
    one, other = (SemanticMap.open(tmp_path / name) for name in ("free", "bound"))
    assert one.tile_indices() == other.tile_indices()
    for a, b in zip(one.tiles(one.tile_indices()), other.tiles(one.tile_indices()), strict=True):
        assert a.equals(b)


@pytest.mark.benchmark_suite
def test_scaling(tmp_path):
    rows = []
    for length_m in LENGTHS_M:
        rows.append(measured(tmp_path / str(length_m), length_m))
        sys.stderr.write(f"\nload {os.getloadavg()[0]:.1f} {json.dumps(rows[-1])}")
    OUT.mkdir(exist_ok=True)
    fits = {step: linear_fit(rows, f"{step}_s") for step in ("points", "build")}
    document = {"rows": rows, "fits": fits}
    (OUT / "scaling.json").write_text(json.dumps(document, indent=2) + "\n")
    plot(rows, fits)
    one_km = next(row for row in rows if row["length_m"] == 1000)
    for step in ("points", "build"):
        assert rows[-1][f"{step}_mib"] <= 1.2 * one_km[f"{step}_mib"]
        assert fits[step]["r2"] > 0.99


@pytest.mark.benchmark_suite
def test_two_workers(tmp_path):
    write_long_street(tmp_path, 5000)  # starting takes seven seconds with any number
    drive, points = tmp_path / "drive", tmp_path / "points"
    hdmap("points", drive, "-o", points, "--no-refine-poses", "-q")
    given = ("--labels", tmp_path / "labels", "--points", points, "--resolution", "0.2", "-q")
    seconds = {
        number: hdmap("build", drive, "-o", tmp_path / f"map{number}", *given, "--workers", number)[
            "s"
        ]
        for number in (1, 2)
    }
    ratio = seconds[1] / seconds[2]
    sys.stderr.write(
        f"\nload {os.getloadavg()[0]:.1f} workers {json.dumps(seconds)} ratio {ratio:.2f}"
    )
    one, two = (SemanticMap.open(tmp_path / f"map{number}").read() for number in (1, 2))
    assert one.tiles.keys() == two.tiles.keys()
    for index, tile in one.tiles.items():
        for name, layer in tile.layers.items():
            np.testing.assert_array_equal(layer, two.tiles[index].layers[name])
    assert ratio >= 1.6


def linear_fit(rows, column):
    """Seconds a kilometre, seconds at length 0, and how much of the scatter a line explains."""
    x = np.array([row["length_m"] for row in rows]) / 1000.0
    y = np.array([row[column] for row in rows])
    slope, offset = np.polyfit(x, y, 1)
    left = y - slope * x - offset
    return {
        "s_per_km": float(slope),
        "s_at_0": float(offset),
        "r2": float(1 - left.var() / y.var()),
    }


def plot(rows, fits):
    """``scaling.png``."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    km = np.array([row["length_m"] for row in rows]) / 1000.0
    for step in ("points", "build"):
        fit = fits[step]
        (line,) = left.plot(km, [row[f"{step}_s"] for row in rows], "o", label=f"hdmap {step}")
        left.plot(km, fit["s_at_0"] + fit["s_per_km"] * km, color=line.get_color())
        right.plot(km, [row[f"{step}_mib"] / 1024 for row in rows], "o-", label=f"hdmap {step}")
    left.plot(km, 1000.0 * km / SPEED_MPS, "k--", label="the drive itself")
    left.set(xlabel="drive, km", ylabel="s")
    right.set(xlabel="drive, km", ylabel="peak memory, GiB", ylim=(0, None))
    left.legend()
    right.legend()
    figure.savefig(OUT / "scaling.png", dpi=110)
