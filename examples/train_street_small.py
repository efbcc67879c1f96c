"""Make the network that ships, `street-small`, from nothing: its pictures, its training, its figures.

python -m pip install 'hdmap_tools[train]' roadgen==0.41.0
python examples/train_street_small.py data OUT --mapping-example mapping_example.osm
python examples/train_street_small.py train OUT
python examples/train_street_small.py measure OUT

`data` simulates short drives: OUT/train through made-up towns and Lanelet2's mapping_example.osm
(BSD-3-Clause; lanelet2_maps/res in its repository), a surveyed map; OUT/val through made-up towns
of other seeds; OUT/test through the town that comes with the package. No drive of one part shares
a map or a seed with another part.
It goes on where it was stopped. `train` writes OUT/run and OUT/street-small.onnx, `measure`
OUT/measured-test.json. What was made, with hashes, stands in OUT/data.json.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

PARTS = ("train", "val", "test")
DRAWN_BY = ("hdmap_tools", "numpy", "numba", "open3d-cpu", "opencv-python-headless", "shapely")
TOWNS, GRIDS = range(1, 13), range(1, 9)
VAL_TOWNS, VAL_GRIDS = range(13, 16), range(9, 11)
NUM_MADE_UP = len(TOWNS) + len(GRIDS)
MAPPING_EXAMPLE_SHA256 = "11561c763ed50322185139ec2dd041d6da72e1bd4e5fc3bb66f6b340d92c088f"

DRIVES_A_WORLD, DRIVES_A_VAL_WORLD = 6, 2
NUM_SURVEYED, NUM_TEST = 36, 20
LENGTH_M, SPEED_MPS = 80.0, 8.0
LIGHT = ("clear", "overcast", "haze", "wet", "dusk")
WORN = ("default", "easy", "default", "hard")
RIGS = ("front", "ring6", "front", "front3", "front", "front", "front3", "front", "ring6", "front")
METRES_BETWEEN = {"front": 9.0, "front3": 15.0, "ring6": 25.0}
EPOCHS = 15
"""Half an hour on two cores; counted, because what goes by the clock cannot be repeated."""
HEIGHTS_M = (1.55, 1.3, 1.8, 1.55, 2.1, 1.4, 1.7)


@dataclass(frozen=True)
class Drive:
    """One drive to simulate.

    Attributes:
        part: Of the data: ``train``, ``val`` or ``test``.
        world: The map's name: the one that ships, ``mapping_example``, ``town_N``, ``grid_N``.
        number: Counts the drives of a part; what a drive is like follows from it.
    """

    part: str
    world: str
    number: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.number:03d}-{self.world}"

    @property
    def settings(self) -> dict[str, Any]:
        """As `SimulationSettings` takes them.

        The lists are walked through at such paces that everything meets everything.
        """
        k = self.number
        rig = RIGS[(k + k // NUM_MADE_UP) % len(RIGS)]
        return {
            "seed": 10_000 * (1 + PARTS.index(self.part)) + k,
            "length_m": LENGTH_M,
            "speed_mps": SPEED_MPS,
            "weather": LIGHT[(k + k // len(LIGHT)) % len(LIGHT)],
            "difficulty": WORN[(k + k // NUM_MADE_UP) % len(WORN)],
            "camera_rig": rig,
            # Figures are measured with the cameras that the other experiments have.
            "camera_height_m": HEIGHTS_M[k % len(HEIGHTS_M)] if self.part == "train" else 1.55,
            "camera_hz": SPEED_MPS / METRES_BETWEEN[rig],
            "lidar": "none",
            "true_map": False,
        }


def all_drives() -> list[Drive]:
    """What the network is made of, and measured on."""
    trained = drives_through(made_up(TOWNS, GRIDS), DRIVES_A_WORLD)
    trained += ["mapping_example"] * NUM_SURVEYED
    chosen_by = drives_through(made_up(VAL_TOWNS, VAL_GRIDS), DRIVES_A_VAL_WORLD)
    return [
        *(Drive("train", world, k) for k, world in enumerate(trained)),
        *(Drive("val", world, k) for k, world in enumerate(chosen_by)),
        *(Drive("test", "demo_town", k) for k in range(NUM_TEST)),
    ]


def made_up(towns: range, grids: range) -> list[str]:
    """Names of the worlds of some seeds."""
    return [f"town_{seed}" for seed in towns] + [f"grid_{seed}" for seed in grids]


def drives_through(worlds: list[str], times: int) -> list[str]:
    """The world of each drive: all in turn, several times."""
    return [world for _, world in product(range(times), worlds)]


def make_data(out: Path, mapping_example: Path, processes: int) -> None:
    """Write the worlds and simulate all drives that are not there yet."""
    worlds = make_worlds(out / "worlds", mapping_example)
    drives = all_drives()
    for part in PARTS:
        (out / part).mkdir(parents=True, exist_ok=True)
    missing = [d for d in drives if not (out / d.part / d.name).is_dir()]
    print(f"{len(drives)} drives through {len(worlds)} worlds, {len(missing)} to make")
    begin = time.perf_counter()
    jobs = [(str(worlds[d.world]), str(out / d.part / d.name), d.settings) for d in missing]
    # Each process uses all cores for its rays; what is done on one core alone fills the gaps.
    with ProcessPoolExecutor(processes) as pool:
        for k, name in enumerate(pool.map(simulate, jobs)):
            print(f"{time.perf_counter() - begin:6.0f} s  {k + 1}/{len(jobs)}  {name}", flush=True)
    document = describe_data(out, worlds, drives)
    text = json.dumps(document, indent=2) + "\n"
    (out / "data.json").write_text(text, encoding="utf-8")
    print(text)


def make_worlds(folder: Path, mapping_example: Path) -> dict[str, Path]:
    """The map of each world, by its name; those that are made up are written.

    Raises:
        SystemExit: If mapping_example.osm is missing or another file.
    """
    import make_roadgen_town
    import make_scripted_town

    from hdmap_tools.simulate.read_world import shipped_world

    if not mapping_example.is_file():
        sys.exit(f"There is no map {mapping_example}; give Lanelet2's mapping_example.osm.")
    found = sha256_of_text(mapping_example)
    if found != MAPPING_EXAMPLE_SHA256:
        sys.exit(
            f"{mapping_example} is not the mapping_example.osm that the network learned from: "
            f"SHA-256 {found}, expected {MAPPING_EXAMPLE_SHA256}."
        )
    folder.mkdir(parents=True, exist_ok=True)
    worlds = {"demo_town": shipped_world(), "mapping_example": mapping_example}
    for maker, name, seeds in (
        (make_scripted_town.town, "town", (*TOWNS, *VAL_TOWNS)),
        (make_roadgen_town.town, "grid", (*GRIDS, *VAL_GRIDS)),
    ):
        for seed in seeds:
            path = folder / f"{name}_{seed}.osm"
            path.write_text(maker(seed), encoding="utf-8", newline="\n")
            worlds[f"{name}_{seed}"] = path
    return worlds


def simulate(job: tuple[str, str, dict[str, Any]]) -> str:
    """One drive, in a process of its own."""
    from hdmap_tools.simulate.drive import simulate_drive
    from hdmap_tools.simulate.settings import SimulationSettings

    world, folder, settings = job
    simulate_drive(Path(world), Path(folder), SimulationSettings.model_validate(settings))
    return Path(folder).name


def describe_data(out: Path, worlds: dict[str, Path], drives: list[Drive]) -> dict[str, Any]:
    """How many images there are of what, and hashes to compare with those of another machine.

    ``recipe_sha256`` (maps and settings) is the same everywhere. ``labels_sha256`` (ids of all
    pixels) and ``images_sha256`` (files) are the same again on one machine; another processor or
    other versions of numpy, numba, Embree or the JPEG encoder may round otherwise, which moves
    single pixels.
    """
    labels, images = hashlib.sha256(), hashlib.sha256()
    maps = {k: sha256_of_text(path) for k, path in sorted(worlds.items())}
    document: dict[str, Any] = {"recipe_sha256": recipe_sha256(maps, drives)}
    document |= {"labels_sha256": "", "images_sha256": "", "maps_sha256": maps}
    document["made_with"] = {package: version(package) for package in DRAWN_BY}
    for part in PARTS:
        pixels: Counter[int] = Counter()
        number = 0
        own = [drive for drive in drives if drive.part == part]
        for drive in own:
            folder = out / part / drive.name
            for path in sorted((folder / "sensors" / "cameras").rglob("*.jpg")):
                images.update(path.read_bytes())
                number += 1
            for path in sorted((folder / "truth" / "label_images").rglob("*.png")):
                pixels.update(count_ids(path, labels))
        document[part] = {
            "drives": len(own),
            "worlds": sorted({drive.world for drive in own}),
            "seeds": [own[0].settings["seed"], own[-1].settings["seed"]],
            "images": number,
            "weather": dict(Counter(drive.settings["weather"] for drive in own)),
            "difficulty": dict(Counter(drive.settings["difficulty"] for drive in own)),
            "camera_rig": dict(Counter(drive.settings["camera_rig"] for drive in own)),
            "share_of_pixels": shares(pixels),
        }
    document["labels_sha256"] = labels.hexdigest()
    document["images_sha256"] = images.hexdigest()
    return document


def recipe_sha256(maps_sha256: dict[str, str], drives: list[Drive]) -> str:
    """Of all that the data follows from, but for the version of the simulator."""
    settings = [[drive.part, drive.world, drive.settings] for drive in drives]
    return hashlib.sha256(json.dumps([maps_sha256, settings], sort_keys=True).encode()).hexdigest()


def count_ids(path: Path, digest: Any) -> Counter[int]:
    """Pixels by label of one label image, whose ids the digest takes in."""
    import numpy as np

    from hdmap_tools.segmentation.label_png import read_label_png

    ids = read_label_png(path)
    digest.update(ids.tobytes())
    counts = np.bincount(ids.ravel(), minlength=256)
    return Counter({int(k): int(counts[k]) for k in np.flatnonzero(counts)})


def shares(pixels: Counter[int]) -> dict[str, float]:
    """Of each label of the simulator, in percent."""
    from hdmap_tools.simulate.truth_files import true_label_set

    total = max(sum(pixels.values()), 1)
    names = true_label_set().names
    return {name: round(100.0 * pixels[k] / total, 3) for k, name in enumerate(names) if pixels[k]}


def sha256_of_text(path: Path) -> str:
    """Of a text file, whichever line ends git gave it."""
    return hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()


def sha256(path: Path) -> str:
    """Of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def train(out: Path, options: list[str]) -> None:
    """Run the preset; what is given besides goes to `hdmap train`."""
    run, model = out / "run", out / "street-small.onnx"
    data = (f"drive:{out / 'train'}", "--val", f"drive:{out / 'val'}")
    preset = ("--preset", "small", "--label-set", "street", "--epochs", EPOCHS)
    hdmap("train", *data, "-o", run, *preset, *options)
    hdmap("train", "--export", run, model, "--name", "street-small", "--overwrite")


def hdmap(*arguments: object) -> None:
    """The command line of this very installation."""
    program = "from hdmap_tools.cli.main import main; main()"
    subprocess.run([sys.executable, "-c", program, *map(str, arguments)], check=True)


def measure(out: Path, model: Path, part: str, threads: int) -> None:
    """IoU of each label over all pixels of a part, by weather and such, and milliseconds an image."""
    import numpy as np

    from hdmap_tools.segmentation.measure_confusion import measure_confusion
    from hdmap_tools.segmentation.open_segmenter import open_model
    from hdmap_tools.segmentation.training.pairs import open_drives, relabelled

    segmenter = open_model(model, None, {}, threads=threads)
    taken_s: list[float] = []

    def segment(rgb: Any) -> Any:
        begin = time.perf_counter()
        labels = segmenter.segment_rgb(rgb)
        taken_s.append(time.perf_counter() - begin)
        return labels

    counts: dict[str, Any] = {"all": 0}
    for drive in (drive for drive in all_drives() if drive.part == part):
        pairs = relabelled(open_drives([out / part / drive.name]), segmenter.label_set.name)
        read = (pairs.read(k) for k in range(len(pairs)))
        matrix = measure_confusion(read, segment, pairs.label_set, segmenter.label_set, drive.name)
        told_apart = [drive.settings[k] for k in ("weather", "difficulty", "camera_rig")]
        for group in ("all", *told_apart):
            counts[group] = counts.get(group, 0) + matrix.counts
    names = segmenter.label_set.names
    document = {
        "model": {"name": model.name, "sha256": sha256(model), "bytes": model.stat().st_size},
        "measured_on": part,
        "images": len(taken_s),
        # The first image pays for memory and threads.
        "ms_an_image_median": round(1000.0 * float(np.median(taken_s[1:])), 1),
        "threads": threads,
        "iou": {group: ious(found, names) for group, found in counts.items()},
    }
    text = json.dumps(document, indent=2) + "\n"
    (out / f"measured-{part}.json").write_text(text, encoding="utf-8")
    print(text)


def ious(counts: Any, names: tuple[str, ...]) -> dict[str, float]:
    """Of each label that is there or was said to be, and their mean.

    Args:
        counts: (L, L) pixels, rows true, columns predicted.
        names: Of the L labels.
    """
    hits = counts.diagonal()
    either = counts.sum(axis=0) + counts.sum(axis=1) - hits
    found = {name: float(hits[k] / either[k]) for k, name in enumerate(names) if either[k]}
    mean = sum(found.values()) / len(found)
    return {k: round(iou, 4) for k, iou in {"mean": mean, **found}.items()}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    data = commands.add_parser("data", help="simulate all drives")
    data.add_argument("--mapping-example", type=Path, required=True, help="Lanelet2's map")
    data.add_argument("--processes", type=int, default=os.cpu_count())
    training = commands.add_parser("train", help="train on them, and export the network")
    measuring = commands.add_parser("measure", help="measure it on the world it never saw")
    measuring.add_argument("--model", type=Path, help="by default OUT/street-small.onnx")
    measuring.add_argument("--part", choices=PARTS, default="test")
    measuring.add_argument("--threads", type=int, default=2)
    for command in (data, training, measuring):
        command.add_argument("out", type=Path, help="folder of everything that is made")
    given, others = parser.parse_known_args()
    if others and given.command != "train":
        parser.error(f"unknown: {' '.join(others)}")
    if given.command == "data":
        make_data(given.out, given.mapping_example, given.processes)
    elif given.command == "train":
        train(given.out, others)
    else:
        measure(
            given.out, given.model or given.out / "street-small.onnx", given.part, given.threads
        )


if __name__ == "__main__":
    main()
