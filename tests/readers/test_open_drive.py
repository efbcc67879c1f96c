"""The layout is guessed from the folder, and what cannot be guessed is explained."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hdmap_tools.errors import CalibrationError, DriveError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.cameras import select_cameras
from hdmap_tools.readers.open_drive import LAYOUTS, open_drive
from hdmap_tools.testing.drives import write_nuscenes


@pytest.mark.parametrize("layout", ["auto", "nuscenes"])
def test_nuscenes_is_recognized(layout: str, nuscenes_root: Path) -> None:
    for path in (nuscenes_root, nuscenes_root / "v1.0-mini"):
        assert open_drive(path, layout).id == "nuscenes:scene-0001"


@pytest.mark.parametrize("layout", ["auto", "av2"])
def test_an_av2_log_is_recognized_itself_and_in_its_data_root(
    layout: str, made: Any, tmp_path: Path
) -> None:
    log = made.write_av2(tmp_path / "val" / "log-a")
    for path in (log, tmp_path / "val", tmp_path):
        assert open_drive(path, layout).id == "av2:log-a"


def test_the_same_drive_in_both_layouts_is_the_same(av2_log: Path, nuscenes_root: Path) -> None:
    a, b = open_drive(av2_log), open_drive(nuscenes_root)
    assert [i.key for i in a.images] == [i.key for i in b.images]
    assert [s.timestamp_ns for s in a.sweeps] == [s.timestamp_ns for s in b.sweeps]


def test_a_drive_can_be_sent_to_another_process(av2_log: Path, nuscenes_root: Path) -> None:
    for path in (av2_log, nuscenes_root):
        drive = open_drive(path)
        drive.frame.to_wgs84(np.zeros((1, 3)))  # fills what the frame caches
        sent = pickle.loads(pickle.dumps(drive))
        ref = drive.sweeps[2]
        np.testing.assert_array_equal(
            sent.read_sweep(ref).points_ego, drive.read_sweep(ref).points_ego
        )


def test_several_logs_need_a_choice(made: Any, tmp_path: Path) -> None:
    for name in ("log-a", "log-b"):
        made.write_av2(tmp_path / name)
    with pytest.raises(DriveError, match=r"holds 2 logs; .* log-a, log-b"):
        open_drive(tmp_path)
    assert open_drive(tmp_path, scene="log-b").name == "log-b"
    with pytest.raises(DriveError, match="has no log 'log-c'; it has: log-a, log-b"):
        open_drive(tmp_path, scene="log-c")
    with pytest.raises(DriveError, match="has no log 'log-b'; it has: log-a"):
        open_drive(tmp_path / "log-a", scene="log-b")


def test_a_log_opened_by_a_relative_path_keeps_its_name(
    av2_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(av2_log)
    assert open_drive(Path(".")).name == "made-log"


def test_cameras_are_passed_on(av2_log: Path, nuscenes_root: Path) -> None:
    for path in (av2_log, nuscenes_root):
        assert list(open_drive(path, cameras=("front_right",)).cameras) == ["front_right"]


def test_both_layouts_in_one_folder_need_a_choice(made: Any, nuscenes_root: Path) -> None:
    made.write_av2(nuscenes_root / "log-a")
    with pytest.raises(DriveError, match=r"several layouts \(av2, nuscenes\); choose .* --layout"):
        open_drive(nuscenes_root)
    assert open_drive(nuscenes_root, "av2").id == "av2:log-a"


def test_what_holds_no_drive_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(DriveError, match="is empty") as error:
        open_drive(tmp_path)
    for layout in LAYOUTS.values():
        assert layout.signature in str(error.value)
    assert "\n" not in str(error.value)
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(DriveError, match="holds no known drive"):
        open_drive(tmp_path)
    with pytest.raises(DriveError, match="is a file"):
        open_drive(tmp_path / "holiday.jpg")
    with pytest.raises(DriveError, match="does not exist"):
        open_drive(tmp_path / "nowhere")
    with pytest.raises(DriveError, match="holds no Argoverse 2 log"):
        open_drive(tmp_path, "av2")
    with pytest.raises(DriveError, match="holds no nuScenes tables"):
        open_drive(tmp_path, "nuscenes")


def test_an_unknown_layout_lists_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(DriveError, match="'kitti' is unknown; use auto or one of av2, nuscenes"):
        open_drive(tmp_path, "kitti")


def test_the_reason_why_no_camera_is_left_keeps_its_kind() -> None:
    camera = PinholeCamera("a", 2, 2, 1.0, 1.0, 0.0, 0.0, SE3.identity())
    broken = {"b": CalibrationError("b has no mount.")}
    # A usable camera without images does not help the images of the broken one.
    with pytest.raises(CalibrationError, match=r"images of b and not one .* b has no mount\."):
        select_cameras({"a": camera}, broken, {"b"}, (), "Drive x")
    chosen, left_out = select_cameras({"a": camera}, broken, {"a", "b"}, (), "Drive x")
    assert list(chosen) == ["a"]
    assert left_out == ["left out b: b has no mount."]
    with pytest.raises(DriveError, match="it has no cameras at all"):
        select_cameras({}, {}, (), ("a",), "Drive x")


def test_times_nuscenes_cannot_hold_are_refused(made: Any, tmp_path: Path) -> None:
    time = made.times_ns[0] + 1
    with pytest.raises(ShapeError, match="whole microseconds"):
        write_nuscenes(
            tmp_path,
            trajectory=made.trajectory,
            cameras=made.cameras[:1],
            images={"front_left": {time: made.images["front_left"][made.times_ns[0]]}},
        )
