"""What a run was started with, kept in its folder, so that it can go on and be exported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hdmap_tools.errors import CheckpointError, brief_problems
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.segmentation.training.presets import TrainPreset

SETTINGS_NAME: Final = "run.json"


class RunSettings(BaseModel):
    """All that a run's result follows from, beside the images themselves.

    Attributes:
        preset: The recipe, with whatever the command line changed in it.
        label_set: What the network shall tell apart.
        seed: Of weights, order and augmentation.
        data: Where the training images come from, as given.
        validation: The same of the validation images.
        num_train: Number of training pairs,
        num_validation: and of validation pairs.
        epochs: Ends the run after so many; None: only time ends it.
        max_minutes: Ends the run after so long; the learning rate then follows the
            clock where that is further along, so such a run cannot be repeated exactly.
        threads: Of the CPU, for one process; sums in other orders differ in the last bits.
        processes: That train together, each on its share of a batch.
        bfloat16: Whether the CPU multiplies in bfloat16.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    schema_version: Literal[1] = 1
    preset: TrainPreset
    label_set: LabelSet
    seed: Annotated[int, Field(ge=0)] = 0
    data: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    num_train: Annotated[int, Field(ge=1)]
    num_validation: Annotated[int, Field(ge=0)] = 0
    epochs: Annotated[int, Field(ge=1)] | None = None
    max_minutes: Annotated[float, Field(gt=0)] | None = None
    threads: Annotated[int, Field(ge=1)] = 1
    processes: Annotated[int, Field(ge=1)] = 1
    bfloat16: bool = False

    @property
    def total_steps(self) -> int | None:
        """Steps after which the run ends; None where only time ends it."""
        if self.epochs is None:
            return None if self.max_minutes is not None else self._steps(self.preset.epochs)
        return self._steps(self.epochs)

    @property
    def validate_every(self) -> int:
        """Steps from one validation to the next."""
        return max(self._steps(self.preset.validate_epochs), self.preset.validate_min_steps)

    def _steps(self, epochs: int) -> int:
        return max(1, -(-epochs * self.num_train // self.preset.batch))

    def progress(self, step: int, elapsed_s: float) -> float:
        """Share (0..1) of the run that is done after so many steps and seconds."""
        shares = [0.0]
        if self.total_steps is not None:
            shares.append(step / self.total_steps)
        if self.max_minutes is not None:
            shares.append(elapsed_s / (60 * self.max_minutes))
        return min(1.0, max(shares))

    def write(self, run: Path) -> None:
        """Keep them in a run's folder."""
        with atomic_output(run / SETTINGS_NAME, overwrite=True) as temporary:
            temporary.write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")


def read_settings(run: Path) -> RunSettings:
    """What a run was started with.

    Raises:
        CheckpointError: If the folder is no run of `hdmap train`.
    """
    path = run / SETTINGS_NAME
    try:
        return RunSettings.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        reason = brief_problems(error)
    except OSError as error:
        reason = f"{SETTINGS_NAME} cannot be read: {error.strerror or error}"
    except (ValueError, RecursionError):
        reason = f"{SETTINGS_NAME} is not JSON"
    raise CheckpointError(f"{run} is no run of hdmap train: {reason}.")


def require_same(run: Path, before: RunSettings, now: RunSettings) -> None:
    """Refuse to go on with settings that are not those of the run.

    Raises:
        CheckpointError: Naming what differs.
    """
    old, new = before.model_dump(), now.model_dump()
    differing = [name for name in old if old[name] != new[name]]
    if not differing:
        return
    if differing == ["preset"]:
        old, new = old["preset"], new["preset"]
        differing = [name for name in old if old[name] != new[name]]
    told = "; ".join(
        f"{name} was {str(old[name])[:80]}, is {str(new[name])[:80]}" for name in differing[:3]
    )
    raise CheckpointError(
        f"Run {run} cannot go on with other settings: {told}. Give none with --resume, which takes "
        "the run's own, or start a new run."
    )
