"""Tables that hold what no drive has: one line that names the table and the row, or a warning."""

import copy
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest

from hdmap_tools.errors import CalibrationError, DriveError, PoseError, SweepError
from hdmap_tools.readers.av2 import POSES_FILE, read_av2
from hdmap_tools.readers.nuscenes import read_nuscenes
from hdmap_tools.readers.open_drive import open_drive

EditTable = Callable[[str, Callable[[list[dict[str, Any]]], Any]], None]
EditFeather = Callable[[Path, Callable[[dict[str, Any]], Any]], None]

INTRINSICS = "calibration/intrinsics.feather"
MOUNTS = "calibration/egovehicle_SE3_sensor.feather"


@contextmanager
def refused(error_type: type[Exception], *words: str) -> Iterator[None]:
    """The block ends in that error, on one printable line of bearable length with these words."""
    with pytest.raises(error_type) as caught:
        yield
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 700
    for word in words:
        assert word in message


# --- nuScenes: rows that stand twice -------------------------------------------------


def test_a_measurement_that_stands_twice_is_taken_once(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("sample_data", lambda rows: rows.extend([rows[0], rows[0], rows[9]]))
    drive = read_nuscenes(nuscenes_root)
    assert (len(drive.images), len(drive.sweeps)) == (8, 4)
    assert drive.warnings == ("3 rows of sample_data.json repeat another one and were taken once",)


@pytest.mark.parametrize("same", ["time", "file"])
@pytest.mark.parametrize("index", [1, 9])  # an image, a sweep
def test_a_new_token_does_not_make_a_new_measurement(
    same: str, index: int, nuscenes_root: Path, edit_table: EditTable
) -> None:
    def repeat(rows: list[dict[str, Any]]) -> None:
        row = dict(rows[index], token="ffff")
        if same == "time":
            row["filename"] = rows[index]["filename"].replace("samples/", "samples/./")
        else:
            row["timestamp"] += 1000
        rows.append(row)

    before = read_nuscenes(nuscenes_root)
    edit_table("sample_data", repeat)
    drive = read_nuscenes(nuscenes_root)
    assert len(drive.images) == 8
    assert drive.images == before.images
    assert drive.sweeps == before.sweeps
    (warning,) = drive.warnings
    assert "1 of 5 measurements of " in warning
    assert "the time or the file of an earlier one" in warning
    assert "'ffff'" in warning


@pytest.mark.parametrize(
    ("table", "column", "value", "error_type"),
    [
        ("scene", "name", "scene-0002", DriveError),
        ("log", "location", "boston-seaport", DriveError),
        ("sample_data", "filename", "samples/other.png", DriveError),
        ("sample_data", "width", 65, DriveError),
        ("ego_pose", "translation", [1.0, 2.0, 3.0], PoseError),
        ("ego_pose", "timestamp", 1_532_402_927_000_001, PoseError),
        ("calibrated_sensor", "translation", [1.0, 2.0, 3.0], CalibrationError),
        ("sensor", "modality", "lidar", CalibrationError),
    ],
)
def test_rows_of_one_token_that_contradict_each_other_are_refused(
    nuscenes_root: Path,
    edit_table: EditTable,
    table: str,
    column: str,
    value: object,
    error_type: type[Exception],
) -> None:
    tokens: list[str] = []

    def repeat(rows: list[dict[str, Any]]) -> None:
        tokens.append(rows[0]["token"])
        rows.append({**rows[0], column: value})

    edit_table(table, repeat)
    with refused(error_type, f"{table}.json", "two rows with token", f"{column} is"):
        read_nuscenes(nuscenes_root)
    with refused(error_type, tokens[0]):
        read_nuscenes(nuscenes_root)


@pytest.mark.parametrize("table", ["scene", "log", "sample", "ego_pose", "sensor"])
def test_identical_rows_are_one_row(nuscenes_root: Path, edit_table: EditTable, table: str) -> None:
    edit_table(table, lambda rows: rows.extend(copy.deepcopy(rows)))
    drive = read_nuscenes(nuscenes_root)
    assert (len(drive.images), len(drive.sweeps)) == (8, 4)
    assert len(drive.warnings) == (table != "scene")


# --- nuScenes: values ----------------------------------------------------------------

WHOLE = [2**63, 2**62, 9_223_372_036_854_776, 10**30, 10**400, -1, True, 1e3, None, "7", [], {}]
TEXTS = ["a\0b", "\ud800", "n" * 5000, "two\nlines", "\u2028", 3, None, ["a"], {"a": 1}]
VECTORS: list[object] = [
    None,
    {},
    [],
    "abc",
    7,
    True,
    [10**400] * 4,
    [1e300] * 4,
    [float("nan")] * 4,
    ["1", "0", "0", "0"],
    [True, False, False, False],
    [[1, 0, 0, 0]],
    [None] * 4,
    [{}] * 4,
]


@pytest.mark.parametrize("value", WHOLE)
@pytest.mark.parametrize(
    ("table", "column"),
    [("sample_data", "timestamp"), ("ego_pose", "timestamp"), ("sample_data", "width")],
)
def test_a_number_that_is_no_time_or_size_names_the_row(
    nuscenes_root: Path, edit_table: EditTable, table: str, column: str, value: object
) -> None:
    edit_table(table, lambda rows: rows[3].update({column: value}))
    with refused(DriveError, f"{table}.json has {column} = ", "at row 3 (token '", "whole number"):
        read_nuscenes(nuscenes_root)


@pytest.mark.parametrize("value", TEXTS)
@pytest.mark.parametrize(
    ("table", "column"),
    [
        ("scene", "name"),
        ("log", "location"),
        ("log", "token"),
        ("sample_data", "filename"),
        ("sensor", "channel"),
        ("sensor", "modality"),
    ],
)
def test_a_text_that_is_no_name_names_the_row(
    nuscenes_root: Path, edit_table: EditTable, table: str, column: str, value: object
) -> None:
    edit_table(table, lambda rows: rows[0].update({column: value}))
    with refused(DriveError, f"{table}.json has {column} = ", "at row 0 (token", "; expected "):
        read_nuscenes(nuscenes_root)


@pytest.mark.parametrize("value", ["", ".", "..", "../CAM", "a/b", "a\\b", "/etc"])
def test_a_channel_that_would_name_another_folder_is_refused(
    nuscenes_root: Path, edit_table: EditTable, value: str
) -> None:
    edit_table("sensor", lambda rows: rows[0].update(channel=value))
    with refused(CalibrationError, "sensor.json has channel = ", "a plain name, no path"):
        read_nuscenes(nuscenes_root)


@pytest.mark.parametrize("value", [*VECTORS, [1, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0, 0]])
@pytest.mark.parametrize("table", ["ego_pose", "calibrated_sensor"])
def test_a_rotation_that_is_none_names_the_row(
    nuscenes_root: Path, edit_table: EditTable, table: str, value: object
) -> None:
    tokens: list[str] = []

    def spoil(rows: list[dict[str, Any]]) -> None:
        rows[0].update(rotation=value)
        tokens.append(rows[0]["token"])

    edit_table(table, spoil)
    kind = PoseError if table == "ego_pose" else CalibrationError
    with refused(kind, f"{table}.json", "unusable"):
        read_nuscenes(nuscenes_root, cameras=["front_left"])
    with refused(kind, tokens[0]):
        read_nuscenes(nuscenes_root, cameras=["front_left"])


@pytest.mark.parametrize("value", [*VECTORS, [1, 2], [1e9, 0, 0], [1e300, 0, 0], [0, 0, -2e7]])
@pytest.mark.parametrize("table", ["ego_pose", "calibrated_sensor"])
def test_a_translation_beyond_all_bounds_names_the_row(
    nuscenes_root: Path, edit_table: EditTable, table: str, value: object
) -> None:
    tokens: list[str] = []

    def spoil(rows: list[dict[str, Any]]) -> None:
        rows[0].update(translation=value)
        tokens.append(rows[0]["token"])

    edit_table(table, spoil)
    kind = PoseError if table == "ego_pose" else CalibrationError
    with refused(kind, f"{table}.json", "translation", tokens[0]):
        read_nuscenes(nuscenes_root, cameras=["front_left"])


def test_the_mount_of_the_lidar_is_held_to_the_same(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("calibrated_sensor", lambda rows: rows[-1].update(translation=[0, 0, 101.0]))
    with refused(CalibrationError, "Mount of LIDAR_TOP", "calibrated_sensor.json", "within 100 m"):
        read_nuscenes(nuscenes_root)
    edit_table("calibrated_sensor", lambda rows: rows[-1].update(translation=[0, 0, 99.0]))
    assert len(read_nuscenes(nuscenes_root).sweeps) == 4


@pytest.mark.parametrize(
    "value",
    [
        *VECTORS,
        [[10**400, 0, 1], [0, 1, 1], [0, 0, 1]],
        [[1e300, 0, 1], [0, 1e300, 1], [0, 0, 1]],
        [[50, 0, 0], [0, 50, 0], [31, 19, 1]],  # transposed
        [[50, 0, 31], [0, 50, 19]],
        [[50, 0, 31], [0, 50, 19], [0, 0]],
    ],
)
def test_intrinsics_of_no_camera_name_it(
    nuscenes_root: Path, edit_table: EditTable, value: object
) -> None:
    edit_table("calibrated_sensor", lambda rows: rows[0].update(camera_intrinsic=value))
    with refused(CalibrationError, "Camera front_left"):
        read_nuscenes(nuscenes_root, cameras=["front_left"])
    assert list(read_nuscenes(nuscenes_root).cameras) == ["front_right"]


def test_a_number_of_ten_thousand_digits_matters_only_where_it_is_read(
    nuscenes_root: Path,
) -> None:
    path = nuscenes_root / "v1.0-mini" / "ego_pose.json"
    rows = json.loads(path.read_text())
    long = "9" * 10_000
    path.write_text(json.dumps([{**rows[0], "note": "LONG"}, *rows[1:]]).replace('"LONG"', long))
    assert read_nuscenes(nuscenes_root).warnings == ()
    for column, words in (
        ("timestamp", "ego_pose.json has timestamp = <a whole number of 10000 digits> at row 1"),
        ("rotation", "rotation is [<a whole number of 10000 digits>"),
    ):
        value: object = "LONG" if column == "timestamp" else ["LONG", 0, 0, 0]
        changed = [rows[0], {**rows[1], column: value}, *rows[2:]]
        path.write_text(json.dumps(changed).replace('"LONG"', long))
        with refused(PoseError, words):
            read_nuscenes(nuscenes_root)


def test_rows_that_are_none_are_refused_and_extra_objects_are_not(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("log", lambda rows: rows[0].update(extra={"nested": {}}))
    assert read_nuscenes(nuscenes_root).warnings == ()
    for row in (None, 0, "", [], "row"):
        edit_table("sensor", lambda rows, row=row: rows.insert(1, row))
        with refused(CalibrationError, "sensor.json is not a list of rows", "as row 1"):
            read_nuscenes(nuscenes_root)
        edit_table("sensor", lambda rows: rows.pop(1))
    edit_table("sensor", lambda rows: rows.insert(1, {"\0": 1, "k" * 999: 2}))
    with refused(CalibrationError, "has a row without token", "at row 1"):
        read_nuscenes(nuscenes_root)


def test_times_of_more_than_one_drive_are_refused(
    nuscenes_root: Path, edit_table: EditTable
) -> None:
    edit_table("ego_pose", lambda rows: rows[3].update(timestamp=0))
    with refused(PoseError, "ego_pose.json", "span 17736 days", "of one drive"):
        read_nuscenes(nuscenes_root)


def test_a_deep_reference_map_is_left_out(nuscenes_root: Path) -> None:
    (nuscenes_root / "deep.json").write_text("[" * 100_000)
    (nuscenes_root / "deep.png").write_bytes(b"")
    assert "deep.json is not readable JSON" in read_nuscenes(nuscenes_root).warnings[0]


# --- poses that do not belong together -----------------------------------------------


@pytest.mark.parametrize(("jump_m", "is_said"), [(1e6, True), (5.0, True), (3.0, False)])
def test_a_pose_far_off_the_others_is_said(
    jump_m: float, is_said: bool, av2_log: Path, edit_feather: EditFeather
) -> None:
    # Poses 25 ms apart: 150 m/s are 3.75 m.
    def spoil(columns: dict[str, Any]) -> None:
        columns["tx_m"][6] += jump_m

    edit_feather(av2_log / POSES_FILE, spoil)
    warnings = read_av2(av2_log).warnings
    assert len(warnings) == is_said
    if is_said:
        assert "jump 2 times faster than 150 m/s" in warnings[0]
        assert POSES_FILE in warnings[0]


def test_a_jump_in_a_scene_is_said(nuscenes_root: Path, edit_table: EditTable) -> None:
    def spoil(rows: list[dict[str, Any]]) -> None:
        first = min(row["timestamp"] for row in rows)
        for row in rows:
            if row["timestamp"] == first:  # one for each sensor
                row["translation"] = [9e6, 0, 0]

    edit_table("ego_pose", spoil)
    (jump,) = read_nuscenes(nuscenes_root).warnings
    assert "poses in ego_pose.json jump 1 times" in jump


def test_poses_a_microsecond_apart_may_differ_by_centimetres(
    av2_log: Path, edit_feather: EditFeather
) -> None:
    def spoil(columns: dict[str, Any]) -> None:
        columns["timestamp_ns"][6] = columns["timestamp_ns"][5] + 1000
        columns["tx_m"][6] = columns["tx_m"][5] + 0.05

    edit_feather(av2_log / POSES_FILE, spoil)
    assert read_av2(av2_log).warnings == ()


# --- Argoverse 2 ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("timestamp_ns", np.int64(-1), "row 4 has a time outside 1970 to 2116"),
        ("timestamp_ns", np.uint64(2**63 + 5), "row 4 has a time outside 1970 to 2116"),
        ("timestamp_ns", np.int64(2**63 - 1), "row 4 has a time outside 1970 to 2116"),
        ("timestamp_ns", np.int64(5), "of one drive"),
        ("timestamp_ns", np.timedelta64(5, "ns"), "expected numbers"),
        ("tx_m", np.float64(1e9), "row 4 has a translation of 1e+07 m or more"),
        ("ty_m", np.float64(-1e300), "row 4 has a translation of 1e+07 m or more"),
        ("tz_m", np.float64(np.nan), "row 4 has a NaN or infinite translation"),
        ("qw", np.float64(1e300), "row 4 has no usable quaternion"),
    ],
)
def test_a_pose_beyond_all_bounds_names_the_row(
    av2_log: Path, edit_feather: EditFeather, column: str, value: Any, words: str
) -> None:
    def spoil(columns: dict[str, Any]) -> None:
        columns[column] = columns[column].astype(value.dtype)
        columns[column][4] = value

    edit_feather(av2_log / POSES_FILE, spoil)
    with refused(PoseError, POSES_FILE, words):
        read_av2(av2_log)


@pytest.mark.parametrize(
    ("file", "column", "value", "words"),
    [
        (MOUNTS, "tx_m", 1e9, "within 100 m"),
        (MOUNTS, "tz_m", np.nan, "within 100 m"),
        (MOUNTS, "qw", 1e300, "has no direction"),
        (INTRINSICS, "fx_px", 1e300, "those of no camera"),
        (INTRINSICS, "cy_px", -1e9, "those of no camera"),
        (INTRINSICS, "width_px", 1e12, "those of no camera"),
        (INTRINSICS, "k3", 1e300, "those of no camera"),
    ],
)
def test_a_calibration_of_no_camera_names_it(
    av2_log: Path, edit_feather: EditFeather, file: str, column: str, value: float, words: str
) -> None:
    def spoil(columns: dict[str, Any]) -> None:
        columns[column] = columns[column].astype(np.float64)
        columns[column][0] = value

    edit_feather(av2_log / file, spoil)
    with refused(CalibrationError, "front_left", words):
        read_av2(av2_log, ["front_left"], is_rectified=False)
    assert list(read_av2(av2_log, is_rectified=False).cameras) == ["front_right"]


@pytest.mark.parametrize("file", [MOUNTS, INTRINSICS])
def test_a_sensor_that_stands_twice_must_say_the_same(
    av2_log: Path, edit_feather: EditFeather, file: str
) -> None:
    def repeat(columns: dict[str, Any]) -> None:
        for name, values in columns.items():
            columns[name] = np.append(values, values[:1])

    edit_feather(av2_log / file, repeat)
    assert list(read_av2(av2_log).cameras) == ["front_left", "front_right"]

    def contradict(columns: dict[str, Any]) -> None:
        columns["tx_m" if file == MOUNTS else "fx_px"][-1] += 1

    edit_feather(av2_log / file, contradict)
    with refused(CalibrationError, Path(file).name, "are both front_left", "contradict"):
        read_av2(av2_log)


@pytest.mark.parametrize("name", ["", "../x", "a\0b", "n" * 5000, "x\ny"])
def test_a_sensor_name_that_is_none_names_the_row(
    av2_log: Path, edit_feather: EditFeather, name: str
) -> None:
    edit_feather(av2_log / INTRINSICS, lambda c: c["sensor_name"].__setitem__(1, name))
    with refused(CalibrationError, "intrinsics.feather: row 1 has sensor_name "):
        read_av2(av2_log)


def test_sensor_names_that_are_no_text_are_refused_and_encoded_ones_are_read(
    av2_log: Path, edit_feather: EditFeather
) -> None:
    path = av2_log / MOUNTS
    table = pyarrow.feather.read_table(path, memory_map=False)
    at = table.column_names.index("sensor_name")
    encoded = table.set_column(at, "sensor_name", table["sensor_name"].dictionary_encode())
    pyarrow.feather.write_feather(encoded, path)
    assert len(read_av2(av2_log).cameras) == 2
    holed = table.set_column(at, "sensor_name", pa.array([None] * len(table), pa.string()))
    pyarrow.feather.write_feather(holed, path)
    with refused(CalibrationError, MOUNTS, "column sensor_name is string; expected names"):
        read_av2(av2_log)


def test_a_column_that_stands_twice_is_refused(av2_log: Path) -> None:
    path = av2_log / POSES_FILE
    table = pyarrow.feather.read_table(path, memory_map=False)
    pyarrow.feather.write_feather(table.append_column("qw", table["qx"]), path, version=2)
    with refused(PoseError, POSES_FILE, "2 columns called qw"):
        read_av2(av2_log)


def test_files_of_one_time_are_taken_once(av2_log: Path) -> None:
    images = av2_log / "sensors" / "cameras" / "front_left"
    first = min(images.iterdir())
    shutil.copy(first, images / f"0{first.name}")
    shutil.copy(first, first.with_suffix(".jpg"))
    sweep = min((av2_log / "sensors" / "lidar").iterdir())
    shutil.copy(sweep, sweep.with_name(f"00{sweep.name}"))
    (images / f"{10**30}.png").write_bytes(b"")
    drive = read_av2(av2_log)
    assert (len(drive.images), len(drive.sweeps)) == (8, 4)
    said = " | ".join(drive.warnings)
    assert "2 files in" in said
    assert "1 files in" in said
    assert "have the time of another one" in said
    assert "are not named by a time" in said


def test_a_camera_folder_of_no_name_is_left_out(av2_log: Path) -> None:
    cameras = av2_log / "sensors" / "cameras"
    os.rename(cameras / "front_left", os.fsencode(cameras) + b"/\xff\n")
    drive = read_av2(av2_log)
    assert {ref.camera for ref in drive.images} == {"front_right"}
    assert any("left out the camera folder" in w and w.isprintable() for w in drive.warnings)


# --- sweeps --------------------------------------------------------------------------


def test_points_beyond_all_range_are_dropped_and_times_beyond_a_turn_refused(
    av2_log: Path, edit_feather: EditFeather
) -> None:
    path = min((av2_log / "sensors" / "lidar").iterdir())

    def spoil(columns: dict[str, Any]) -> None:
        for name in ("x", "y", "z"):
            columns[name] = columns[name].astype(np.float64)
        columns["x"][3], columns["z"][7] = 1e300, -20_000

    edit_feather(path, spoil)
    drive = read_av2(av2_log)
    assert len(drive.read_sweep(drive.sweeps[0]).points_ego) == 48
    edit_feather(path, lambda c: c.update(offset_ns=np.full(50, 1e300)))
    raw = read_av2(av2_log, is_compensated=False)
    with refused(SweepError, "offset_ns runs from 1e+300", "within 1e+10 ns"):
        raw.read_sweep(raw.sweeps[0])


def test_points_beyond_all_range_of_a_scene_are_dropped(nuscenes_root: Path) -> None:
    path = min((nuscenes_root / "samples" / "LIDAR_TOP").iterdir())
    values = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 5).copy()
    values[2, 1], values[4, 0] = 3e38, -1e5
    path.write_bytes(values.tobytes())
    drive = read_nuscenes(nuscenes_root)
    assert len(drive.read_sweep(drive.sweeps[0]).points_ego) == 48


# --- folders that may not be read ----------------------------------------------------


@pytest.fixture
def ordinary_user() -> Iterator[Path]:
    """A folder that an ordinary user may use; root, whom nothing is denied, becomes one."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    is_root = os.geteuid() == 0
    try:
        yield folder
    finally:
        if is_root:
            os.seteuid(0)
        for path in (folder, *folder.rglob("*")):
            if path.is_dir():
                path.chmod(0o755)
        shutil.rmtree(folder)


def become_ordinary() -> None:
    if os.geteuid() == 0:
        os.seteuid(65534)


@pytest.mark.parametrize("mode", [0o000, 0o444, 0o111])
@pytest.mark.parametrize("inner", [".", "v1.0-mini", "samples/LIDAR_TOP"])
def test_a_folder_that_may_not_be_read_says_so(
    made: Any, ordinary_user: Path, inner: str, mode: int
) -> None:
    root = made.write_nuscenes(ordinary_user / "data")
    (root / inner).chmod(mode)
    become_ordinary()
    if mode == 0o111 and inner != ".":
        # May be entered, only not listed: whether Python's glob finds what is in it depends on
        # its version. All of the drive, or the error; never a part of it.
        try:
            found = len(open_drive(root).sweeps)
        except DriveError as error:
            found = 4 if "permission denied" in str(error) else 0
        assert found == 4
        return
    for layout in ("auto", "nuscenes"):
        with refused(DriveError, "cannot be read", "permission denied"):
            open_drive(root, layout)


@pytest.mark.parametrize("inner", [".", "sensors/cameras", "sensors/lidar"])
def test_a_log_that_may_not_be_read_says_so(made: Any, ordinary_user: Path, inner: str) -> None:
    log = made.write_av2(ordinary_user / "log")
    (log / inner).chmod(0)
    become_ordinary()
    for layout in ("auto", "av2"):
        with refused(DriveError, "cannot be read", "permission denied"):
            open_drive(log, layout)


@pytest.mark.parametrize("file", [POSES_FILE, INTRINSICS])
def test_a_table_that_may_not_be_read_says_so(made: Any, ordinary_user: Path, file: str) -> None:
    log = made.write_av2(ordinary_user / "log")
    (log / file).chmod(0)
    become_ordinary()
    with refused(DriveError, file, "permission denied"):
        open_drive(log)
