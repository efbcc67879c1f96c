"""`hdmap evaluate`: simulate what is missing, run the experiment, write tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdmap_tools.config import Config
from hdmap_tools.errors import ConfigError
from hdmap_tools.evaluate.experiment import Evaluated, evaluate_drive
from hdmap_tools.evaluate.pictures import draw_pictures
from hdmap_tools.evaluate.report import DriveEvaluation
from hdmap_tools.output_folder import CONFIG_NAME, result_folder
from hdmap_tools.segmentation.cache import LabelCache
from hdmap_tools.simulate.drive import SimulationProgress, simulate_drive
from hdmap_tools.simulate.read_world import read_world
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.truth_files import TRUTH_FOLDER
from hdmap_tools.steps import Steps

COMMAND: Final = "evaluate"
JSON_NAME: Final = "evaluation.json"
CSV_NAME: Final = "evaluation.csv"
TEXT_NAME: Final = "evaluation.txt"
CONFUSION_NAME: Final = "confusion.json"


@dataclass(frozen=True)
class Preset:
    """An experiment by name.

    Attributes:
        length_m: Of the evaluated drive.
        resolution_m: Cell size.
        calibration_m: Length of each calibration drive.
        num_calibration: How many.
        source: Whose experiment it is.
    """

    length_m: float
    resolution_m: float
    calibration_m: float
    num_calibration: int
    source: str


PRESETS: Final = {
    "paz2020": Preset(
        1100.0,
        0.2,
        300.0,
        2,
        "Paz et al. 2020, Probabilistic Semantic Mapping for Urban Autonomous Driving Applications, "
        "section IV: 1.1 km, d = 0.2 m, five classes, clip 15 m ahead and 10 m to each side",
    )
}

_CALIBRATION_SEED: Final = 1000
"""Calibration drives have seeds from the evaluated one's plus this: other starts, other wear, other traffic."""


def evaluate(
    world_or_drive: Path,
    out: Path,
    config: Config,
    preset: Preset,
    settings: SimulationSettings,
    *,
    calibration: Sequence[Path] = (),
    cache: LabelCache | None = None,
    overwrite: bool = False,
    steps: Steps | None = None,
    progress: SimulationProgress | None = None,
) -> DriveEvaluation:
    """Evaluate on a simulated drive, or on one that is simulated for it.

    Args:
        world_or_drive: A map as `read_world` takes it, or a drive of `hdmap simulate`.
        out: Folder to make: tables, JSON, CSV, pictures, the confusion matrix.
        config: Segmentation, point map, cell size.
        preset: Lengths of simulated drives.
        settings: What simulated drives are like; seed and length of the evaluated one.
        calibration: Other drives to measure confusion on; empty: they are simulated too.
        cache: Where label images are kept.
        overwrite: Replace an earlier result.
        steps: Told of images.
        progress: Told of what is simulated.

    Raises:
        ConfigError: If a drive is given without others to calibrate on.
        HDMapError: Whatever cannot be read, simulated or used.
    """
    steps = steps or Steps()
    with result_folder(out, COMMAND, overwrite) as folder:
        scratch = folder.parent / "scratch"
        scratch.mkdir()
        drive, others = world_or_drive, tuple(calibration)
        if not (drive / TRUTH_FOLDER).is_dir():
            read_world(drive)  # says what is wrong with it before anything is simulated
            with steps.timed("simulate"):
                if not others:
                    others = _simulated_others(drive, scratch, preset, settings, progress)
                drive = simulate_drive(drive, scratch / "drive", settings, progress=progress)
        elif not others:
            raise ConfigError(
                f"{drive} is a drive; give at least one other drive with --calibration, on which "
                "confusion, intensity and temperature are measured."
            )
        evaluated = evaluate_drive(drive, others, scratch, config, cache=cache, steps=steps)
        with steps.timed("pictures"):
            draw_pictures(evaluated, folder, cache)
        _write(evaluated, folder, config)
    return evaluated.evaluation


def _simulated_others(
    world: Path,
    scratch: Path,
    preset: Preset,
    settings: SimulationSettings,
    progress: SimulationProgress | None,
) -> tuple[Path, ...]:
    made = []
    for number in range(preset.num_calibration):
        other = settings.model_copy(
            update={
                "seed": settings.seed + _CALIBRATION_SEED + number,
                "length_m": min(preset.calibration_m, settings.length_m),
                "start": None,
            }
        )
        made.append(
            simulate_drive(world, scratch / f"calibration_{number}", other, progress=progress)
        )
    return tuple(made)


def _write(evaluated: Evaluated, folder: Path, config: Config) -> None:
    evaluation = evaluated.evaluation
    for name, text in (
        (JSON_NAME, evaluation.to_json()),
        (CSV_NAME, evaluation.to_csv()),
        (TEXT_NAME, evaluation.to_text()),
        (CONFUSION_NAME, evaluated.confusion.to_json()),
        (CONFIG_NAME, config.to_yaml()),
    ):
        (folder / name).write_text(text, encoding="utf-8")
