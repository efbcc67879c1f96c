"""Output that is either whole or not there."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from hdmap_tools.errors import FormatError, HDMapError, OutputExistsError


@contextlib.contextmanager
def atomic_output(
    path: str | os.PathLike[str],
    overwrite: bool = False,
    *,
    validate: Callable[[Path], None] | None = None,
) -> Iterator[Path]:
    """Give a temporary path to write to, which becomes the output if nothing goes wrong.

    The temporary file lies in a folder of its own beside the output (same file
    system, and what a driver leaves beside its file goes with it). It is synced to
    disk and validated before it takes the output's name in one step, so a reader
    sees the old file or the new one. A symbolic link is followed: its target is replaced.

    Args:
        path: Where the output shall be.
        overwrite: Whether an existing file may be replaced.
        validate: Called with the temporary path; raises to refuse it.

    Yields:
        The path to write to; nothing is there yet.

    Raises:
        OutputExistsError: If the output exists and overwrite is False, or it is a folder.
        FormatError: If the system refuses to write (no such folder, no permission, disk full).
    """
    given = Path(path)
    target = Path(os.path.realpath(given))
    _refuse_existing(target, given, overwrite)
    if not target.parent.is_dir():
        raise FormatError(
            f"Cannot write {given}: the folder {target.parent} does not exist; make it."
        )
    try:
        folder = Path(
            tempfile.mkdtemp(prefix=f".{target.name[:100]}.", suffix=".tmp", dir=target.parent)
        )
    except OSError as error:
        raise FormatError(f"Cannot write {given}: {error.strerror or error}.") from error
    try:
        temporary = folder / target.name
        yield temporary
        _sync(temporary)
        if validate is not None:
            validate(temporary)
        _refuse_existing(target, given, overwrite)  # someone may have been quicker
        os.replace(temporary, target)
        _sync(target.parent)
    except HDMapError:
        raise
    except OSError as error:
        raise FormatError(
            f"Cannot write {given}: {error.strerror or error}; nothing was changed."
        ) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _refuse_existing(target: Path, given: Path, overwrite: bool) -> None:
    if target.is_dir():
        raise OutputExistsError(f"{given} is a folder, expected a file name; choose another name.")
    if target.exists() and not overwrite:
        raise OutputExistsError(f"{given} exists; use --overwrite to replace it.")


def _sync(path: Path) -> None:
    if path.is_dir() and os.name == "nt":
        return  # Windows has no descriptors for folders
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
