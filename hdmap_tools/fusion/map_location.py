"""Where a semantic map lies: a folder, or a prefix in a bucket of S3."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from hdmap_tools.errors import ConfigError

MAIN: Final = "main"
"""Branch of a repository that holds the finished map, and the only one of a local repository."""

_SCHEME: Final = "s3://"
_ADDRESS: Final = re.compile(
    r"s3://(?P<bucket>[A-Za-z0-9][A-Za-z0-9._-]+)/(?P<prefix>[^/]+(/[^/]+)*)/?"
)


@dataclass(frozen=True)
class S3Location:
    """A prefix under which a map's repository lies.

    Attributes:
        bucket: Must exist.
        prefix: Without slash at its ends, not empty.
        branch: `MAIN`, or one on which a map is made before it becomes the finished one.
    """

    bucket: str
    prefix: str
    branch: str = MAIN

    def __str__(self) -> str:
        return f"{_SCHEME}{self.bucket}/{self.prefix}"

    @property
    def name(self) -> str:
        """Last part of the prefix, as a folder's name is that of its path."""
        return self.prefix.rpartition("/")[2]

    def on_branch(self, branch: str) -> S3Location:
        """The same place, another branch."""
        return replace(self, branch=branch)


MapLocation = Path | S3Location


def is_s3_address(text: str) -> bool:
    """Whether a text names a place in S3, well or badly."""
    return text.lower().startswith(_SCHEME)


def map_location(text: str) -> MapLocation:
    """The place that a text names: ``s3://bucket/prefix``, or the path of a folder.

    Raises:
        ConfigError: If an address in S3 lacks its bucket or prefix.
    """
    if not is_s3_address(text):
        return Path(text)
    found = _ADDRESS.fullmatch(text)
    if found is None:
        raise ConfigError(
            f"{text!r} is no address of a map in S3; expected s3://BUCKET/PREFIX, for example "
            "s3://my-bucket/maps/monday."
        )
    return S3Location(found["bucket"], found["prefix"])


def branch_of(location: MapLocation) -> str:
    """The branch of its repository that a location means."""
    return MAIN if isinstance(location, Path) else location.branch
