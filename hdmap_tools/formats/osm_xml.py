"""Reading OSM XML that may be damaged or hostile.

The file is fed in blocks to a parser that builds no tree, so memory is bounded by the
primitives kept. No DTD is ever read: a DOCTYPE is refused where it begins, before any
entity in it is declared, which rules out entity expansion and external entities. A tag,
comment or text of more than 10 MB is refused while it is read: libxml2's own limit of that
size does not hold for attributes fed in blocks (a 1 GB attribute went through, with 2 GB of
memory). Its limit of 256 levels stays on.
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Any, Final

from hdmap_tools.errors import FormatError, HDMapError
from hdmap_tools.formats.osm_document import (
    MAX_ID,
    OsmDocument,
    OsmMember,
    OsmNode,
    OsmRelation,
    OsmWay,
)

MAX_TAG_BYTES: Final = 10_000_000
MAX_HEIGHT_M: Final = 1e5
_BLOCK_BYTES: Final = 1 << 16
_INTEGER = re.compile(r"[+-]?[0-9]{1,19}")


def read_osm(path: str | os.PathLike[str]) -> OsmDocument:
    """Read nodes, ways and relations; those marked ``action="delete"`` are left out and counted.

    Raises:
        FormatError: If the file is not OSM XML, is malformed or truncated (with the line),
            has a DOCTYPE or an oversized tag, defines an id twice, or has an id, reference,
            latitude, longitude or height that is missing or no usable number.
    """
    from lxml import etree

    target = _OsmTarget(str(path))
    # "internal" is for &amp; and its kind alone, as no entity can be declared without a DOCTYPE;
    # with False, libxml2 hands out &amp; in attributes as the five characters &#38;.
    parser = etree.XMLParser(
        target=target, resolve_entities="internal", no_network=True, load_dtd=False, huge_tree=False
    )
    try:
        with Path(path).open("rb") as stream:
            num_quiet_bytes = 0
            while block := stream.read(_BLOCK_BYTES):
                before = target.num_events
                parser.feed(block)
                num_quiet_bytes = 0 if target.num_events > before else num_quiet_bytes + len(block)
                if num_quiet_bytes > MAX_TAG_BYTES:
                    raise FormatError(
                        f"{path} cannot be read: one tag, text or comment is longer than "
                        f"{MAX_TAG_BYTES // 1_000_000} MB, which no map needs; the file is damaged or "
                        "made to exhaust memory."
                    )
        parser.close()
    except HDMapError:
        raise
    except etree.XMLSyntaxError as error:
        if target.error is not None:
            raise target.error from None
        line = f"line {error.lineno}: " if error.lineno else ""
        what = str(error.msg).strip().replace("\n", " ")
        raise FormatError(f"{path} is not well-formed XML, {line}{what}.") from error
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror or error}.") from error
    return target.document


class _OsmTarget:
    """Receives start and end of tags, as lxml's target interface wants it."""

    def __init__(self, source: str) -> None:
        self.document = OsmDocument()
        self.error: FormatError | None = None
        self.num_events = 0
        self._source = source
        self._depth = 0
        self._open: str | None = None  # the primitive we are in
        self._attributes: dict[str, str] = {}
        self._tags: dict[str, str] = {}
        self._refs: list[int] = []
        self._members: list[OsmMember] = []

    def doctype(self, name: str, *_: Any) -> None:
        self._refuse(
            "it has a DOCTYPE, which OSM files never have and which can hide entity attacks; "
            "remove it if you trust the file"
        )

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.num_events += 1
        self._depth += 1
        if self._depth == 1:
            if tag != "osm":
                self._refuse(f"found <{tag[:40]}>, expected <osm>")
            self.document.generator = attributes.get("generator", "")
        elif self._depth == 2:
            if tag in ("node", "way", "relation"):
                self._open = tag
                self._attributes = dict(attributes)
                self._tags, self._refs, self._members = {}, [], []
            elif tag == "hdmap_tools":
                self.document.metadata = attributes.get("metadata")
        elif self._depth == 3 and self._open:
            if tag == "tag":
                self._tags[attributes.get("k", "")] = attributes.get("v", "")
            elif tag == "nd" and self._open == "way":
                self._refs.append(self._integer(attributes.get("ref"), "a node reference"))
            elif tag == "member" and self._open == "relation":
                self._members.append(
                    OsmMember(
                        attributes.get("type", ""),
                        self._integer(attributes.get("ref"), "a member reference"),
                        attributes.get("role", ""),
                    )
                )

    def end(self, tag: str) -> None:
        self.num_events += 1
        if self._depth == 2 and self._open:
            if self._attributes.get("action") == "delete":
                self.document.num_deleted += 1
            else:
                self._finish()
            self._open = None
        self._depth -= 1

    def close(self) -> None:
        return None

    def _finish(self) -> None:
        identifier = self._integer(self._attributes.get("id"), "the id")
        layers: dict[str, dict[int, Any]] = {
            "node": self.document.nodes,
            "way": self.document.ways,
            "relation": self.document.relations,
        }
        layer = layers[str(self._open)]
        if identifier in layer:
            self._refuse(f"{self._open} {identifier} is defined twice; ids must be unique")
        if self._open == "node":
            lat = self._number(self._attributes.get("lat"), "lat", 90.0)
            lon = self._number(self._attributes.get("lon"), "lon", 180.0)
            ele = self._number(self._tags.pop("ele", "0"), "ele", MAX_HEIGHT_M)
            layer[identifier] = OsmNode(identifier, lat, lon, ele, self._tags)
        elif self._open == "way":
            layer[identifier] = OsmWay(identifier, tuple(self._refs), self._tags)
        else:
            layer[identifier] = OsmRelation(identifier, tuple(self._members), self._tags)

    def _integer(self, text: str | None, what: str) -> int:
        if text is not None and _INTEGER.fullmatch(text.strip()):
            value = int(text)
            if -MAX_ID <= value <= MAX_ID:
                return value
        found = "no value" if text is None else repr(text[:40])
        self._refuse(f"{self._where()}: {what} is {found}, expected a 64-bit integer")
        raise AssertionError

    def _number(self, text: str | None, what: str, limit: float) -> float:
        try:
            value = float(text) if text is not None and len(text) < 400 else math.nan
        except ValueError:
            value = math.nan
        if math.isfinite(value) and abs(value) <= limit:
            return value
        found = "missing" if text is None else repr(text[:40])
        self._refuse(
            f"{self._where()}: {what} is {found}, expected a finite number within ±{limit:g}"
        )
        raise AssertionError

    def _where(self) -> str:
        return f"{self._open} {self._attributes.get('id', 'without an id')[:40]}"

    def _refuse(self, what: str) -> None:
        self.error = FormatError(f"{self._source} cannot be read: {what}.")
        raise self.error
