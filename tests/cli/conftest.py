"""A small drive with known truth on disk, and the command line to use it."""

import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from shapely.geometry import LineString

from hdmap_tools.cli.main import main
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.map_model.elements import LaneMark
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.testing.drives import write_nuscenes
from hdmap_tools.testing.street import Street, camera, flat, stripes

START_NS = 1_700_000_000_000_000_000
STEP_NS = 500_000_000
POSES = [SE3.from_yaw(0.02 * k, (300.0 + 3.0 * k, 1000.0 + 0.03 * k, 0.0)) for k in range(3)]


def _shifted_stripes(x, y):
    return stripes(x - 300.0, y - 1000.0)


STREET = Street(flat, _shifted_stripes, box=(314.0, 1003.0, 318.0, 1005.0, 1.6))


@pytest.fixture(scope="session")
def street_template(tmp_path_factory) -> Path:
    """Folder with a drive (``drive``) of three images and its true labels (``labels``)."""
    root = tmp_path_factory.mktemp("street")
    times = [START_NS + k * STEP_NS for k in range(len(POSES))]
    cam = camera()
    sweeps, images = [], {}
    for time, pose in zip(times, POSES, strict=True):
        swept = STREET.sweep(pose)
        sweeps.append(Sweep(time, swept.points_ego, swept.intensity, swept.ring))
        labels = STREET.label_image(cam, pose)
        images[time] = np.repeat((labels * 60)[:, :, None], 3, axis=2)
        path = root / "labels" / cam.name / f"{time}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), labels)
    trajectory = Trajectory(
        np.array(times),
        np.array([p.rotation for p in POSES]),
        np.array([p.translation for p in POSES]),
    )
    write_nuscenes(
        root / "drive",
        trajectory=trajectory,
        cameras=[cam],
        images={cam.name: images},
        sweeps=sweeps,
    )
    return root


@pytest.fixture
def street(street_template, tmp_path, monkeypatch) -> Path:
    """A copy of the street that a test may damage; the working folder."""
    shutil.copytree(street_template, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


@pytest.fixture(autouse=True)
def logging_as_before():
    """The command line sets up logging for its process; other tests must not see that."""
    logger = logging.getLogger("hdmap_tools")
    before = logger.handlers[:], logger.level
    yield
    logger.handlers[:] = before[0]
    logger.setLevel(before[1])


@pytest.fixture
def hdmap(capsys):
    """Run a command line; gives exit code, standard output and standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main([str(a) for a in arguments])
        captured = capsys.readouterr()
        code = stop.value.code
        return (code if isinstance(code, int) else 0), captured.out, captured.err

    return run


@pytest.fixture
def fails(hdmap):
    """Run a command line that must fail with one clear line that holds all these words."""

    def run(*arguments: object, says: tuple[str, ...], code: int = 1) -> str:
        found, _, err = hdmap(*arguments)
        lines = [line for line in err.splitlines() if line.startswith("Error: ")]
        assert found == code, err
        assert len(lines) == 1, err
        assert "Traceback" not in err
        for word in says:
            assert word in lines[0], lines[0]
        return lines[0]

    return run


LABELS = ("--labels", "labels", "--label-set", "adas-0001")


@pytest.fixture
def mark() -> LaneMark:
    """One lane mark, 10 m long."""
    return LaneMark(id="mark", geometry=LineString([(0, 0, 0), (10, 0, 0)]), style="dashed")
