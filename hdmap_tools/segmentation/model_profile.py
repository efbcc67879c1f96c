"""Model profiles: shipped ones, one's own, and finding the one that fits a model file."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable
from functools import lru_cache
from importlib import resources
from pathlib import Path

from pydantic import ValidationError

from hdmap_tools.errors import ConfigError, brief_problems
from hdmap_tools.labels.label_set import builtin_label_sets
from hdmap_tools.segmentation.segmenter import ModelProfile

_log = logging.getLogger(__name__)


@lru_cache
def builtin_profiles() -> dict[str, ModelProfile]:
    """The profiles that ship with the package, by name."""
    folder = resources.files("hdmap_tools.segmentation") / "profiles"
    profiles = [
        ModelProfile.model_validate_json(entry.read_text(encoding="utf-8"))
        for entry in sorted(folder.iterdir(), key=lambda e: e.name)
        if entry.name.endswith(".json")
    ]
    return {profile.name: profile for profile in profiles}


def load_profile(name_or_path: str | Path) -> ModelProfile:
    """A shipped profile by name, or one from a JSON file.

    A label set that the file names by path is looked for beside the file.

    Raises:
        ConfigError: If there is neither, or the file is no profile; the message
            lists the shipped names or the wrong fields.
    """
    shipped = builtin_profiles()
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    path = Path(name_or_path)
    if not path.is_file():
        raise ConfigError(
            f"{str(name_or_path)!r} is neither a model profile ({', '.join(sorted(shipped))}) "
            "nor a JSON file."
        )
    try:
        profile = ModelProfile.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        raise ConfigError(f"{path} is not a model profile: {brief_problems(error)}.") from error
    except RecursionError as error:
        raise ConfigError(f"{path} is not a model profile: it is nested too deeply.") from error
    except (ValueError, OSError) as error:  # no JSON, no UTF-8, a number of thousands of digits
        raise ConfigError(f"{path} is not a model profile: {error}") from error
    beside = path.parent / profile.label_set
    if profile.label_set not in builtin_label_sets() and beside.is_file():
        profile = profile.model_copy(update={"label_set": str(beside)})
    return profile


def find_profile(model: Path) -> ModelProfile | None:
    """The shipped profile known to fit a model file, by the hash of its weights, or None."""
    weights = weights_file(model)
    if not weights.is_file():
        return None
    found = sha256_of_files([weights])
    for profile in builtin_profiles().values():
        if found in profile.sha256:
            return profile
    return None


def profile_for(model: Path, name_or_path: str) -> ModelProfile:
    """The profile asked for, for a model file.

    Raises:
        ConfigError: If it cannot be read, or there is no such model.
    """
    require_model_file(model)
    weights = weights_file(model)
    profile = load_profile(name_or_path)
    if profile.sha256 and sha256_of_files([weights]) not in profile.sha256:
        _log.warning(
            "Profile %s was made for other weights than %s; used because it was asked for.",
            profile.name,
            weights,
        )
    return profile


def require_model_file(model: Path) -> None:
    """Raise `ConfigError` unless there is the file that holds a model's weights."""
    weights = weights_file(model)
    if not weights.is_file():
        raise ConfigError(f"There is no model file {weights}.")


def weights_file(model: Path) -> Path:
    """The file that a profile's hash is of: the ``.bin`` of an OpenVINO model, else the model."""
    return model.with_suffix(".bin") if model.suffix.lower() == ".xml" else model


def sha256_of_files(files: Iterable[Path]) -> str:
    """Hash of one file's bytes, or of the hashes of several, in their order, lower case hex."""
    hashes = []
    for path in files:
        with path.open("rb") as file:
            hashes.append(hashlib.file_digest(file, "sha256").hexdigest())
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
