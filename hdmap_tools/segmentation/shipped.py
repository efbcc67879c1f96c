"""Networks that ship with the package, by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Final

from hdmap_tools.errors import ConfigError

STREET_SMALL: Final = "street-small"
"""Used when no model is given and none lies with the drive."""

SHIPPED: Final = (STREET_SMALL,)


SIMULATED: Final = "simulated"
"""As a model: the true label images of a simulated drive, with errors."""


def network_for_simulated_drives() -> str:
    """What labels a simulated drive where nothing is asked for: the shipped network, if it is there."""
    return STREET_SMALL if is_shipped(STREET_SMALL) else SIMULATED


def networks_folder() -> Path:
    """Where they lie."""
    return Path(str(resources.files("hdmap_tools.segmentation"))) / "networks"


def is_shipped(name: str) -> bool:
    """Whether a network of that name is in this installation."""
    return name in SHIPPED and shipped_network_path(name).is_file()


def shipped_network_path(name: str) -> Path:
    """Where a network of that name lies, or would."""
    return networks_folder() / f"{name}.onnx"


def shipped_network(name: str) -> Path:
    """The file of a shipped network.

    Raises:
        ConfigError: If this installation lacks it.
    """
    path = shipped_network_path(name)
    if not path.is_file():
        raise ConfigError(
            f"The network {name!r} is not in this installation ({path} is missing); install the "
            "package anew, or give another model with --model PATH (.onnx or .xml)."
        )
    return path
