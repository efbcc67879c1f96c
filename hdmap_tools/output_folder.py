"""A result folder that is either whole or not there."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from hdmap_tools.errors import OutputExistsError, StoreError
from hdmap_tools.fusion.semantic_map import is_semantic_map

MARKER: Final = "hdmap.yaml"
"""Each result folder holds the configuration it was made with; no other folder is ever replaced."""


def is_result(path: Path) -> bool:
    """Whether a folder is a result of ours."""
    return (path / MARKER).is_file()


def require_free(path: Path, overwrite: bool, is_ours: Callable[[Path], bool] = is_result) -> None:
    """Refuse an output folder that exists, unless it is an older result that may be replaced.

    Raises:
        OutputExistsError: With what was found and what to do.
    """
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if path.is_dir() and is_ours(path):
        if overwrite:
            return
        raise OutputExistsError(
            f"{path} exists already; add --overwrite to replace it, or choose another folder."
        )
    raise OutputExistsError(
        f"{path} exists and is not a result of this command, so it is left alone; choose another name."
    )


@contextlib.contextmanager
def output_folder(
    path: Path, overwrite: bool, is_ours: Callable[[Path], bool] = is_result
) -> Iterator[Path]:
    """Give a temporary folder that takes the output's name when the block ends without an error.

    Args:
        path: The folder to make.
        overwrite: Whether an older result may be replaced.
        is_ours: Knows an older result; nothing else is ever replaced.

    Raises:
        OutputExistsError: As `require_free`.
        StoreError: If the folder cannot be made.
    """
    path = Path(os.path.abspath(path))
    require_free(path, overwrite, is_ours)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        parent = tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".partial", dir=path.parent)
        temporary = Path(parent) / path.name
        temporary.mkdir()
    except OSError as error:
        raise StoreError(
            f"Cannot make a folder beside {path}: {error.strerror or error}."
        ) from error
    try:
        yield temporary
        require_free(path, overwrite, is_ours)  # someone may have been quicker
        if path.exists():
            path.rename(Path(parent) / "replaced")
        temporary.rename(path)
    finally:
        shutil.rmtree(parent, ignore_errors=True)


@contextlib.contextmanager
def map_folder(path: Path, overwrite: bool) -> Iterator[Path]:
    """The same for a semantic map, which makes its own folder: nothing is there yet."""
    with output_folder(path, overwrite, is_semantic_map) as folder:
        folder.rmdir()
        yield folder
