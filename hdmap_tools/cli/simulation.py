"""What `simulate`, `evaluate` and `demo` share: the world they are given, settings, progress."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hdmap_tools.cli.options import progress_bars

if TYPE_CHECKING:
    from rich.progress import TaskID

    from hdmap_tools.simulate.drive import SimulationProgress
    from hdmap_tools.simulate.settings import SimulationSettings


def world_path(given: Path) -> Path:
    """The file of a world: the path itself, or a world that comes with the package."""
    from hdmap_tools.simulate.read_world import shipped_world, shipped_worlds

    # A file of that name in the working folder is what the person sees, so it wins.
    if not given.exists() and str(given) in shipped_worlds():
        return shipped_world(str(given))
    return given


def settings_of(document: dict[str, Any]) -> SimulationSettings:
    """Settings from options; those that were not given are left out, also in nested documents.

    Raises:
        ConfigError: Naming each option that is wrong.
    """
    from pydantic import ValidationError

    from hdmap_tools.errors import ConfigError, brief_problems
    from hdmap_tools.simulate.settings import SimulationSettings

    try:
        return SimulationSettings.model_validate(_given(document))
    except ValidationError as error:
        raise ConfigError(f"Options: {brief_problems(error, 'the options')}.") from error


def _given(document: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _given(value) if isinstance(value, dict) else value
        for key, value in document.items()
        if value is not None
    }


class SimulationProgressBars:
    """Bars over what a simulation makes, each from when it is first told of."""

    def __init__(self, enabled: bool) -> None:
        self._progress = progress_bars(enabled)
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> SimulationProgress:
        self._progress.start()
        return self._told

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def _told(self, what: str, done: int, total: int) -> None:
        if what not in self._tasks:
            self._tasks[what] = self._progress.add_task(what, total=total)
        self._progress.update(self._tasks[what], completed=done)
