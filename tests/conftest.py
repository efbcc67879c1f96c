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


@pytest.fixture(scope="session")
def simulated_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated drive with truth and exact poses: 3 images, 20 sweeps. Read only."""
    from hdmap_tools.simulate.drive import simulate_drive
    from hdmap_tools.simulate.read_world import shipped_world
    from hdmap_tools.simulate.settings import LidarPreset, SimulationSettings

    settings = SimulationSettings(
        seed=3,
        length_m=16,
        camera_hz=1.6,
        image_width_px=480,
        image_height_px=300,
        lidar=LidarPreset.VLP16,
    )
    out = tmp_path_factory.mktemp("simulated") / "drive"
    return simulate_drive(shipped_world(), out, settings)
