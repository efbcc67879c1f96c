"""Checkpoints that are whole or not there: a run may be killed at any moment.

A file is ``HDMAPCK1``, the SHA-256 of the rest, and what torch saves. The one before the
newest is kept, so there is always one to go on from.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import pickle
from pathlib import Path
from typing import Any, Final

import torch

from hdmap_tools.errors import CheckpointError

_log = logging.getLogger(__name__)

CHECKPOINT: Final = "checkpoint.pt"
PREVIOUS: Final = "checkpoint-previous.pt"
BEST: Final = "best.pt"
_MAGIC: Final = b"HDMAPCK1"
_HEAD: Final = len(_MAGIC) + hashlib.sha256().digest_size


def write_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Make a state the newest of a run, and keep the newest so far as the previous one.

    Raises:
        CheckpointError: If it cannot be written (disk full, no permission).
    """
    newest = folder / CHECKPOINT
    temporary = _written(newest, state)
    try:
        # Killed between the two, the run goes on from the previous one.
        if newest.exists():
            os.replace(newest, folder / PREVIOUS)
        os.replace(temporary, newest)
        _sync_folder(folder)
    except OSError as error:
        raise _refused(newest, error) from error


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Replace one file by a state in one step.

    Raises:
        CheckpointError: If it cannot be written.
    """
    temporary = _written(path, state)
    try:
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise _refused(path, error) from error


def read_checkpoint(folder: Path) -> dict[str, Any]:
    """The newest whole state of a run; with a warning where that is the previous one.

    Raises:
        CheckpointError: If there is none; the message says what is wrong with each.
    """
    problems = []
    for name in (CHECKPOINT, PREVIOUS):
        try:
            state = read_state(folder / name)
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if problems:
            _log.warning("%s Going on from %s.", problems[0], folder / name)
        return state
    raise CheckpointError(
        f"Run {folder} has no checkpoint to go on from: {' '.join(problems)} Start it anew."
    )


def read_state(path: Path) -> dict[str, Any]:
    """A state from its file, on the CPU.

    Raises:
        CheckpointError: If there is none, or it is truncated, damaged, or no checkpoint.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(
            f"Checkpoint {path} cannot be read: {error.strerror or error}."
        ) from error
    if content[: len(_MAGIC)] != _MAGIC:
        found = "is empty" if not content else "does not begin as one"
        raise CheckpointError(f"{path} is no checkpoint of hdmap train: it {found}.")
    payload = content[_HEAD:]
    if hashlib.sha256(payload).digest() != content[len(_MAGIC) : _HEAD]:
        raise CheckpointError(
            f"Checkpoint {path} is truncated or damaged: its {len(content)} bytes do not have the "
            "checksum that it begins with."
        )
    try:
        # Weights only: a checkpoint from elsewhere must not run code.
        state: dict[str, Any] = torch.load(
            io.BytesIO(payload), map_location="cpu", weights_only=True
        )
    except (RuntimeError, pickle.UnpicklingError, EOFError) as error:
        raise CheckpointError(f"Checkpoint {path} cannot be loaded by torch: {error}") from error
    return state


def _written(path: Path, state: dict[str, Any]) -> Path:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getbuffer()
    # One name, so that what a killed run leaves behind is overwritten by the next.
    temporary = path.with_name(f".{path.name}.partial")
    try:
        with temporary.open("wb") as file:
            file.write(_MAGIC + hashlib.sha256(payload).digest())
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise _refused(path, error) from error
    return temporary


def _refused(path: Path, error: OSError) -> CheckpointError:
    return CheckpointError(
        f"Cannot write {path}: {error.strerror or error}; what was there before is unharmed."
    )


def _sync_folder(folder: Path) -> None:
    if os.name == "nt":
        return  # Windows has no descriptors for folders
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
