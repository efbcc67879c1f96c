"""A small made drive, written in either layout."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.testing.drives import write_av2, write_nuscenes

T0_NS = 1_532_402_927_000_000_000
STEP_NS = 100_000_000
NUM_FRAMES = 4
WIDTH_PX, HEIGHT_PX = 64, 40

# Optical axis (camera z) along ego x, image right (camera x) along ego -y.
EGO_R_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class MadeDrive:
    """What the written drive holds."""

    trajectory: Trajectory
    cameras: tuple[PinholeCamera, ...]
    images: dict[str, dict[int, np.ndarray]]
    sweeps: tuple[Sweep, ...]
    ego_SE3_lidar: SE3

    @property
    def times_ns(self) -> list[int]:
        return [T0_NS + k * STEP_NS for k in range(NUM_FRAMES)]

    def write_nuscenes(self, root: Path, **changes: Any) -> Path:
        return write_nuscenes(
            root, **{**self._content(), "ego_SE3_lidar": self.ego_SE3_lidar, **changes}
        )

    def write_av2(self, log_dir: Path, **changes: Any) -> Path:
        return write_av2(log_dir, **{**self._content(), **changes})

    def _content(self) -> dict[str, Any]:
        return {
            "trajectory": self.trajectory,
            "cameras": self.cameras,
            "images": self.images,
            "sweeps": self.sweeps,
        }


@pytest.fixture(scope="session")
def made() -> MadeDrive:
    """Two cameras, four frames, four sweeps, an ego that moves and turns."""
    rng = np.random.default_rng(20)
    # Poses every 25 ms, from before the first frame to after the last.
    times = T0_NS + np.arange(-2, 15) * (STEP_NS // 4)
    seconds = (times - T0_NS) / 1e9
    yaw = 0.3 * seconds
    wxyz = np.column_stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)])
    xyz = np.column_stack([400 + 8 * seconds, 1180 + seconds**2, 0 * seconds])
    cameras = tuple(
        PinholeCamera(
            name,
            WIDTH_PX,
            HEIGHT_PX,
            50.0,
            51.0,
            31.5,
            19.5,
            SE3(EGO_R_CAM, np.array([1.5, y, 1.6])),
        )
        for name, y in (("front_left", 0.3), ("front_right", -0.3))
    )
    frames = [T0_NS + k * STEP_NS for k in range(NUM_FRAMES)]
    return MadeDrive(
        trajectory=Trajectory.from_quaternions(times, wxyz, xyz),
        cameras=cameras,
        images={
            camera.name: {
                time: rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
                for time in frames
            }
            for camera in cameras
        },
        sweeps=tuple(
            Sweep(
                time,
                rng.uniform(-30, 30, (50, 3)),
                rng.integers(0, 256, 50, dtype=np.uint8),
                rng.integers(0, 32, 50, dtype=np.uint8),
            )
            for time in frames
        ),
        ego_SE3_lidar=SE3.from_yaw(-1.5, (0.9, 0.0, 1.8)),
    )


@pytest.fixture
def nuscenes_root(made: MadeDrive, tmp_path: Path) -> Path:
    return made.write_nuscenes(tmp_path / "data")


@pytest.fixture
def av2_log(made: MadeDrive, tmp_path: Path) -> Path:
    return made.write_av2(tmp_path / "made-log")


@pytest.fixture
def edit_table(nuscenes_root: Path) -> Callable[[str, Callable[[list[dict[str, Any]]], Any]], None]:
    """Change the rows of one nuScenes table in place."""
    import json

    def edit(name: str, change: Callable[[list[dict[str, Any]]], Any]) -> None:
        path = nuscenes_root / "v1.0-mini" / f"{name}.json"
        rows = json.loads(path.read_text())
        change(rows)
        path.write_text(json.dumps(rows))

    return edit


@pytest.fixture
def edit_feather() -> Callable[[Path, Callable[[dict[str, Any]], Any]], None]:
    """Change the columns of one feather table in place."""
    import pyarrow as pa
    import pyarrow.feather

    def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
        table = pyarrow.feather.read_table(path, memory_map=False)
        columns = {name: np.array(table[name].to_numpy()) for name in table.column_names}
        change(columns)
        pyarrow.feather.write_feather(pa.table(columns), path)

    return edit
