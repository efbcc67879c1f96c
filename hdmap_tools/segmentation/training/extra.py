"""The optional packages of training, asked for before anything imports them."""

from __future__ import annotations

import importlib.util
from typing import Final

from hdmap_tools.errors import MissingExtraError

_NEEDED: Final = ("torch", "torchvision", "segmentation_models_pytorch", "onnx")


def require_training() -> None:
    """Refuse to go on where a package of the extra `train` is missing.

    Raises:
        MissingExtraError: Naming what is missing and how to get it.
    """
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingExtraError(
            f"Training needs {', '.join(missing)}, which is not installed: "
            "pip install 'hdmap_tools[train]'."
        )
