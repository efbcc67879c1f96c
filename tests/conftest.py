"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# A deadline for each example measures how busy the machine is, not our code.
settings.register_profile("hdmap", deadline=None)
settings.load_profile("hdmap")


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of recorded sample data: HDMAP_DATA, or ../shared/data beside the project."""
    given = os.environ.get("HDMAP_DATA")
    root = Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not root.is_dir():
        pytest.skip(f"no recorded sample data at {root}; set HDMAP_DATA to its folder")
    return root
