"""The Icechunk repository at a map's location: opened, made, and told from other things.

In S3 nothing can be renamed, so a map is made on a branch beside `MAIN` and becomes the finished
one when `MAIN` is set to it: one conditional write of one small object. A repository whose
`MAIN` has nothing but its first, empty commit holds no finished map.

Access is by the usual environment: AWS_ENDPOINT_URL_S3 or AWS_ENDPOINT_URL, AWS_REGION,
AWS_ACCESS_KEY_ID with AWS_SECRET_ACCESS_KEY, or AWS_PROFILE and a role of the machine.
"""

from __future__ import annotations

import logging
import os
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from hdmap_tools.errors import OutputExistsError, StoreError
from hdmap_tools.fusion.map_location import MAIN, MapLocation, S3Location
from hdmap_tools.fusion.map_store import is_semantic_map, quiet_icechunk, root_cause, store_errors
from hdmap_tools.fusion.s3_errors import why_not_asked

if TYPE_CHECKING:
    import icechunk

_LOG = logging.getLogger(__name__)

_ANSWERS_WITHIN_S: Final = 20.0
"""For the first request; Icechunk's ten tries would take up to a minute."""

_CONNECTS_WITHIN_S: Final = 5.0

_CLOCKS_DIFFER_BY: Final = timedelta(minutes=15)
"""At most: S3 refuses requests that are further off (its error RequestTimeTooSkewed)."""


def is_map_there(location: MapLocation) -> bool:
    """Whether there is a map, on the location's branch.

    Raises:
        StoreError: If S3 cannot be asked.
    """
    if isinstance(location, Path):
        return is_semantic_map(location)
    if not _is_repository(location):
        return False
    with store_errors(f"Cannot read {location}"):
        return tip_of(_opened(location), location.branch) is not None


def open_repository(location: MapLocation) -> icechunk.Repository:
    """The repository of a map.

    Raises:
        StoreError: If there is no map, or S3 cannot be asked.
    """
    if isinstance(location, Path):
        if not is_semantic_map(location):
            found = "something else" if location.exists() else "nothing"
            raise _no_map(location, found)
        return _opened(location)
    if not _is_repository(location):
        raise _no_map(location, "nothing")
    repository = _opened(location)
    if tip_of(repository, location.branch) is None:
        raise _no_map(location, "one that is not finished")
    return repository


def make_repository(location: MapLocation) -> icechunk.Repository:
    """A repository to commit a map to, where there is none yet.

    Raises:
        OutputExistsError: If something is there already.
        StoreError: If S3 cannot be asked.
    """
    icechunk = quiet_icechunk()
    if isinstance(location, Path):
        if location.exists():
            raise OutputExistsError(f"{location} exists already; choose another name.")
        location.parent.mkdir(parents=True, exist_ok=True)
        return icechunk.Repository.create(_storage(location))  # type: ignore[no-any-return]
    if _is_repository(location):
        repository = _opened(location)
    else:
        try:
            repository = icechunk.Repository.create(_storage(location))
        except icechunk.IcechunkError as error:
            if "clean prefix" not in str(error):
                raise
            raise OutputExistsError(
                f"Something that is not a map lies under {location}, so it is left alone; choose another "
                "prefix, or remove it (a build that was killed in its first moment leaves `snapshots`)."
            ) from error
    if tip_of(repository, location.branch) is not None:
        raise OutputExistsError(f"{location} exists already; choose another name.")
    if location.branch not in repository.list_branches():
        repository.create_branch(location.branch, _root_of(repository))
    return repository


def tip_of(repository: icechunk.Repository, branch: str) -> str | None:
    """Id of a branch's newest version; None without the branch, or if it holds nothing yet."""
    if branch not in repository.list_branches():
        return None
    newest = next(iter(repository.ancestry(branch=branch)))
    return None if newest.parent_id is None else newest.id


def discard_branch(location: S3Location) -> None:
    """Remove a branch, if it is there; what it alone holds goes when a map is next published."""
    if not _is_repository(location):
        return
    with store_errors(f"Cannot remove unfinished work on {location}"):
        repository = _opened(location)
        if location.branch in repository.list_branches():
            repository.delete_branch(location.branch)


def publish(location: S3Location, replaced: str | None) -> None:
    """Make what is on the location's branch the finished map, at once, and remove the branch.

    What no version of it needs is removed too, if it is older than clocks may differ: the map
    that it takes the place of, and what killed builds left.

    Args:
        location: With the branch that the map was made on.
        replaced: Version of the finished map when that was begun; None: there was none.

    Raises:
        OutputExistsError: If there is another one now.
        StoreError: If it cannot be written.
    """
    icechunk = quiet_icechunk()
    before = datetime.now(UTC) - _CLOCKS_DIFFER_BY
    with store_errors(f"Cannot finish {location}, the same command tries again"):
        repository = _opened(location)
        made = repository.lookup_branch(location.branch)
        try:
            repository.reset_branch(MAIN, made, from_snapshot_id=replaced or _root_of(repository))
        except icechunk.IcechunkError as error:
            if "conflict" not in str(error):
                raise
            raise OutputExistsError(
                f"{location} was changed by someone else in the meantime; add --overwrite to replace it, "
                "or choose another name."
            ) from error
    try:
        repository.delete_branch(location.branch)
        repository.garbage_collect(before)
    except icechunk.IcechunkError as error:
        _LOG.warning(
            "%s is finished, but what it no longer needs could not be removed: %s.",
            location,
            root_cause(error),
        )


def _no_map(location: MapLocation, found: str) -> StoreError:
    if found == "one that is not finished":
        return StoreError(
            f"The map at {location} is not finished: a build is at it, or was killed; giving that command "
            "again goes on with it."
        )
    return StoreError(f"No semantic map at {location} (found {found}); `hdmap build` makes one.")


def _root_of(repository: icechunk.Repository) -> str:
    """Id of the first, empty commit, which all branches have in common."""
    *_, first = repository.ancestry(branch=MAIN)
    return first.id


def _opened(location: MapLocation) -> icechunk.Repository:
    icechunk = quiet_icechunk()
    with store_errors(f"Cannot open the map at {location}"):
        return icechunk.Repository.open(_storage(location))  # type: ignore[no-any-return]


def _storage(location: MapLocation) -> icechunk.Storage:
    icechunk = quiet_icechunk()
    if isinstance(location, Path):
        return icechunk.local_filesystem_storage(str(location))  # type: ignore[no-any-return]
    endpoint = _endpoint()
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    if endpoint is None:
        return icechunk.s3_storage(  # type: ignore[no-any-return]
            bucket=location.bucket, prefix=location.prefix, region=region, from_env=True
        )
    if not endpoint.startswith(("http://", "https://")):
        raise StoreError(
            f"AWS_ENDPOINT_URL is {endpoint!r}; expected http://HOST:PORT or https://HOST."
        )
    return icechunk.s3_storage(  # type: ignore[no-any-return]
        bucket=location.bucket,
        prefix=location.prefix,
        region=region or "us-east-1",  # part of every signature; other servers seldom have any
        endpoint_url=endpoint,
        allow_http=endpoint.startswith("http://"),
        force_path_style=True,  # HOST/bucket, as bucket.HOST needs names that only AWS has
        from_env=True,
    )


def _endpoint() -> str | None:
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or None


def _require_listening(endpoint: str, location: S3Location) -> None:
    """Try a connection, once: an address with nothing behind it is most often mistyped.

    Raises:
        StoreError: If there is none.
    """
    try:
        url = urlsplit(endpoint)
        port = url.port or (443 if url.scheme == "https" else 80)
        socket.create_connection((url.hostname or "", port), _CONNECTS_WITHIN_S).close()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise StoreError(
            f"Nothing answers for {location} at {endpoint} ({reason}); check AWS_ENDPOINT_URL and the network."
        ) from error


def _is_repository(location: S3Location) -> bool:
    """Whether there is a repository; asked first, so that what is wrong with S3 is said here.

    Raises:
        StoreError: If S3 cannot be asked.
    """
    from zarr.core.sync import sync

    icechunk = quiet_icechunk()
    storage, endpoint = _storage(location), _endpoint()
    server = endpoint or "AWS"
    if endpoint is not None:
        _require_listening(endpoint, location)
    try:
        return bool(sync(icechunk.Repository.exists_async(storage), timeout=_ANSWERS_WITHIN_S))
    except TimeoutError as error:
        raise StoreError(
            f"{server} did not answer within {_ANSWERS_WITHIN_S:g} s, asked for {location}; check "
            "AWS_ENDPOINT_URL, AWS_REGION and the network."
        ) from error
    except icechunk.IcechunkError as error:
        cause = root_cause(error)
        why = why_not_asked(str(error), cause, str(location), location.bucket, server)
        raise StoreError(why or f"{server} cannot be asked for {location}: {cause}.") from error
