"""A result folder that is either whole or not there."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from hdmap_tools.errors import OutputExistsError, StoreError
from hdmap_tools.fusion.map_store import is_semantic_map

MARKER: Final = ".hdmap-result.json"
"""Says which command made a folder, and what it wrote into it."""

CONFIG_NAME: Final = "hdmap.yaml"
"""The configuration that a result was made with."""


def require_free(path: Path, overwrite: bool, is_ours: Callable[[Path], bool]) -> None:
    """Refuse an output folder that exists, unless it is an older result that may be replaced.

    Raises:
        OutputExistsError: With what was found and what to do.
    """
    if not os.path.lexists(path):
        return
    if path.is_dir() and not path.is_symlink():
        if not any(path.iterdir()):
            return
        if is_ours(path):
            if overwrite:
                return
            raise OutputExistsError(
                f"{path} exists already; add --overwrite to replace it, or choose another name."
            )
    raise OutputExistsError(
        f"{path} exists and is not (only) a result of this command, so it is left alone; choose "
        "another name."
    )


def is_result_of(command: str) -> Callable[[Path], bool]:
    """A check that a folder was made by a command and holds nothing that it did not write.

    A folder into which somebody put files of his own is not replaced.
    """

    def is_ours(path: Path) -> bool:
        try:
            made = json.loads((path / MARKER).read_text(encoding="utf-8"))
            written = {MARKER, *made["entries"]}
            return made["command"] == command and {p.name for p in path.iterdir()} <= written
        except (OSError, ValueError, KeyError, TypeError):
            return False

    return is_ours


@contextlib.contextmanager
def result_folder(path: Path, command: str, overwrite: bool) -> Iterator[Path]:
    """`replaced_when_done` for the result of a command, marked so that it can be replaced later."""
    with replaced_when_done(path, overwrite, is_result_of(command)) as folder:
        yield folder
        entries = sorted(p.name for p in folder.iterdir())
        document = json.dumps({"command": command, "entries": entries}, indent=2)
        (folder / MARKER).write_text(document + "\n", encoding="utf-8")


@contextlib.contextmanager
def map_folder(path: Path, overwrite: bool) -> Iterator[Path]:
    """`replaced_when_done` for a semantic map, which makes its own folder: nothing is there yet."""
    with replaced_when_done(path, overwrite, is_semantic_map) as folder:
        folder.rmdir()
        yield folder


@contextlib.contextmanager
def replaced_when_done(
    path: Path, overwrite: bool, is_ours: Callable[[Path], bool]
) -> Iterator[Path]:
    """Give a temporary folder that takes the output's name when the block ends without an error.

    Args:
        path: The folder to make.
        overwrite: Whether an older result may be replaced.
        is_ours: Knows an older result; nothing else is ever replaced.

    Raises:
        OutputExistsError: As `require_free`.
        StoreError: If the folder cannot be made or written.
    """
    path = Path(os.path.abspath(path))
    require_free(path, overwrite, is_ours)
    made = [folder for folder in path.parents if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        parent = Path(
            tempfile.mkdtemp(prefix=f".{path.name[:100]}.", suffix=".partial", dir=path.parent)
        )
        temporary = parent / path.name
        temporary.mkdir()
    except OSError as error:
        raise StoreError(f"Cannot make {path}: {error.strerror or error}.") from error
    try:
        yield temporary
        require_free(path, overwrite, is_ours)  # someone may have been quicker
        put_in_place(temporary, path, parent / "replaced")
    except OSError as error:
        if isinstance(error, (StoreError, OutputExistsError)):
            raise
        raise StoreError(
            f"Cannot write {path}: {error.strerror or error}. Nothing was changed; check free space and "
            "permissions."
        ) from error
    finally:
        shutil.rmtree(parent, ignore_errors=True)
        with contextlib.suppress(OSError):  # stops where something is in them
            for folder in made:
                folder.rmdir()


def put_in_place(made: Path, path: Path, aside: Path) -> None:
    """Rename a folder to its place; what was there comes back if that fails."""
    had_older = path.exists()
    if had_older:
        path.rename(aside)
    try:
        made.rename(path)
    except BaseException:
        if had_older:
            aside.rename(path)
        raise
