"""Folders and files that cannot be read, said in the words of a drive."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hdmap_tools.errors import DriveError, HDMapError
from hdmap_tools.readers.checks import shown


@contextmanager
def os_errors_are_drive_errors() -> Iterator[None]:
    """Turn what the operating system refuses into a `DriveError`; also a decorator."""
    try:
        yield
    except HDMapError:
        raise
    except PermissionError as error:
        raise DriveError(_denied(error.filename)) from error
    except OSError as error:
        raise DriveError(
            f"The drive cannot be read: {error.strerror or type(error).__name__}: "
            f"{shown(str(error.filename))}."
        ) from error


def require_listable(path: Path, depth: int = 2) -> None:
    """Refuse a folder that may not be listed or entered, itself or one below it.

    `Path.glob` passes over such folders without a word, so that a drive behind one
    seems not to exist.

    Raises:
        DriveError: With the folder.
    """
    try:
        os.stat(os.path.join(path, os.curdir))  # needs the right to enter, listing does not
        with os.scandir(path) as entries:
            folders = sorted(entry.path for entry in entries if entry.is_dir())
    except PermissionError as error:
        raise DriveError(_denied(path)) from error
    except OSError:
        return  # vanished meanwhile, or a loop of links: there is no drive in it
    if depth:
        for folder in folders:
            require_listable(Path(folder), depth - 1)


def _denied(path: object) -> str:
    return (
        f"{shown(str(path))} cannot be read: permission denied. Give yourself the right to read "
        "and enter it."
    )
