"""Every error a caller may want to catch.

    HDMapError
    ├── ConfigError (ValueError)              hdmap.yaml or an option is wrong
    ├── ShapeError (ValueError)               an array has the wrong shape or dtype
    ├── CRSMismatchError (ValueError)         two frames or CRSs were mixed
    ├── NoOriginError (ValueError)            a geographic export without an origin
    ├── LabelError (ValueError)               a label id or label set does not fit
    ├── DriveError (ValueError)               a drive cannot be read
    │   ├── CalibrationError                  a sensor's calibration is missing or unusable
    │   ├── PoseError                         no pose at the time needed
    │   ├── SweepError                        a lidar sweep is truncated or malformed
    │   └── ImageError                        an image does not decode
    ├── MapMismatchError (ValueError)         maps of other resolution, mode or labels
    ├── StoreError (OSError)                  a semantic map's repository cannot be used
    ├── PluginError (RuntimeError)            a vectorizer cannot be used
    │   ├── UnknownPluginError (LookupError)  no vectorizer of that name
    │   ├── PluginVersionError                written for another plugin API
    │   ├── PluginLoadError                   importing it failed
    │   └── PluginFailedError                 it raised, or returned what it must not
    ├── FormatError (ValueError)              a map file cannot be read or written
    ├── WorldError (ValueError)               a map that no vehicle can be simulated on
    ├── PointMapError (ValueError)            a point map cannot be made or used
    ├── CheckpointError (ValueError)          a training run cannot be continued or exported
    ├── ClusterError (RuntimeError)           workers cannot be reached, or die
    ├── OutputExistsError (FileExistsError)   would overwrite
    └── MissingExtraError (ImportError)       an optional dependency is not installed

A message says what was found, what was expected and what to do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pydantic import ValidationError

_MAX_PROBLEMS: Final = 3
_MAX_SHOWN: Final = 160


class HDMapError(Exception):
    """Root of all errors raised on purpose by this package."""


class ConfigError(HDMapError, ValueError):
    """A configuration file or an option is wrong."""


class ShapeError(HDMapError, ValueError):
    """An array has the wrong shape or dtype."""


class CRSMismatchError(HDMapError, ValueError):
    """Two different frames or coordinate reference systems were mixed."""


class NoOriginError(HDMapError, ValueError):
    """A geographic result was asked of a frame without an origin."""


class LabelError(HDMapError, ValueError):
    """A label id lies outside its label set, or two label sets do not fit."""


class DriveError(HDMapError, ValueError):
    """A drive cannot be read."""


class CalibrationError(DriveError):
    """A sensor's calibration is missing or unusable."""


class PoseError(DriveError):
    """No usable ego pose at the time needed."""


class SweepError(DriveError):
    """A lidar sweep is truncated or malformed."""


class ImageError(DriveError):
    """A camera or label image cannot be read."""


class MapMismatchError(HDMapError, ValueError):
    """Two maps differ in resolution, count mode, labels or frame."""


class StoreError(HDMapError, OSError):
    """The repository of a semantic map cannot be opened, read or committed to."""


class PluginError(HDMapError, RuntimeError):
    """A vectorizer plugin cannot be used."""


class UnknownPluginError(PluginError, LookupError):
    """No installed vectorizer has the name asked for."""


class PluginVersionError(PluginError):
    """A plugin was written for another major version of the plugin API."""


class PluginLoadError(PluginError):
    """Importing a plugin failed, or what it names is not a vectorizer."""


class PluginFailedError(PluginError):
    """A plugin raised while it ran, or returned what the contract forbids."""


class FormatError(HDMapError, ValueError):
    """A map file cannot be read, or a map cannot be written in that format."""


class WorldError(HDMapError, ValueError):
    """A map gives no world to drive through: no usable lanes, no route, not readable."""


class PointMapError(HDMapError, ValueError):
    """A point map cannot be made, read, or does not fit the drive."""


class CheckpointError(HDMapError, ValueError):
    """A training run's checkpoint is missing, damaged, or of another run."""


class OutputExistsError(HDMapError, FileExistsError):
    """The output exists already and was not to be overwritten."""


class ClusterError(HDMapError, RuntimeError):
    """A cluster cannot be reached, or its workers die."""


class MissingExtraError(HDMapError, ImportError):
    """An optional dependency is needed and not installed."""


def brief_problems(error: ValidationError, whole: str = "document") -> str:
    """At most three problems of a document as ``field: problem``, on one line, for a message.

    A problem of no single field is put down to what `whole` calls the document.
    """
    details = error.errors(include_url=False, include_context=False, include_input=False)
    lines = []
    for detail in details[:_MAX_PROBLEMS]:
        where = ".".join(str(part) for part in detail["loc"]) or whole
        line = f"{where}: {detail['msg'].removeprefix('Value error, ')}"
        lines.append(line if line.isprintable() and len(line) <= _MAX_SHOWN else shown(line))
    if num_more := len(details) - len(lines):
        lines.append(f"and {num_more} more")
    return "; ".join(lines)


def shown(text: str) -> str:
    """For a message: quoted, on one line, and not long."""
    quoted = ascii(text)
    return (
        quoted if len(quoted) <= _MAX_SHOWN else f"{quoted[:_MAX_SHOWN]}… ({len(text)} characters)"
    )
