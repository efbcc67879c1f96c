"""What one vectorizer does and takes, for listings and for the table in plugins/README.md."""

from __future__ import annotations

import inspect
import json
import re
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from hdmap_tools import registry
from hdmap_tools.plugin_api import Vectorizer
from hdmap_tools.registry import PluginEntry


@dataclass(frozen=True)
class OptionInfo:
    """One option of a vectorizer.

    Attributes:
        name: As written in hdmap.yaml.
        kind: Type and limits, for example ``number > 0``.
        default: As JSON.
        meaning: One sentence, from the field's description or the class docstring.
    """

    name: str
    kind: str
    default: str
    meaning: str


@dataclass(frozen=True)
class PluginInfo:
    """What `hdmap plugins info` shows of one vectorizer."""

    entry: PluginEntry
    summary: str
    description: str
    api_version: str
    element_types: tuple[str, ...]
    requires: tuple[str, ...]
    halo_m: float
    options: tuple[OptionInfo, ...]


def describe(name: str) -> PluginInfo:
    """What that installed vectorizer does and takes.

    Raises:
        PluginError: As `registry.load`.
    """
    entry = registry.entry_of(name)
    vectorizer = registry.load(name)
    # A plugin without a docstring would inherit ours, which describes the contract.
    text = inspect.cleandoc(vectorizer.__doc__) if vectorizer.__doc__ else ""
    return PluginInfo(
        entry=entry,
        summary=" ".join(text.partition("\n\n")[0].split()),
        description=text,
        api_version=vectorizer.api_version,
        element_types=tuple(kind.element_type for kind in vectorizer.element_types),
        requires=vectorizer.requires,
        halo_m=float(vectorizer.halo_m),
        options=option_infos(vectorizer),
    )


def option_infos(vectorizer: type[Vectorizer]) -> tuple[OptionInfo, ...]:
    """Every option of a vectorizer, in the order of its `Options`."""
    options = vectorizer.Options
    schema = options.model_json_schema()
    defaults = options().model_dump(mode="json")
    meanings = _documented_attributes(options)
    infos = []
    for name, field in options.model_fields.items():
        kind = _kind(schema["properties"][name], schema.get("$defs", {}))
        meaning = field.description or meanings.get(name, "")
        infos.append(OptionInfo(name, kind, json.dumps(defaults[name]), meaning))
    return tuple(infos)


def options_table(vectorizer: type[Vectorizer]) -> str:
    """The options of a vectorizer as a Markdown table; a sentence if it has none."""
    infos = option_infos(vectorizer)
    if not infos:
        return "No options."
    lines = ["| option | type | default | meaning |", "|---|---|---|---|"]
    for info in infos:
        cells = (f"`{info.name}`", info.kind, f"`{info.default}`", info.meaning)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


_LIMITS = (
    ("exclusiveMinimum", ">"),
    ("minimum", "≥"),
    ("exclusiveMaximum", "<"),
    ("maximum", "≤"),
)


def _kind(schema: dict[str, Any], definitions: dict[str, Any]) -> str:
    if "$ref" in schema:
        return _kind(definitions[schema["$ref"].rsplit("/", 1)[-1]], definitions)
    if "anyOf" in schema:
        return " or ".join(_kind(part, definitions) for part in schema["anyOf"])
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    kind = str(schema.get("type", "any"))
    if kind == "array":
        items = schema.get("prefixItems") or [schema.get("items", {})]
        return "list of " + ", ".join(_kind(item, definitions) for item in items)
    limits = [f"{sign} {schema[key]:g}" for key, sign in _LIMITS if key in schema]
    return " ".join([kind, ", ".join(limits)]).strip()


def _documented_attributes(model: type[BaseModel]) -> dict[str, str]:
    """Meanings of the fields from the ``Attributes:`` section of a Google docstring."""
    if not model.__doc__:
        return {}
    section = re.split(r"^Attributes:\n", inspect.cleandoc(model.__doc__), flags=re.MULTILINE)
    if len(section) < 2:
        return {}
    meanings: dict[str, str] = {}
    current = ""
    for line in section[1].splitlines():
        if line and not line.startswith(" "):
            break
        start = re.match(r" {4}(\w+)(?: \([^)]*\))?: (.*)", line)
        if start:
            current = start[1]
            meanings[current] = start[2].strip()
        elif current and line.strip():
            meanings[current] += " " + line.strip()
    return meanings
