"""Mapping while driving: the same as the local map of a drive that is read from disk."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.surface import associate_surface
from hdmap_tools.config import Config
from hdmap_tools.errors import CalibrationError
from hdmap_tools.fusion.local_map import LocalMap
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.live import LiveMapper
from hdmap_tools.testing.street import Street, camera, flat, stripes

ADAS = load_label_set("adas-0001")
STREET = Street(flat, stripes)
CONFIG = Config.model_validate({"fusion": {"resolution_m": 0.2}})
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "live_local_map.py"


def poses():
    return [SE3.from_yaw(0.01 * k, (1.5 * k, 0.05 * k, 0.0)) for k in range(5)]


def mapper():
    return LiveMapper({"cam": camera()}, ADAS, model="road-segmentation-adas-0001", config=CONFIG)


def test_frames_add_up_to_the_local_map():
    live, cam = mapper(), camera()
    plain = LocalMap(live.local_map.meta)
    association = CONFIG.association
    for key, pose in enumerate(poses()):
        sweep = STREET.sweep(pose)
        live.add_sweep(sweep, pose)
        labels = STREET.label_image(cam, pose)
        seen = live.add_image("cam", labels, pose, key)
        grounded = GroundedSweep.from_sweep(
            sweep, pose, association.max_range_m, association.ground_tolerance_m
        )
        expected = associate_surface(labels, ADAS, cam, pose, grounded, 0.2, association)
        plain.update(expected, pose, key)
        assert seen == len(expected) > 1000
    assert live.local_map.counts().equals(plain.counts())
    window = live.window()
    found = np.asarray(window.dataset["posterior"]).argmax(axis=0)
    assert window.classes[np.bincount(found[window.is_known]).argmax()] == "road"


def test_without_lidar_images_are_laid_on_the_plane_under_the_wheels():
    live, cam = mapper(), camera()
    for key, pose in enumerate(poses()):
        assert live.add_image("cam", STREET.label_image(cam, pose), pose, key) > 1000
    assert live.local_map.num_rolls > 0


def test_what_cannot_be_is_said():
    live = mapper()
    labels = STREET.label_image(camera(), SE3.identity())
    with pytest.raises(CalibrationError, match="no camera 'left'"):
        live.add_image("left", labels, SE3.identity(), 0)
    with pytest.raises(CalibrationError, match=r"\(height, width\)"):
        live.add_image("cam", labels.T, SE3.identity(), 0)


@pytest.mark.slow
def test_the_example_measures_itself(simulated_drive, tmp_path):
    picture = tmp_path / "local.png"
    done = subprocess.run(
        [
            sys.executable,
            str(EXAMPLE),
            str(simulated_drive),
            "--model",
            "simulated",
            "--out",
            str(picture),
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    for what in ("add a sweep", "add an image", "read the map"):
        assert what in done.stdout
    assert picture.stat().st_size > 1000
