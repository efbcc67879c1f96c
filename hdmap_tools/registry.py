"""Which vectorizers are installed, and whether they can be used.

The only user of `importlib.metadata`. Discovery lists without importing anything;
a plugin is imported when its name is chosen, so one that is broken never hides
the others.
"""

from __future__ import annotations

import difflib
import importlib.metadata
import inspect
import logging
import math
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from hdmap_tools.errors import (
    PluginError,
    PluginLoadError,
    PluginVersionError,
    UnknownPluginError,
)
from hdmap_tools.map_model.elements import ELEMENT_TYPES
from hdmap_tools.plugin_api import API_VERSION, Vectorizer, VectorizerOptions

logger = logging.getLogger(__name__)

ENTRY_POINT_GROUP: Final = "hdmap_tools.vectorizers"
"""The group in which every distribution, ours too, registers its vectorizers."""

_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
_VERSION: Final = re.compile(r"(\d+)\.(\d+)")


@dataclass(frozen=True, order=True)
class PluginEntry:
    """One registered vectorizer, as its distribution's metadata has it; nothing is imported.

    Attributes:
        name: Name of the entry point, by which users choose it.
        distribution: Distribution that registers it, for example ``hdmap-tools``.
        version: Version of that distribution.
        value: Where the class is, ``package.module:Class``.
    """

    name: str
    distribution: str
    version: str
    value: str

    def describe(self) -> str:
        """One line for people."""
        return f"{self.name} from {self.distribution} {self.version} ({self.value})"


class PluginState(StrEnum):
    """Whether a vectorizer can be used."""

    OK = "ok"
    BROKEN = "broken"
    CONFLICT = "conflict"
    INCOMPATIBLE = "incompatible"


@dataclass(frozen=True)
class PluginStatus:
    """Whether one installed vectorizer can be used, and why not.

    Attributes:
        state: ``ok``, ``broken``, ``conflict`` (two distributions, one name) or
            ``incompatible`` (another major version of the plugin API).
        reason: One line; empty unless there is something to say.
    """

    state: PluginState
    reason: str = ""


def discover() -> tuple[PluginEntry, ...]:
    """All registered vectorizers, sorted by name and distribution, without importing them.

    A name that two distributions register stands in the list twice.
    """
    return tuple(sorted(entry for entry, _ in _registered()))


def load(name: str) -> type[Vectorizer]:
    """Import one vectorizer and check that it keeps the contract.

    Raises:
        UnknownPluginError: If nobody registers that name; the message lists who is there.
        PluginVersionError: If it was written for another major version of the plugin API.
        PluginLoadError: If importing it fails (chained), or its class breaks the contract.
        PluginError: If several distributions register that name; the message names them.
    """
    entry, entry_point = _only(name)
    try:
        loaded = entry_point.load()
    # sys.exit() in a plugin's module is that plugin's fault, not a wish to end the run.
    except (Exception, SystemExit) as error:
        raise PluginLoadError(
            f"Vectorizer {entry.describe()} cannot be imported: "
            f"{type(error).__name__}: {error}.{_hint(error)}"
        ) from error
    return check_class(loaded, entry)


def entry_of(name: str) -> PluginEntry:
    """The one entry of that name, without importing it.

    Raises:
        UnknownPluginError: If nobody registers that name.
        PluginError: If several distributions do.
    """
    return _only(name)[0]


def status(name: str) -> PluginStatus:
    """Whether that vectorizer can be used; imports it, and never raises for its faults.

    Raises:
        UnknownPluginError: If nobody registers that name.
    """
    if len([entry for entry in discover() if entry.name == name]) > 1:
        try:
            _only(name)
        except PluginError as error:
            return PluginStatus(PluginState.CONFLICT, str(error))
    try:
        vectorizer = load(name)
    except UnknownPluginError:
        raise
    except PluginVersionError as error:
        return PluginStatus(PluginState.INCOMPATIBLE, str(error))
    except PluginError as error:
        return PluginStatus(PluginState.BROKEN, str(error))
    return PluginStatus(PluginState.OK, _newer_minor(vectorizer.api_version))


def check_class(loaded: object, entry: PluginEntry) -> type[Vectorizer]:
    """Check what an entry point names against the contract of `plugin_api`.

    Raises:
        PluginVersionError: If its api_version has another major number than ours.
        PluginLoadError: If it is no concrete `Vectorizer`, or an attribute is missing or wrong.
    """

    def wrong(found: str, expected: str) -> PluginLoadError:
        return PluginLoadError(f"Vectorizer {entry.describe()}: {found}; expected {expected}.")

    if not (isinstance(loaded, type) and issubclass(loaded, Vectorizer)):
        raise wrong(
            f"the entry point names {loaded!r}",
            "a class derived from hdmap_tools.plugin_api.Vectorizer",
        )
    # First the version: a class for another major version may rightly look different.
    _check_version(loaded, entry)
    if inspect.isabstract(loaded):
        raise wrong(
            f"{loaded.__name__} leaves {sorted(loaded.__abstractmethods__)} undefined",
            "a class that defines vectorize",
        )
    name = getattr(loaded, "name", None)
    if name != entry.name:
        raise wrong(f"its class attribute name is {name!r}", f"the entry point's, {entry.name!r}")
    if not _NAME.fullmatch(entry.name):
        raise wrong(f"its name is {name!r}", "lower case letters, digits and underscores")
    types = getattr(loaded, "element_types", None)
    if not (isinstance(types, tuple) and types and all(kind in ELEMENT_TYPES for kind in types)):
        known = ", ".join(kind.__name__ for kind in ELEMENT_TYPES)
        raise wrong(f"element_types is {types!r}", f"a tuple of one or more of {known}")
    requires = loaded.requires
    if not (isinstance(requires, tuple) and all(isinstance(other, str) for other in requires)):
        raise wrong(f"requires is {requires!r}", "a tuple of names of vectorizers")
    halo_m = loaded.halo_m
    if isinstance(halo_m, bool) or not isinstance(halo_m, int | float):
        raise wrong(f"halo_m is {halo_m!r}", "metres, a number of 0 or more")
    if not (math.isfinite(halo_m) and halo_m >= 0):
        raise wrong(f"halo_m is {halo_m!r}", "metres, a finite number of 0 or more")
    if loaded.scope not in ("window", "map"):
        raise wrong(f"scope is {loaded.scope!r}", "'window' or 'map'")
    _check_options(loaded.Options, wrong)
    try:
        inspect.signature(loaded.vectorize).bind(None, None, None, None, rng=None)
    except TypeError as error:
        raise wrong(
            f"vectorize{inspect.signature(loaded.vectorize)} cannot be called ({error})",
            "vectorize(self, window, upstream, options, *, rng)",
        ) from error
    try:
        inspect.signature(loaded).bind()
    except TypeError as error:
        raise wrong(
            f"its constructor asks for arguments ({error})", "none; what varies goes in Options"
        ) from error
    return loaded


def unknown(name: str, available: Iterable[str]) -> UnknownPluginError:
    """The error for a name that nobody registers: suggests near names, lists the rest."""
    names = sorted(set(available))
    near = difflib.get_close_matches(name, names, n=3)
    suggestion = f" Did you mean {' or '.join(near)}?" if near else ""
    listing = ", ".join(names) or "none; install a distribution that registers some"
    return UnknownPluginError(
        f"No vectorizer {name!r} is installed.{suggestion} Installed: {listing}."
    )


def _only(name: str) -> tuple[PluginEntry, importlib.metadata.EntryPoint]:
    registered = list(_registered())
    matches = sorted((pair for pair in registered if pair[0].name == name), key=lambda p: p[0])
    if not matches:
        raise unknown(name, (entry.name for entry, _ in registered))
    if len(matches) > 1:
        owners = " and ".join(f"{e.distribution} {e.version} ({e.value})" for e, _ in matches)
        raise PluginError(
            f"Vectorizer {name!r} is registered by {owners}; uninstall all but one of them."
        )
    return matches[0]


def _registered() -> Iterator[tuple[PluginEntry, importlib.metadata.EntryPoint]]:
    for entry_point in _entry_points():
        distribution, version = _origin(entry_point)
        yield (
            PluginEntry(entry_point.name, distribution, version, entry_point.value),
            entry_point,
        )


def _entry_points() -> list[importlib.metadata.EntryPoint]:
    try:
        return list(importlib.metadata.entry_points(group=ENTRY_POINT_GROUP))
    except Exception:
        # One distribution with a damaged entry_points.txt makes the call above raise
        # for everybody; reading one by one loses only that one.
        return list(_entry_points_one_by_one())


def _entry_points_one_by_one() -> Iterator[importlib.metadata.EntryPoint]:
    seen: set[str] = set()
    for distribution in importlib.metadata.distributions():
        try:
            # The first on the path shadows the others, as for imports.
            name = re.sub(r"[-_.]+", "-", distribution.metadata["Name"]).lower()
            found = distribution.entry_points.select(group=ENTRY_POINT_GROUP)
        except Exception as error:
            logger.warning(
                "Skipped the damaged metadata of %s (%s: %s); reinstall it.",
                getattr(distribution, "_path", distribution),
                type(error).__name__,
                error,
            )
            continue
        if name not in seen:
            seen.add(name)
            yield from found


def _origin(entry_point: importlib.metadata.EntryPoint) -> tuple[str, str]:
    distribution = entry_point.dist
    try:
        with warnings.catch_warnings():
            # A missing METADATA file gives None with a warning on 3.12, an error later.
            warnings.simplefilter("error")
            metadata: Any = distribution.metadata if distribution is not None else {}
            return str(metadata["Name"] or "unknown"), str(metadata["Version"] or "unknown")
    except Exception:
        return "unknown", "unknown"


def _hint(error: BaseException) -> str:
    if isinstance(error, ImportError) and error.name == "hdmap_tools.plugin_api":
        return (
            f" It wants a name that plugin API {API_VERSION} does not have; "
            "install a matching version of hdmap-tools or of the plugin."
        )
    if isinstance(error, ModuleNotFoundError):
        return f" Install what provides {error.name!r}."
    return " This is a fault of that distribution; report it to its authors."


def _check_version(loaded: type[Vectorizer], entry: PluginEntry) -> None:
    found = getattr(loaded, "api_version", None)
    match = _VERSION.fullmatch(found) if isinstance(found, str) else None
    if match is None:
        raise PluginLoadError(
            f"Vectorizer {entry.describe()}: api_version is {found!r}; "
            f'expected "major.minor" as in {API_VERSION!r}.'
        )
    ours = API_VERSION.split(".")[0]
    if int(match[1]) != int(ours):
        remedy = "install a newer hdmap-tools" if int(match[1]) > int(ours) else "update the plugin"
        raise PluginVersionError(
            f"Vectorizer {entry.describe()} was written for plugin API {found}, "
            f"this is {API_VERSION}; the major numbers must be equal: {remedy}."
        )
    note = _newer_minor(match[0])
    if note:
        logger.warning("Vectorizer %s: %s", entry.describe(), note)


def _newer_minor(api_version: str) -> str:
    theirs = [int(part) for part in api_version.split(".")]
    ours = [int(part) for part in API_VERSION.split(".")]
    if theirs[1] <= ours[1]:
        return ""
    return (
        f"written for plugin API {api_version}, this is {API_VERSION}; "
        "it may want what this version lacks: update hdmap-tools."
    )


def _check_options(options: object, wrong: Any) -> None:
    if not (isinstance(options, type) and issubclass(options, VectorizerOptions)):
        raise wrong(f"Options is {options!r}", "a subclass of VectorizerOptions")
    if options.model_config.get("extra") != "forbid":
        raise wrong("Options takes unknown names", 'extra="forbid", as VectorizerOptions has it')
    required = sorted(n for n, field in options.model_fields.items() if field.is_required())
    if required:
        raise wrong(f"Options has no default for {', '.join(required)}", "a default for each")
    try:
        options()
    except Exception as error:
        raise wrong(f"the defaults of Options are refused ({error})", "valid ones") from error
