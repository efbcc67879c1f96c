"""The tables, read back by us and by the data set's own package."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmap_tools.calibration.calibration_files import (
    Calibration,
    read_calibration,
    write_calibration,
)
from hdmap_tools.errors import CalibrationError, DriveError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.av2 import read_intrinsics
from hdmap_tools.readers.open_drive import open_drive

MOUNT = SE3(
    Rotation.from_euler("xyz", [-90, 5, -88], degrees=True).as_matrix(), np.array([1.5, 0.2, 1.7])
)
LENS = (-0.2, 0.08, 6e-4, -9e-4, -0.01)
RAW = PinholeCamera("front", 960, 600, 812.0, 809.0, 487.0, 291.0, MOUNT, LENS)
RECTIFIED = PinholeCamera("rear", 640, 480, 500.0, 501.0, 320.0, 240.0, MOUNT)


def same(first, second):
    assert first.name == second.name
    assert first.lens == second.lens
    np.testing.assert_allclose(first.ego_SE3_cam.matrix, second.ego_SE3_cam.matrix, atol=1e-12)


def test_what_is_written_is_read_back(tmp_path):
    lidar = SE3(np.eye(3), np.array([1.0, 0, 2.0]))
    known = Calibration(
        {"front": RAW, "rear": RECTIFIED}, {"front": MOUNT, "rear": MOUNT, "up_lidar": lidar}
    )
    write_calibration(tmp_path, known)
    for path in (tmp_path, tmp_path / "calibration", tmp_path / "calibration/intrinsics.feather"):
        found = read_calibration(path)
        assert sorted(found.cameras) == ["front", "rear"]
        same(found.cameras["front"], RAW)
        same(found.cameras["rear"], RECTIFIED)
        assert sorted(found.mounts) == ["front", "rear", "up_lidar"]
    np.testing.assert_array_equal(found.mounts["up_lidar"].translation, [1, 0, 2])


def test_a_camera_without_a_mount_has_none_in_the_tables(tmp_path):
    write_calibration(tmp_path, Calibration({}).with_camera(RAW, is_mounted=False))
    assert not (tmp_path / "calibration/egovehicle_SE3_sensor.feather").exists()
    found = read_calibration(tmp_path)
    assert not found.mounts
    np.testing.assert_array_equal(found.cameras["front"].ego_SE3_cam.matrix, np.eye(4))


def test_the_package_of_the_data_set_reads_the_same_camera(tmp_path):
    sensors = pytest.importorskip("av2.geometry.camera.pinhole_camera")
    write_calibration(tmp_path, Calibration({}).with_camera(RAW, is_mounted=True))
    theirs = sensors.PinholeCamera.from_feather(tmp_path, "front")
    ideal = replace(RAW, distortion=(0.0,) * 5)
    points = np.array([[10.0, 1, 0.5], [20, -3, 2], [7, 0, 1]])
    uv, _, is_valid = theirs.project_ego_to_img(points)
    assert is_valid.all()
    np.testing.assert_allclose(uv, ideal.project(points).uv, atol=1e-6)
    assert (theirs.width_px, theirs.height_px) == (960, 600)


def test_put_into_a_drive_the_lens_is_used(tmp_path, simulated_drive):
    """The tables replace those of a log, and the log's reader then bends its points."""
    import shutil

    log = tmp_path / "log"
    shutil.copytree(simulated_drive, log)
    before = next(iter(open_drive(log).cameras.values()))
    bent = replace(before, distortion=LENS)
    kept = read_calibration(log)
    assert {"up_lidar", "down_lidar"} <= set(kept.mounts)
    write_calibration(log, kept.with_camera(bent, is_mounted=True))
    drive = open_drive(log)
    same(drive.cameras[before.name], bent)
    assert open_drive(simulated_drive).cameras[before.name].distortion == (0.0,) * 5


def test_a_recorded_log_without_the_column_stays_rectified(tmp_path):
    import pyarrow.feather as feather

    write_calibration(tmp_path, Calibration({"front": RAW}))
    path = tmp_path / "calibration/intrinsics.feather"
    table = feather.read_table(path).drop_columns(["is_rectified", "p1", "p2"])
    feather.write_feather(table, path)
    assert read_intrinsics(path)["front"].distortion == (0.0,) * 5


def test_the_column_holds_nothing_else(tmp_path):
    import pyarrow as pa
    import pyarrow.feather as feather

    write_calibration(tmp_path, Calibration({"front": RAW}))
    path = tmp_path / "calibration/intrinsics.feather"
    table = feather.read_table(path)
    place = table.column_names.index("is_rectified")
    feather.write_feather(table.set_column(place, "is_rectified", pa.array([2])), path)
    with pytest.raises(CalibrationError, match="must hold 0 and 1"):
        read_intrinsics(path)


def test_the_same_calibration_gives_the_same_bytes(tmp_path):
    known = Calibration({"front": RAW}, {"front": MOUNT})
    for name in ("a", "b"):
        write_calibration(tmp_path / name, known)
    for file in ("intrinsics.feather", "egovehicle_SE3_sensor.feather"):
        first, second = (tmp_path / name / "calibration" / file for name in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()


def test_which_camera_is_meant(tmp_path):
    both = Calibration({"front": RAW, "rear": RECTIFIED})
    assert both.camera("rear", tmp_path) is RECTIFIED
    assert Calibration({"front": RAW}).camera(None, tmp_path) is RAW
    with pytest.raises(CalibrationError, match="has 2 cameras; name one with --name: front, rear"):
        both.camera(None, tmp_path)
    with pytest.raises(CalibrationError, match="no camera 'left'"):
        both.camera("left", tmp_path)


def test_paths_and_names_that_cannot_be_used(tmp_path):
    with pytest.raises(DriveError, match="does not exist"):
        read_calibration(tmp_path / "none")
    with pytest.raises(DriveError):
        read_calibration(tmp_path)
    with pytest.raises(CalibrationError, match="Sensor name"):
        write_calibration(tmp_path, Calibration({"a/b": replace(RAW, name="a/b")}))
    with pytest.raises(CalibrationError, match="70000x600"):
        write_calibration(tmp_path, Calibration({"front": replace(RAW, width_px=70_000)}))
