"""What a run said of itself: a CSV file, and TensorBoard where it is installed."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from hdmap_tools.errors import FormatError
from hdmap_tools.formats.atomic import atomic_output

_log = logging.getLogger(__name__)

LOG_NAME: Final = "log.csv"


class TrainingLog:
    """Rows by step. A run that goes on from a checkpoint drops the rows after it.

    Args:
        run: Folder of the run.
        columns: All columns; the first is ``step``.
        from_step: Rows up to here stay.
    """

    def __init__(self, run: Path, columns: Sequence[str], from_step: int = 0) -> None:
        self._path = run / LOG_NAME
        self._columns = list(columns)
        self._rows = [row for row in read_log(run) if int(row["step"]) <= from_step]
        self._board = _tensorboard(run, from_step)

    def add(self, values: Mapping[str, float]) -> None:
        """Append a row; what it lacks, and NaN, is an empty field."""
        self._rows.append({name: _text(values.get(name)) for name in self._columns})
        # Whole and in one step: a row is a validation, so there are few.
        with atomic_output(self._path, overwrite=True) as temporary:
            temporary.write_text(self._csv(), encoding="utf-8", newline="")
        if self._board is not None:
            for name, value in values.items():
                if name != "step" and not math.isnan(value):
                    self._board.add_scalar(name, value, int(values["step"]))
            self._board.flush()

    def close(self) -> None:
        """Close TensorBoard's file."""
        if self._board is not None:
            self._board.close()

    def _csv(self) -> str:
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns, lineterminator="\n", extrasaction="ignore")
        writer.writeheader()
        writer.writerows(self._rows)
        return text.getvalue()


def read_log(run: Path) -> list[dict[str, str]]:
    """Rows of a run's log as text; none where there is no log.

    Raises:
        FormatError: If it is no such log.
    """
    path = run / LOG_NAME
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if not all((row.get("step") or "").isdigit() for row in rows):
        raise FormatError(f"{path} is no log of a training: a row has no step. Remove it.")
    return rows


def _text(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else f"{value:.6g}"


def _tensorboard(run: Path, from_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        _log.info("TensorBoard is not installed; the log is %s only.", run / LOG_NAME)
        return None
    return SummaryWriter(str(run / "tensorboard"), purge_step=from_step + 1)
