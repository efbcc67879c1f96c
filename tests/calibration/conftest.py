"""Photos of a board, rendered once for all tests."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from .rendering import BOARD, TRUE_CAMERA, Renderer, views


@pytest.fixture(scope="session")
def board_photos(tmp_path_factory) -> Path:
    """Folder of 15 photos of the board by `TRUE_CAMERA`."""
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(11)
    renderer = Renderer(TRUE_CAMERA)
    for k, pose in enumerate(views(BOARD, TRUE_CAMERA, 15, rng)):
        cv2.imwrite(str(folder / f"{k:02d}.png"), renderer.image(BOARD, pose, rng))
    return folder
