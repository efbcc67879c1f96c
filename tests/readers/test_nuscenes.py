"""The nuScenes layout: what was written comes back, and bad input ends in one line."""

import json
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hdmap_tools.errors import CalibrationError, DriveError, PoseError, SweepError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.drive import Sweep
from hdmap_tools.readers.image import read_image
from hdmap_tools.readers.nuscenes import MAP_ORIGIN_LAT_LON, read_nuscenes
from hdmap_tools.readers.nuscenes_tables import read_table

EditTable = Callable[[str, Callable[[list[dict[str, Any]]], Any]], None]


def one_line(error: pytest.ExceptionInfo[Exception]) -> None:
    assert "\n" not in str(error.value)


def test_everything_written_comes_back(nuscenes_root: Path, made: Any) -> None:
    drive = read_nuscenes(nuscenes_root)

    assert drive.id == "nuscenes:scene-0001"
    assert drive.warnings == ()
    assert [s.timestamp_ns for s in drive.sweeps] == made.times_ns
    assert len(drive.images) == 8
    assert list(drive.cameras) == ["front_left", "front_right"]
    for camera in made.cameras:
        read = drive.cameras[camera.name]
        assert (read.fx, read.fy, read.cx, read.cy) == (50.0, 51.0, 31.5, 19.5)
        assert (read.width_px, read.height_px) == (64, 40)
        assert not read.is_distorted
        np.testing.assert_allclose(read.ego_SE3_cam.matrix, camera.ego_SE3_cam.matrix, atol=1e-12)
    for ref in drive.images:
        np.testing.assert_array_equal(
            read_image(ref, drive.cameras[ref.camera]), made.images[ref.camera][ref.timestamp_ns]
        )
    for ref, truth in zip(drive.sweeps, made.sweeps, strict=True):
        sweep = drive.read_sweep(ref)
        # float32 at 50 m from the sensor: 4 micrometres.
        np.testing.assert_allclose(sweep.points_ego, truth.points_ego, rtol=0, atol=1e-5)
        np.testing.assert_array_equal(sweep.intensity, truth.intensity)
        np.testing.assert_array_equal(sweep.ring, truth.ring)


def test_each_image_has_its_own_pose_and_times_between_are_interpolated(
    nuscenes_root: Path, made: Any
) -> None:
    drive = read_nuscenes(nuscenes_root)
    for ref in drive.images:
        np.testing.assert_allclose(
            drive.trajectory.interpolate(ref.timestamp_ns).matrix,
            made.trajectory.interpolate(ref.timestamp_ns).matrix,
            rtol=0,
            atol=1e-9,
        )
    between = made.times_ns[1] + 50_000_000
    found = drive.trajectory.interpolate(between).translation
    ends = [made.trajectory.interpolate(t).translation for t in made.times_ns[1:3]]
    np.testing.assert_allclose(found, (ends[0] + ends[1]) / 2, rtol=0, atol=1e-9)


def test_sweeps_between_key_frames_are_read_too(made: Any, tmp_path: Path) -> None:
    made.write_nuscenes(tmp_path, key_frame_times_ns=made.times_ns[:1])
    drive = read_nuscenes(tmp_path)
    assert len(drive.sweeps) == 4
    assert len(drive.images) == 8
    assert {ref.path.parent.parent.name for ref in drive.images} == {"samples", "sweeps"}


@pytest.mark.parametrize("location", sorted(MAP_ORIGIN_LAT_LON))
def test_the_city_frame_is_that_of_the_logs_location(
    location: str, made: Any, tmp_path: Path
) -> None:
    drive = read_nuscenes(made.write_nuscenes(tmp_path, location=location))
    lat, lon = MAP_ORIGIN_LAT_LON[location]
    np.testing.assert_allclose(
        drive.frame.to_wgs84(np.zeros((1, 3)))[0, :2], (lon, lat), rtol=0, atol=1e-9
    )


def test_an_unknown_location_gives_a_frame_without_origin_and_a_warning(
    made: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        drive = read_nuscenes(made.write_nuscenes(tmp_path, location="atlantis"))
    assert not drive.frame.is_georeferenced
    assert "location 'atlantis' is not a nuScenes map" in drive.warnings[0]
    assert "atlantis" in caplog.text


def test_several_scenes_one_is_chosen_by_name_or_token(made: Any, nuscenes_root: Path) -> None:
    later = made.trajectory
    made.write_nuscenes(
        nuscenes_root, scene="scene-0002", sweeps=made.sweeps[:2], images={}, trajectory=later
    )
    with pytest.raises(DriveError, match=r"2 scenes; choose .* scene-0001, scene-0002") as error:
        read_nuscenes(nuscenes_root)
    one_line(error)

    drive = read_nuscenes(nuscenes_root, "scene-0002")
    assert (len(drive.images), len(drive.sweeps), len(drive.trajectory)) == (0, 2, 2)
    rows = json.loads((nuscenes_root / "v1.0-mini" / "scene.json").read_text())
    token = next(r["token"] for r in rows if r["name"] == "scene-0001")
    assert len(read_nuscenes(nuscenes_root, token).images) == 8


def test_a_scene_that_does_not_exist_lists_what_there_is(nuscenes_root: Path) -> None:
    with pytest.raises(DriveError, match="has no scene 'scene-9'; it has: scene-0001") as error:
        read_nuscenes(nuscenes_root, "scene-9")
    one_line(error)


def test_several_versions_need_a_choice(made: Any, nuscenes_root: Path) -> None:
    made.write_nuscenes(nuscenes_root, version="v1.0-trainval", scene="scene-0002")
    with pytest.raises(DriveError, match=r"several versions .*\(v1\.0-mini, v1\.0-trainval\)"):
        read_nuscenes(nuscenes_root)
    assert read_nuscenes(nuscenes_root, version="v1.0-trainval").name == "scene-0002"
    assert read_nuscenes(nuscenes_root / "v1.0-mini").name == "scene-0001"
    assert read_nuscenes(nuscenes_root / "v1.0-mini").root == nuscenes_root
    with pytest.raises(DriveError, match="no version 'v2'"):
        read_nuscenes(nuscenes_root, version="v2")


def test_masks_of_the_location_are_reference_maps(nuscenes_root: Path) -> None:
    described = {"map": "singapore-onenorth", "resolution_m": 0.1, "origin_xy_m": [0, 0]}
    for name, document, has_png in (
        ("mask", {**described, "size_px": [2, 2]}, True),
        ("elsewhere", {**described, "size_px": [2, 2], "map": "boston-seaport"}, True),
        ("no_size", described, True),
        ("no_png", {**described, "size_px": [2, 2]}, False),
        ("a_list", [1], True),
    ):
        (nuscenes_root / f"{name}.json").write_text(json.dumps(document))
        if has_png:
            (nuscenes_root / f"{name}.png").write_bytes(b"")
    (nuscenes_root / "broken.json").write_text("{")
    (nuscenes_root / "broken.png").write_bytes(b"")
    drive = read_nuscenes(nuscenes_root)
    assert drive.reference_maps == (nuscenes_root / "mask.png",)
    assert len(drive.warnings) == 1
    assert "broken.json is not readable JSON" in drive.warnings[0]


def test_unwanted_rows_are_not_kept(nuscenes_root: Path) -> None:
    rows = read_table(nuscenes_root / "v1.0-mini", "ego_pose", lambda r: r["timestamp"] < 0)
    assert rows == []


# --- cameras -------------------------------------------------------------------------


def test_cameras_are_chosen_by_name(nuscenes_root: Path) -> None:
    drive = read_nuscenes(nuscenes_root, cameras=["front_right"])
    assert list(drive.cameras) == ["front_right"]
    assert {ref.camera for ref in drive.images} == {"front_right"}
    with pytest.raises(
        DriveError, match="no camera 'rear'; it has front_left, front_right"
    ) as error:
        read_nuscenes(nuscenes_root, cameras=["rear"])
    one_line(error)


def break_intrinsics(rows: list[dict[str, Any]], *channels: int) -> None:
    for index in channels:
        rows[index]["camera_intrinsic"] = []


def test_a_camera_without_intrinsics_is_left_out_and_said(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("calibrated_sensor", lambda rows: break_intrinsics(rows, 0))
    drive = read_nuscenes(nuscenes_root)
    assert list(drive.cameras) == ["front_right"]
    assert len(drive.images) == 4
    assert "left out front_left: Camera front_left has no usable camera_intrinsic" in str(
        drive.warnings
    )
    with pytest.raises(CalibrationError, match="expected a 3x3 matrix") as error:
        read_nuscenes(nuscenes_root, cameras=["front_left"])
    one_line(error)


def test_no_camera_with_intrinsics_is_an_error(nuscenes_root: Path, edit_table: EditTable) -> None:
    edit_table("calibrated_sensor", lambda rows: break_intrinsics(rows, 0, 1))
    with pytest.raises(CalibrationError, match="not one of them can be used") as error:
        read_nuscenes(nuscenes_root)
    one_line(error)


def test_a_zero_mount_quaternion_names_the_camera(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("calibrated_sensor", lambda rows: rows[0].update(rotation=[0, 0, 0, 0]))
    with pytest.raises(CalibrationError, match=r"Mount of front_left .* has no direction"):
        read_nuscenes(nuscenes_root, cameras=["front_left"])


def test_a_camera_without_a_pose_is_left_out_and_said(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("ego_pose", lambda rows: rows.__delitem__(slice(0, 4)))  # those of front_left
    drive = read_nuscenes(nuscenes_root)
    assert list(drive.cameras) == ["front_right"]
    with pytest.raises(PoseError, match="4 of 4 measurements of front_left have no ego pose"):
        read_nuscenes(nuscenes_root, cameras=["front_left"])


def test_images_without_a_pose_are_left_out_and_counted(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("ego_pose", lambda rows: rows.__delitem__(slice(0, 3)))
    drive = read_nuscenes(nuscenes_root)
    assert sum(ref.camera == "front_left" for ref in drive.images) == 1
    assert "3 of 4 measurements of front_left" in drive.warnings[0]


# --- broken tables -------------------------------------------------------------------

TABLES = ["scene", "log", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor"]


@pytest.mark.parametrize("table", TABLES[1:])
def test_a_missing_table_is_named(nuscenes_root: Path, table: str) -> None:
    os.remove(nuscenes_root / "v1.0-mini" / f"{table}.json")
    calibration = table in ("calibrated_sensor", "sensor")
    with pytest.raises(
        CalibrationError if calibration else DriveError, match=rf"{table}\.json is missing"
    ) as error:
        read_nuscenes(nuscenes_root)
    one_line(error)


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[{", "is not valid JSON"),
        (b"\xff\xfe\x00", "is not valid JSON"),
        (b"", "is not valid JSON"),
        (b"[" * 100_000, "is not valid JSON"),
        (b"3", "is not a list of rows"),
        (b"[[1]]", "is not a list of rows"),
        (b'[{"token": "a"}]', "has a row without"),
    ],
)
def test_a_broken_table_is_named(
    nuscenes_root: Path, table: str, content: bytes, message: str
) -> None:
    (nuscenes_root / "v1.0-mini" / f"{table}.json").write_bytes(content)
    with pytest.raises(DriveError, match=message) as error:
        read_nuscenes(nuscenes_root)
    assert f"{table}.json" in str(error.value)
    one_line(error)


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("sample_data", "timestamp", "soon"),
        ("sample_data", "filename", None),
        ("sample_data", "sample_token", ["a"]),
        ("ego_pose", "timestamp", 1.5),
        ("sample", "token", 3),
        ("log", "location", None),
        ("scene", "name", None),
        ("sensor", "channel", 0),
    ],
)
def test_a_value_of_the_wrong_type_is_named(
    nuscenes_root: Path, edit_table: EditTable, table: str, column: str, value: object
) -> None:
    edit_table(table, lambda rows: rows[0].update({column: value}))
    with pytest.raises(DriveError, match=rf"{table}\.json has {column} = ") as error:
        read_nuscenes(nuscenes_root)
    one_line(error)


@pytest.mark.parametrize("table", ["log", "calibrated_sensor", "sensor"])
def test_a_token_that_leads_nowhere_is_named(
    nuscenes_root: Path, edit_table: EditTable, table: str
) -> None:
    edit_table(table, lambda rows: rows[0].update(token="nowhere"))
    with pytest.raises(DriveError, match=rf"{table}\.json has no row with token") as error:
        read_nuscenes(nuscenes_root)
    one_line(error)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": [0, 0, 0, 0]}, "no usable quaternion"),
        ({"rotation": [float("nan"), 0, 0, 1]}, "no usable quaternion"),
        ({"rotation": [1, 0, 0]}, "unusable"),
        ({"translation": [float("inf"), 0, 0]}, "NaN or infinite"),
        ({"translation": [0, 0]}, "unusable"),
        ({"translation": None}, "unusable"),
    ],
)
def test_an_unusable_pose_is_an_error_that_names_the_table(
    nuscenes_root: Path, edit_table: EditTable, change: dict[str, Any], message: str
) -> None:
    edit_table("ego_pose", lambda rows: rows[2].update(change))
    with pytest.raises(PoseError, match=message) as error:
        read_nuscenes(nuscenes_root)
    assert "ego_pose.json" in str(error.value)
    one_line(error)


def test_poses_in_any_order_give_the_same_trajectory(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    before = read_nuscenes(nuscenes_root).trajectory
    edit_table("ego_pose", lambda rows: rows.reverse())
    after = read_nuscenes(nuscenes_root).trajectory
    np.testing.assert_array_equal(before.timestamps_ns, after.timestamps_ns)
    np.testing.assert_array_equal(before.translations, after.translations)


def test_a_scene_without_poses_or_measurements_is_an_error(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("ego_pose", lambda rows: rows.clear())
    with pytest.raises(PoseError, match="none of the poses"):
        read_nuscenes(nuscenes_root)
    edit_table("sample_data", lambda rows: rows.clear())
    with pytest.raises(DriveError, match="has no measurements"):
        read_nuscenes(nuscenes_root)
    edit_table("scene", lambda rows: rows.clear())
    with pytest.raises(DriveError, match="has no scenes"):
        read_nuscenes(nuscenes_root)


def test_files_that_do_not_exist_are_counted_and_all_missing_is_an_error(
    nuscenes_root: Path,
) -> None:
    for path in sorted((nuscenes_root / "samples" / "front_left").iterdir())[:3]:
        path.unlink()
    drive = read_nuscenes(nuscenes_root)
    assert len(drive.images) == 5
    assert "3 files of front_left do not exist" in drive.warnings[0]

    (nuscenes_root / "samples").rename(nuscenes_root / "elsewhere")
    with pytest.raises(DriveError, match="none of its 12 files exist") as error:
        read_nuscenes(nuscenes_root)
    one_line(error)


# --- broken sweeps -------------------------------------------------------------------


def sweep_file(root: Path) -> Path:
    return min((root / "samples" / "LIDAR_TOP").iterdir())


@pytest.mark.parametrize("size", [0, 1, 19, 990])
def test_a_truncated_or_empty_sweep_is_refused(nuscenes_root: Path, size: int) -> None:
    path = sweep_file(nuscenes_root)
    path.write_bytes(path.read_bytes()[:size])
    drive = read_nuscenes(nuscenes_root)
    with pytest.raises(SweepError, match=rf"has {size} bytes; expected .* multiple of 20") as error:
        drive.read_sweep(drive.sweeps[0])
    one_line(error)


def test_points_that_are_not_finite_are_dropped_counted_and_logged(
    nuscenes_root: Path, made: Any, caplog: pytest.LogCaptureFixture
) -> None:
    path = sweep_file(nuscenes_root)
    values = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 5).copy()
    values[3, 0], values[7, 2], values[9, 3] = np.nan, np.inf, np.nan
    path.write_bytes(values.tobytes())
    drive = read_nuscenes(nuscenes_root)
    with caplog.at_level(logging.WARNING):
        sweep = drive.read_sweep(drive.sweeps[0])
    assert "dropped 3 points" in caplog.text
    kept = np.delete(np.arange(50), [3, 7, 9])
    np.testing.assert_allclose(sweep.points_ego, made.sweeps[0].points_ego[kept], atol=1e-5)
    np.testing.assert_array_equal(sweep.intensity, made.sweeps[0].intensity[kept])


def test_a_sweep_of_nothing_but_nan_is_refused(nuscenes_root: Path) -> None:
    path = sweep_file(nuscenes_root)
    path.write_bytes(np.full((10, 5), np.nan, "<f4").tobytes())
    drive = read_nuscenes(nuscenes_root)
    with pytest.raises(SweepError, match="all 10 points are NaN or infinite"):
        drive.read_sweep(drive.sweeps[0])


def test_an_intensity_of_another_scale_is_refused(nuscenes_root: Path) -> None:
    path = sweep_file(nuscenes_root)
    values = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 5).copy()
    values[:, 3] = 4000
    path.write_bytes(values.tobytes())
    drive = read_nuscenes(nuscenes_root)
    with pytest.raises(SweepError, match=r"intensity runs from 4000 to 4000; expected 0\.\.255"):
        drive.read_sweep(drive.sweeps[0])


def test_a_sweep_that_vanished_is_an_error(nuscenes_root: Path) -> None:
    drive = read_nuscenes(nuscenes_root)
    sweep_file(nuscenes_root).unlink()
    with pytest.raises(SweepError, match="cannot be read: No such file"):
        drive.read_sweep(drive.sweeps[0])


def test_a_tilted_lidar_is_turned_into_the_ego_frame(made: Any, tmp_path: Path) -> None:
    mount = SE3.from_quaternion(0.7, -0.1, 0.05, -0.7, np.array([0.9, 0.1, 1.8]))
    point = np.array([[10.0, 2.0, 0.0]])
    sweep = Sweep(made.times_ns[0], point, np.array([9], np.uint8), np.array([1], np.uint8))
    made.write_nuscenes(tmp_path, sweeps=[sweep], ego_SE3_lidar=mount)
    stored = np.frombuffer(sweep_file(tmp_path).read_bytes(), "<f4")[:3]
    np.testing.assert_allclose(
        stored, mount.rotation.T @ (point[0] - mount.translation), rtol=0, atol=1e-5
    )
    drive = read_nuscenes(tmp_path)
    np.testing.assert_allclose(drive.read_sweep(drive.sweeps[0]).points_ego, point, atol=1e-5)


def test_cameras_of_two_calibrations_are_refused(
    made: Any, nuscenes_root: Path, edit_table: EditTable
) -> None:
    assert isinstance(made.cameras[0], PinholeCamera)
    edit_table("sample_data", lambda rows: rows[0].update(width=32))
    with pytest.raises(CalibrationError, match="1 calibrations and 2 image sizes"):
        read_nuscenes(nuscenes_root, cameras=["front_left"])
