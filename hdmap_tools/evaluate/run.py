"""`hdmap evaluate`: simulate what is missing, run the experiment, write tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdmap_tools.compare.paper import paper_table
from hdmap_tools.config import Config
from hdmap_tools.errors import ConfigError
from hdmap_tools.evaluate.experiment import Evaluated, Learned, evaluate_drive, learn
from hdmap_tools.evaluate.pictures import draw_pictures
from hdmap_tools.evaluate.report import SIMULATED, DriveEvaluation, pooled
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
POOLED_NAME: Final = "pooled.txt"


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


def evaluate_all(
    worlds_or_drives: Sequence[Path],
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
) -> list[DriveEvaluation]:
    """Evaluate each of several worlds or drives; the result of the n-th is in ``out/<n>_<name>``.

    With more than one, the figures over all their cells are in ``out/pooled.txt``. See `evaluate`.
    """
    steps = steps or Steps()
    with result_folder(out, COMMAND, overwrite) as folder:
        learned = None
        if calibration:
            _require_usable(worlds_or_drives)
            scratch = folder.parent / "scratch"
            scratch.mkdir()
            learned = learn(calibration, scratch, config, cache=cache, steps=steps)
        found = [
            evaluate(
                one,
                folder if len(worlds_or_drives) == 1 else folder / f"{number}_{one.stem}",
                config,
                preset,
                settings,
                learned=learned,
                cache=cache,
                scratch=folder.parent / f"scratch_{number}",
                steps=steps,
                progress=progress,
            )
            for number, one in enumerate(worlds_or_drives, 1)
        ]
        if len(found) > 1:
            (folder / POOLED_NAME).write_text(pooled_text(found), encoding="utf-8")
    return found


def pooled_text(evaluations: Sequence[DriveEvaluation]) -> str:
    """The table over the cells of several drives, for people."""
    drives = ", ".join(f"{one.drive} ({one.length_m:.0f} m)" for one in evaluations)
    return f"Over the cells of {drives}.\n{SIMULATED}.\n\n{paper_table(pooled(evaluations))}\n"


def evaluate(
    world_or_drive: Path,
    out: Path,
    config: Config,
    preset: Preset,
    settings: SimulationSettings,
    *,
    learned: Learned | None = None,
    scratch: Path,
    cache: LabelCache | None = None,
    steps: Steps | None = None,
    progress: SimulationProgress | None = None,
) -> DriveEvaluation:
    """Evaluate on a simulated drive, or on one that is simulated for it.

    Args:
        world_or_drive: A map as `read_world` takes it, or a drive of `hdmap simulate`.
        out: Folder: tables, JSON, CSV, pictures, the confusion matrix.
        config: Segmentation, point map, cell size.
        preset: Lengths of simulated drives.
        settings: What simulated drives are like; seed and length of the evaluated one.
        learned: From other drives; None: they are simulated too.
        scratch: Folder to make for simulated drives, point maps and semantic maps.
        cache: Where label images are kept.
        steps: Told of images.
        progress: Told of what is simulated.

    Raises:
        ConfigError: If a drive is given without others to calibrate on.
        HDMapError: Whatever cannot be read, simulated or used.
    """
    steps = steps or Steps()
    out.mkdir(parents=True, exist_ok=True)
    scratch.mkdir()
    _require_usable([world_or_drive])
    drive = world_or_drive
    if not _is_drive(drive):
        others: tuple[Path, ...] = ()
        with steps.timed("simulate"):
            if learned is None:
                others = _simulated_others(drive, scratch, preset, settings, progress)
            drive = simulate_drive(drive, scratch / drive.stem, settings, progress=progress)
        if learned is None:
            learned = learn(others, scratch, config, cache=cache, steps=steps)
    elif learned is None:
        raise ConfigError(
            f"{drive} is a drive; give at least one other drive with --calibration, on which "
            "confusion, intensity and temperature are measured."
        )
    evaluated = evaluate_drive(drive, learned, scratch, config, cache=cache, steps=steps)
    with steps.timed("pictures"):
        draw_pictures(evaluated, out, cache)
    _write(evaluated, out, config)
    return evaluated.evaluation


def _is_drive(path: Path) -> bool:
    return (path / TRUTH_FOLDER).is_dir()


def _require_usable(worlds_or_drives: Sequence[Path]) -> None:
    """Say what is wrong with a world before anything is simulated or measured."""
    for path in worlds_or_drives:
        if not _is_drive(path):
            read_world(path)


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
