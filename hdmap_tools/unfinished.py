"""Work that was killed and can go on: kept beside its output until that is whole."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from hdmap_tools.errors import OutputExistsError, StoreError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.output_folder import put_in_place, require_free

_LOG = logging.getLogger(__name__)

_PLAN: Final = "plan.json"
_LOCK: Final = "lock"


def unfinished_folder(path: Path) -> Path:
    """Where the unfinished work on an output lies."""
    path = Path(os.path.abspath(path))
    return path.parent / f".{path.name[:100]}.unfinished"


@contextlib.contextmanager
def resumable_folder(
    path: Path,
    plan: dict[str, Any],
    *,
    overwrite: bool,
    is_ours: Callable[[Path], bool],
    resume: bool = True,
) -> Iterator[Path]:
    """Give a folder in which to make ``folder / path.name``; it gets the output's place in the end.

    What a killed process or an error left there is found again by the next call with the
    same plan. Nothing is kept while the result is not begun.

    Args:
        path: The output.
        plan: What the result follows from; JSON. Work by another plan is not gone on with.
        overwrite: Whether an older result may be replaced.
        is_ours: Knows an older result; nothing else is ever replaced.
        resume: Off, unfinished work is thrown away.

    Raises:
        OutputExistsError: If the output is there, or unfinished work by another plan.
        StoreError: If somebody else is at it, or the folder cannot be written.
    """
    from filelock import FileLock, Timeout

    path = Path(os.path.abspath(path))
    require_free(path, overwrite, is_ours)
    work = unfinished_folder(path)
    try:
        work.mkdir(parents=True, exist_ok=True)
        lock = FileLock(work / _LOCK, timeout=0)
        lock.acquire()
    except Timeout as error:
        raise StoreError(
            f"Another process is making {path} (it holds {work / _LOCK}); wait for it, or choose "
            "another name."
        ) from error
    except OSError as error:
        raise StoreError(f"Cannot make {path}: {error.strerror or error}.") from error
    try:
        _settle(work, path, plan, resume)
        yield work
        require_free(path, overwrite, is_ours)  # someone may have been quicker
        put_in_place(work / path.name, path, work / "replaced")
        shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        if isinstance(error, (StoreError, OutputExistsError)):
            raise
        raise StoreError(
            f"Cannot write {path}: {error.strerror or error}. What is done is kept: make room and give "
            "the same command again."
        ) from error
    finally:
        lock.release()
        if not (work / path.name).exists():
            shutil.rmtree(work, ignore_errors=True)


def _settle(work: Path, path: Path, plan: dict[str, Any], resume: bool) -> None:
    """Leave in the folder only work by this plan."""
    begun = (work / path.name).exists()
    if begun and resume:
        held = _plan_of(work)
        changed = sorted(k for k in held.keys() | plan.keys() if held.get(k) != plan.get(k))
        if changed:
            raise OutputExistsError(
                f"Unfinished work on {path} lies in {work}, done with another {', '.join(changed)}; "
                "give the same command as then, or --no-resume to throw it away."
            )
        _LOG.info("Going on with unfinished work on %s.", path)
        return
    for entry in work.iterdir():
        if entry.name == _LOCK:
            continue
        if entry.is_dir():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    with atomic_output(work / _PLAN, overwrite=True) as temporary:
        temporary.write_text(json.dumps(plan, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def _plan_of(work: Path) -> dict[str, Any]:
    try:
        plan = json.loads((work / _PLAN).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return plan if isinstance(plan, dict) else {}
