"""The Argoverse 2 layout, judged by the data set's own package, and bad input."""

import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hdmap_tools.errors import CalibrationError, DriveError, PoseError, SweepError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.readers.av2 import CITY_UTM_ZONE_LAT_LON, POSES_FILE, read_av2
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.readers.image import read_image
from hdmap_tools.readers.motion import undo_ego_motion_compensation

EditFeather = Callable[[Path, Callable[[dict[str, Any]], Any]], None]

INTRINSICS = "calibration/intrinsics.feather"
MOUNTS = "calibration/egovehicle_SE3_sensor.feather"


def one_line(error: pytest.ExceptionInfo[Exception]) -> None:
    assert "\n" not in str(error.value)


def drop_rows(columns: dict[str, Any], rows: slice | list[int]) -> None:
    for name in columns:
        columns[name] = np.delete(columns[name], np.arange(len(columns[name]))[rows])


def test_everything_written_comes_back(av2_log: Path, made: Any) -> None:
    drive = read_av2(av2_log)

    assert drive.id == "av2:made-log"
    assert drive.warnings == ()
    np.testing.assert_array_equal(drive.trajectory.timestamps_ns, made.trajectory.timestamps_ns)
    np.testing.assert_allclose(
        drive.trajectory.translations, made.trajectory.translations, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        drive.trajectory.rotations, made.trajectory.rotations, rtol=0, atol=1e-12
    )
    for camera in made.cameras:
        read = drive.cameras[camera.name]
        np.testing.assert_array_equal(read.matrix, camera.matrix)
        np.testing.assert_allclose(read.ego_SE3_cam.matrix, camera.ego_SE3_cam.matrix, atol=1e-12)
        assert (read.width_px, read.height_px) == (64, 40)
    assert len(drive.images) == 8
    for ref in drive.images:
        np.testing.assert_array_equal(
            read_image(ref, drive.cameras[ref.camera]), made.images[ref.camera][ref.timestamp_ns]
        )
    assert [s.timestamp_ns for s in drive.sweeps] == made.times_ns
    for ref, truth in zip(drive.sweeps, made.sweeps, strict=True):
        sweep = drive.read_sweep(ref)
        # float16 keeps 11 bits: half a step at 30 m is 8 mm.
        np.testing.assert_allclose(sweep.points_ego, truth.points_ego, rtol=0, atol=0.008)
        np.testing.assert_array_equal(sweep.intensity, truth.intensity)
        np.testing.assert_array_equal(sweep.ring, truth.ring)
    assert [path.name for path in drive.reference_maps] == [
        "log_map_archive_made-log____PIT_city_1.json"
    ]


def test_the_data_sets_own_package_reads_the_same(av2_log: Path) -> None:
    pytest.importorskip("av2", reason="av2 has no wheel for this Python")
    from av2.geometry.camera.pinhole_camera import PinholeCamera as TheirCamera
    from av2.structures.sweep import Sweep as TheirSweep
    from av2.utils.io import read_city_SE3_ego

    drive = read_av2(av2_log)
    ours = drive.read_sweep(drive.sweeps[1])
    theirs = TheirSweep.from_feather(drive.sweeps[1].path)
    np.testing.assert_array_equal(ours.points_ego, theirs.xyz)
    np.testing.assert_array_equal(ours.intensity, theirs.intensity)
    np.testing.assert_array_equal(ours.ring, theirs.laser_number)
    for time_ns, pose in read_city_SE3_ego(av2_log).items():
        np.testing.assert_allclose(
            drive.trajectory.interpolate(time_ns).matrix, pose.transform_matrix, atol=1e-12
        )
    points = np.column_stack([np.full(50, 12.0), *np.random.default_rng(2).uniform(-4, 4, (2, 50))])
    for name, camera in drive.cameras.items():
        uv, points_cam, _ = TheirCamera.from_feather(av2_log, name).project_ego_to_img(points)
        projection = camera.project(points)
        np.testing.assert_allclose(projection.uv, uv[:, :2], rtol=0, atol=1e-9)
        np.testing.assert_allclose(projection.depth_m, points_cam[:, 2], rtol=0, atol=1e-9)


def test_the_published_lens_is_applied_only_to_raw_images(made: Any, tmp_path: Path) -> None:
    first = made.cameras[0]
    lens = (-0.28, -0.04, 0.0, 0.0, 0.1)
    camera = PinholeCamera(
        first.name, 64, 40, 50.0, 51.0, 31.5, 19.5, first.ego_SE3_cam, distortion=lens
    )
    log = made.write_av2(tmp_path / "log", cameras=[camera], images={})
    assert not read_av2(log).cameras[first.name].is_distorted
    assert read_av2(log, is_rectified=False).cameras[first.name].distortion == lens


@pytest.mark.parametrize("city", sorted(CITY_UTM_ZONE_LAT_LON))
def test_the_city_frame_agrees_with_the_data_sets_own_package(
    city: str, made: Any, tmp_path: Path
) -> None:
    pytest.importorskip("av2", reason="av2 has no wheel for this Python")
    from av2.geometry.utm import CityName, convert_city_coords_to_utm, convert_city_coords_to_wgs84

    frame = read_av2(made.write_av2(tmp_path / "log", city=city)).frame
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-5000, 5000, (20, 2)), np.zeros(20)])
    utm = convert_city_coords_to_utm(points[:, :2], CityName(city))
    np.testing.assert_allclose(points[:, :2] + frame.offset_m[:2], utm, rtol=0, atol=1e-3)
    lat_lon = convert_city_coords_to_wgs84(points[:, :2], CityName(city))
    # One millimetre is 9e-9 degrees of latitude.
    np.testing.assert_allclose(frame.to_wgs84(points)[:, 1::-1], lat_lon, rtol=0, atol=9e-9)


@pytest.mark.parametrize("city", [None, "XYZ"])
def test_without_a_known_city_the_frame_has_no_origin_and_that_is_said(
    city: str | None, made: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        drive = read_av2(made.write_av2(tmp_path / "log", city=city))
    assert not drive.frame.is_georeferenced
    assert "the place on earth is unknown" in drive.warnings[0]
    assert "place on earth" in caplog.text


@pytest.mark.parametrize(
    ("without", "expected"),
    [
        (["sensors/cameras"], (2, 0, 4)),
        (["sensors/lidar"], (2, 8, 0)),
        (["sensors"], (2, 0, 0)),
        (["sensors", "calibration"], (0, 0, 0)),
        (["sensors/cameras", "calibration"], (0, 0, 4)),
    ],
)
def test_recorded_logs_may_lack_parts(
    without: list[str], expected: tuple[int, int, int], av2_log: Path
) -> None:
    for folder in without:
        shutil.rmtree(av2_log / folder)
    drive = read_av2(av2_log)
    assert (len(drive.cameras), len(drive.images), len(drive.sweeps)) == expected
    assert drive.warnings == ()


# --- motion compensation -------------------------------------------------------------


def raw_log(made: Any, log: Path) -> tuple[Path, Sweep, np.ndarray]:
    """A log whose one sweep is as a turning lidar saw it, and its compensated truth."""
    time = made.times_ns[1]
    offsets = np.linspace(0, 90_000_000, 50).astype(np.int32)
    points = np.random.default_rng(3).uniform(-2, 2, (50, 3))
    seen = undo_ego_motion_compensation(points, offsets, time, made.trajectory)
    zeros = np.zeros(50, np.uint8)
    sweep = Sweep(time, seen, zeros, zeros)
    made.write_av2(log, sweeps=[sweep], offsets_ns={time: offsets})
    return log, sweep, points


def test_sweeps_are_compensated_only_when_said_to_be_raw(made: Any, tmp_path: Path) -> None:
    log, sweep, truth = raw_log(made, tmp_path / "log")
    step = 0.002  # float16 between 2 and 4 m
    as_stored = read_av2(log)
    np.testing.assert_allclose(
        as_stored.read_sweep(as_stored.sweeps[0]).points_ego, sweep.points_ego, atol=step
    )
    assert np.abs(sweep.points_ego - truth).max() > 0.5  # the motion is not small
    raw = read_av2(log, is_compensated=False)
    np.testing.assert_allclose(raw.read_sweep(raw.sweeps[0]).points_ego, truth, atol=step)


def test_a_raw_sweep_without_times_or_poses_is_refused(
    made: Any, tmp_path: Path, edit_feather: EditFeather
) -> None:
    log, sweep, _ = raw_log(made, tmp_path / "log")
    path = log / "sensors" / "lidar" / f"{sweep.timestamp_ns}.feather"
    edit_feather(path, lambda c: c.update(offset_ns=c["offset_ns"] + 10**9))
    drive = read_av2(log, is_compensated=False)
    with pytest.raises(PoseError, match="needed to compensate the sweep"):
        drive.read_sweep(drive.sweeps[0])
    edit_feather(path, lambda c: c.pop("offset_ns"))
    with pytest.raises(SweepError, match="lacks the columns offset_ns"):
        drive.read_sweep(drive.sweeps[0])
    assert len(read_av2(log).read_sweep(drive.sweeps[0]).points_ego) == 50


# --- cameras -------------------------------------------------------------------------


def test_cameras_are_chosen_by_name(av2_log: Path) -> None:
    drive = read_av2(av2_log, ["front_right"])
    assert list(drive.cameras) == ["front_right"]
    assert len(drive.images) == 4
    with pytest.raises(DriveError, match="no camera 'rear'; it has front_left, front_right"):
        read_av2(av2_log, ["rear"])


def test_a_camera_without_a_mount_is_left_out_unless_asked_for(
    av2_log: Path, edit_feather: EditFeather
) -> None:
    edit_feather(av2_log / MOUNTS, lambda c: drop_rows(c, [0]))
    drive = read_av2(av2_log)
    assert list(drive.cameras) == ["front_right"]
    assert len(drive.images) == 4
    assert "left out front_left: camera front_left has intrinsics but no mount" in drive.warnings[0]
    with pytest.raises(CalibrationError, match="has no row for it") as error:
        read_av2(av2_log, ["front_left"])
    one_line(error)


def test_no_mount_at_all_is_an_error_only_where_there_are_images(
    av2_log: Path,
) -> None:
    (av2_log / MOUNTS).unlink()
    with pytest.raises(CalibrationError, match="not one of them can be used") as error:
        read_av2(av2_log)
    one_line(error)
    shutil.rmtree(av2_log / "sensors" / "cameras")
    drive = read_av2(av2_log)
    assert drive.cameras == {}
    assert len(drive.warnings) == 2


def test_images_without_calibration_are_an_error(av2_log: Path) -> None:
    shutil.rmtree(av2_log / "calibration")
    with pytest.raises(
        CalibrationError, match=r"has 4 images but no calibration: .*intrinsics\.feather is missing"
    ) as error:
        read_av2(av2_log)
    one_line(error)


def test_one_uncalibrated_camera_folder_is_left_out_and_said(av2_log: Path) -> None:
    cameras = av2_log / "sensors" / "cameras"
    shutil.copytree(cameras / "front_left", cameras / "roof")
    (cameras / "no_images").mkdir()
    drive = read_av2(av2_log)
    assert list(drive.cameras) == ["front_left", "front_right"]
    assert [w for w in drive.warnings if "roof has 4 images but no calibration" in w]
    assert len(drive.warnings) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx_px": np.nan}, "must be finite"),
        ({"fy_px": 0.0}, "must be positive"),
        ({"width_px": 0}, "must be positive"),
        ({"height_px": 39.5}, "expected whole pixels"),
    ],
)
def test_unusable_intrinsics_name_the_camera(
    av2_log: Path, edit_feather: EditFeather, change: dict[str, float], message: str
) -> None:
    def spoil(columns: dict[str, Any]) -> None:
        for name, value in change.items():
            columns[name] = columns[name].astype(np.float64)
            columns[name][0] = value

    edit_feather(av2_log / INTRINSICS, spoil)
    assert list(read_av2(av2_log).cameras) == ["front_right"]
    with pytest.raises(CalibrationError, match=message) as error:
        read_av2(av2_log, ["front_left"])
    assert "front_left" in str(error.value)
    one_line(error)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_mount_without_direction_names_the_camera(
    av2_log: Path, edit_feather: EditFeather, value: float
) -> None:
    def spoil(columns: dict[str, Any]) -> None:
        for name in ("qw", "qx", "qy", "qz"):
            columns[name][0] = value

    edit_feather(av2_log / MOUNTS, spoil)
    with pytest.raises(CalibrationError, match=r"Mount of front_left .* has no direction"):
        read_av2(av2_log, ["front_left"])


def test_files_not_named_by_a_time_are_left_out_and_said(av2_log: Path) -> None:
    folder = av2_log / "sensors" / "cameras" / "front_left"
    (folder / "thumbnail.png").write_bytes(b"")
    (folder / "²³.png").write_bytes(b"")
    (folder / "notes.txt").write_text("")
    drive = read_av2(av2_log)
    assert len(drive.images) == 8
    assert "2 files in" in drive.warnings[0]


# --- broken tables -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "error_type"),
    [(POSES_FILE, PoseError), (INTRINSICS, CalibrationError), (MOUNTS, CalibrationError)],
)
def test_a_truncated_table_or_one_without_its_columns_is_named(
    av2_log: Path, edit_feather: EditFeather, file: str, error_type: type[Exception]
) -> None:
    path = av2_log / file
    whole = path.read_bytes()
    for size in (0, 5, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(error_type, match="is not a readable feather table") as error:
            read_av2(av2_log)
        assert path.name in str(error.value)
        one_line(error)
    path.write_bytes(whole)
    column = "fx_px" if file == INTRINSICS else "qw"
    edit_feather(path, lambda c: c.update({column: c[column].astype(str)}))
    with pytest.raises(error_type, match=f"column {column} is object; expected numbers"):
        read_av2(av2_log)
    edit_feather(path, lambda c: c.pop(column))
    with pytest.raises(error_type, match=f"lacks the columns {column}; it has "):
        read_av2(av2_log)


def test_a_missing_pose_table_is_named(av2_log: Path) -> None:
    (av2_log / POSES_FILE).unlink()
    with pytest.raises(PoseError, match=r"city_SE3_egovehicle\.feather is missing"):
        read_av2(av2_log)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("q", 0.0, "no usable quaternion"),
        ("q", np.nan, "no usable quaternion"),
        ("tx_m", np.nan, "NaN or infinite"),
        ("tz_m", np.inf, "NaN or infinite"),
    ],
)
def test_an_unusable_pose_names_the_file(
    av2_log: Path, edit_feather: EditFeather, column: str, value: float, message: str
) -> None:
    def spoil(columns: dict[str, Any]) -> None:
        for name in ("qw", "qx", "qy", "qz") if column == "q" else (column,):
            columns[name][4] = value

    edit_feather(av2_log / POSES_FILE, spoil)
    with pytest.raises(PoseError, match=message) as error:
        read_av2(av2_log)
    assert POSES_FILE in str(error.value)
    one_line(error)


def test_no_poses_and_times_that_are_not_whole_are_refused(
    av2_log: Path, edit_feather: EditFeather
) -> None:
    path = av2_log / POSES_FILE
    edit_feather(path, lambda c: c.update(timestamp_ns=c["timestamp_ns"].astype(np.float64)))
    with pytest.raises(PoseError, match="timestamp_ns is float64; expected integer"):
        read_av2(av2_log)
    edit_feather(path, lambda c: c.update(timestamp_ns=c["timestamp_ns"].astype(np.int64)))
    edit_feather(path, lambda c: drop_rows(c, slice(None)))
    with pytest.raises(PoseError, match="needs at least one pose"):
        read_av2(av2_log)


def test_poses_out_of_order_are_sorted_and_said(
    av2_log: Path, made: Any, edit_feather: EditFeather
) -> None:
    def shuffle(columns: dict[str, Any]) -> None:
        order = np.r_[0, 2, 1, 3 : len(made.trajectory), 3]  # one swap, one repeat
        for name in columns:
            columns[name] = columns[name][order]
        columns["tx_m"][-1] += 0.5  # which contradicts the first of its time

    edit_feather(av2_log / POSES_FILE, shuffle)
    drive = read_av2(av2_log)
    np.testing.assert_array_equal(drive.trajectory.timestamps_ns, made.trajectory.timestamps_ns)
    np.testing.assert_allclose(
        drive.trajectory.translations, made.trajectory.translations, atol=1e-12
    )
    assert "1 poses in city_SE3_egovehicle.feather lie up to 0.500 m" in drive.warnings[0]
    assert "go back in time 2 times" in drive.warnings[1]


# --- broken sweeps -------------------------------------------------------------------


@pytest.fixture
def sweep_path(av2_log: Path) -> Path:
    return min((av2_log / "sensors" / "lidar").iterdir())


def read_first(av2_log: Path) -> Sweep:
    drive = read_av2(av2_log)
    return drive.read_sweep(drive.sweeps[0])


def test_a_truncated_sweep_is_refused(av2_log: Path, sweep_path: Path) -> None:
    whole = sweep_path.read_bytes()
    for size in (0, 8, len(whole) // 2, len(whole) - 1):
        sweep_path.write_bytes(whole[:size])
        with pytest.raises(SweepError, match=rf"not a readable feather table \({size} bytes") as e:
            read_first(av2_log)
        one_line(e)


def test_a_sweep_without_its_columns_is_refused(
    av2_log: Path, sweep_path: Path, edit_feather: EditFeather
) -> None:
    edit_feather(sweep_path, lambda c: c.pop("laser_number"))
    assert not read_first(av2_log).ring.any()
    edit_feather(sweep_path, lambda c: (c.pop("z"), c.pop("intensity")))
    with pytest.raises(SweepError, match="lacks the columns z, intensity; it has x, y") as error:
        read_first(av2_log)
    one_line(error)


def test_points_that_are_not_finite_are_dropped_counted_and_logged(
    av2_log: Path, sweep_path: Path, edit_feather: EditFeather, caplog: pytest.LogCaptureFixture
) -> None:
    before = read_first(av2_log)

    def spoil(columns: dict[str, Any]) -> None:
        columns["x"][3], columns["z"][7] = np.nan, -np.inf

    edit_feather(sweep_path, spoil)
    with caplog.at_level(logging.WARNING):
        after = read_first(av2_log)
    assert "dropped 2 points" in caplog.text
    kept = np.delete(np.arange(50), [3, 7])
    np.testing.assert_array_equal(after.points_ego, before.points_ego[kept])
    np.testing.assert_array_equal(after.intensity, before.intensity[kept])
    np.testing.assert_array_equal(after.ring, before.ring[kept])


def test_an_empty_sweep_and_one_of_nothing_but_nan_are_refused(
    av2_log: Path, sweep_path: Path, edit_feather: EditFeather
) -> None:
    edit_feather(sweep_path, lambda c: c.update(y=np.full(50, np.nan, np.float16)))
    with pytest.raises(SweepError, match="all 50 points are NaN or infinite"):
        read_first(av2_log)
    edit_feather(sweep_path, lambda c: drop_rows(c, slice(None)))
    with pytest.raises(SweepError, match="has no points: it is empty"):
        read_first(av2_log)


def test_an_intensity_of_another_scale_is_refused(
    av2_log: Path, sweep_path: Path, edit_feather: EditFeather
) -> None:
    edit_feather(
        sweep_path, lambda c: c.update(intensity=np.linspace(0, 65535, 50).astype(np.uint16))
    )
    with pytest.raises(SweepError, match=r"intensity runs from 0 to 65535; expected 0\.\.255"):
        read_first(av2_log)


def test_a_path_that_is_no_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DriveError, match="is not a folder"):
        read_av2(tmp_path / "nowhere")
