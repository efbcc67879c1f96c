"""Fixtures shared by all tests."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from tests.s3_server import S3Server

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


@pytest.fixture(scope="session")
def s3_running() -> "Iterator[S3Server]":
    """An S3 server on the loopback address, with a bucket ``maps``."""
    from tests.s3_server import s3_server

    with s3_server() as server:
        yield server


@pytest.fixture
def s3(s3_running: "S3Server", monkeypatch: pytest.MonkeyPatch) -> "S3Server":
    """The server, which the environment names; its bucket may hold what other tests put there."""
    from tests.s3_server import use

    use(s3_running, monkeypatch)
    return s3_running
