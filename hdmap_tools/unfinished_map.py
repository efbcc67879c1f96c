"""A semantic map that is whole or not there, wherever it is made, and goes on after a kill.

In a folder, unfinished work lies beside the output and takes its name in the end. In S3 it
lies on a branch of the map's repository: readers see the earlier map, or none, until the
finished one takes its place in one write. What it is made from is kept, as digests, with its
first version, so that only the same build goes on with it. No lock is held: of two processes
at one map, the first to commit goes on and the other fails at its next commit.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from hdmap_tools.errors import OutputExistsError
from hdmap_tools.fusion.map_location import MapLocation, S3Location
from hdmap_tools.fusion.map_repository import (
    discard_branch,
    is_map_there,
    open_repository,
    publish,
    tip_of,
)
from hdmap_tools.fusion.map_store import is_semantic_map
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.output_folder import map_folder, require_free
from hdmap_tools.unfinished import resumable_folder

_LOG = logging.getLogger(__name__)

_BUILDING: Final = "unfinished"
_MERGING: Final = "merging"
"""Not `_BUILDING`: a merge must not throw an unfinished build away."""

_MADE_FROM: Final = "made_from"


@dataclass(frozen=True)
class UnfinishedMap:
    """A map that is being made.

    Attributes:
        location: Where: a map is there if it was begun before.
        scratch: Folder of this machine for what is needed on the way.
        note: Goes into the metadata of its first version.
    """

    location: MapLocation
    scratch: Path
    note: dict[str, Any] = field(default_factory=dict)


def require_free_for_map(out: MapLocation, overwrite: bool) -> None:
    """Refuse a place where something is, unless it is a map that may be replaced.

    Raises:
        OutputExistsError: With what was found and what to do.
        StoreError: If S3 cannot be asked.
    """
    if isinstance(out, Path):
        require_free(out, overwrite, is_semantic_map)
    elif is_map_there(out) and not overwrite:
        raise OutputExistsError(
            f"{out} exists already; add --overwrite to replace it, or choose another name."
        )


@contextlib.contextmanager
def resumable_map(
    out: MapLocation, plan: dict[str, Any], *, overwrite: bool, resume: bool
) -> Iterator[UnfinishedMap]:
    """Give a place in which to make a map; it becomes the one at `out` when the block ends.

    Args:
        out: The map to make.
        plan: What it follows from; JSON. Work by another plan is not gone on with.
        overwrite: Whether an older map may be replaced.
        resume: Off, unfinished work is thrown away.

    Raises:
        OutputExistsError: If a map is there, or unfinished work by another plan.
        StoreError: If somebody else is at it, or it cannot be written.
    """
    if isinstance(out, Path):
        with resumable_folder(
            out, plan, overwrite=overwrite, is_ours=is_semantic_map, resume=resume
        ) as work:
            yield UnfinishedMap(work / out.name, work)
        return
    require_free_for_map(out, overwrite)
    replaced = _version_at(out)
    begun = out.on_branch(_BUILDING)
    digests = {name: _digest(value) for name, value in plan.items()}
    _settle(begun, replaced, digests, resume)
    with TemporaryDirectory(prefix="hdmap.") as scratch:
        yield UnfinishedMap(begun, Path(scratch), {_MADE_FROM: digests})
    publish(begun, replaced)


@contextlib.contextmanager
def map_when_done(out: MapLocation, overwrite: bool) -> Iterator[MapLocation]:
    """Give a place in which to make a map; it becomes the one at `out` if the block ends well.

    Raises:
        OutputExistsError: If a map is there and may not be replaced, or something else is.
        StoreError: If it cannot be written.
    """
    if isinstance(out, Path):
        with map_folder(out, overwrite) as folder:
            yield folder
        return
    require_free_for_map(out, overwrite)
    replaced = _version_at(out)
    begun = out.on_branch(_MERGING)
    discard_branch(begun)  # what a killed process left
    try:
        yield begun
        publish(begun, replaced)
    except BaseException:
        with contextlib.suppress(Exception):  # what went wrong first is to be told
            discard_branch(begun)
        raise


def _version_at(location: S3Location) -> str | None:
    if not is_map_there(location):
        return None
    return tip_of(open_repository(location), location.branch)


def _settle(begun: S3Location, finished: str | None, digests: dict[str, str], resume: bool) -> None:
    """Leave only unfinished work by this plan."""
    version = _version_at(begun)
    if version is None:
        return
    if not resume or version == finished:  # killed when it had been published already
        discard_branch(begun)
        return
    held = SemanticMap.open(begun).history()[-1].metadata.get(_MADE_FROM, {})
    changed = sorted(k for k in held.keys() | digests.keys() if held.get(k) != digests.get(k))
    if changed:
        raise OutputExistsError(
            f"Unfinished work on {begun} was done with another {', '.join(changed)}; give the same command "
            "as then, or --no-resume to throw it away."
        )
    _LOG.info("Going on with unfinished work on %s.", begun)


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
