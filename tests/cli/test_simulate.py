"""`hdmap simulate`: a drive that the other commands take, and errors in one line."""

import json
import shutil

import pytest

TINY = (
    *("--length-m", "10", "--camera-hz", "1", "--lidar-hz", "4", "--speed", "6"),
    *("--image-size", "128x80", "--lidar", "vlp16", "--seed", "5"),
)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def test_a_shipped_world_by_its_name(hdmap, here):
    code, out, err = hdmap("simulate", "demo_town", "-o", "drive", *TINY)
    assert code == 0, err
    assert "10 m through demo_town.osm" in out
    made = json.loads((here / "drive/truth/simulation.json").read_text())["settings"]
    assert (made["image_width_px"], made["image_height_px"]) == (128, 80)
    assert made["lidar"] == "vlp16"
    assert made["speed_mps"] == 6
    code, out, _ = hdmap("info", "drive")
    assert code == 0
    assert "128 x 80" in out
    assert "vector_map.gpkg" in out


@pytest.mark.slow
def test_the_other_commands_take_it(hdmap, here, simulated_drive):
    shutil.copytree(simulated_drive, "drive")
    code, out, err = hdmap("run", "drive", "-o", "out", "--labels", "drive/truth/label_images")
    assert code == 0, err
    assert (here / "out" / "overview.png").stat().st_size > 10_000
    assert (here / "out" / "lanelet2_map.osm").is_file()  # the place on earth is known
    assert "road_boundary" in out
    code, out, err = hdmap(
        "segment", "drive", "-o", "labels", "--model", "simulated", "--set", "segmentation.seed=4"
    )
    assert code == 0, err
    assert "simulated (paz2020)" in out


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--length-m", "3", "length_m"),
        ("--length-m", "nan", "length_m"),
        ("--speed", "0", "speed_mps"),
        ("--camera-hz", "-1", "camera_hz"),
        ("--seed", "-4", "seed"),
        ("--image-size", "8x8", "image_width_px"),
        ("--pose-noise-m", "-0.1", "pose_errors.noise_m"),
        ("--calibration-error-deg", "inf", "calibration_error_deg"),
        ("--origin", "north", "--origin"),
        ("--start", "no such lane", "no such lane"),
    ],
)
def test_values_that_cannot_be_are_refused_in_one_line(fails, here, option, value, says):
    fails("simulate", "demo_town", "-o", "drive", option, value, says=(says,))
    assert not (here / "drive").exists()
    assert not list(here.glob(".drive*"))


@pytest.mark.parametrize(
    ("option", "value"),
    [("--image-size", "big"), ("--weather", "snow"), ("--lidar", "rings128"), ("--seed", "x")],
)
def test_wrong_usage_is_code_2(hdmap, here, option, value):
    code, _, err = hdmap("simulate", "demo_town", "-o", "drive", option, value)
    assert code == 2
    assert option in err


def test_maps_that_are_no_world(fails, here):
    fails("simulate", "nowhere.osm", "-o", "drive", says=("nowhere.osm", "demo_town"))
    (here / "empty.osm").write_text('<?xml version="1.0"?>\n<osm version="0.6"/>\n')
    fails("simulate", "empty.osm", "-o", "drive", says=("empty.osm", "no lanes"))
    (here / "cut.osm").write_text('<?xml version="1.0"?>\n<osm version="0.6"><node id="1"')
    fails("simulate", "cut.osm", "-o", "drive", says=("cut.osm",))
    (here / "list.json").write_text("[1, 2]")
    fails("simulate", "list.json", "-o", "drive", says=("list.json",))
    (here / "picture.png").write_bytes(b"x")
    fails("simulate", "picture.png", "-o", "drive", says=("picture.png",))
    assert not (here / "drive").exists()


def test_a_folder_of_others_is_left_alone(fails, here):
    (here / "drive").mkdir()
    (here / "drive" / "mine.txt").write_text("keep")
    fails("simulate", "demo_town", "-o", "drive", "--overwrite", says=("left alone",))
    assert (here / "drive" / "mine.txt").read_text() == "keep"


def test_a_broken_map_frame_is_said(fails, here, simulated_drive):
    shutil.copytree(simulated_drive, "drive", ignore=shutil.ignore_patterns("truth", "sensors"))
    for text in ("{", "[]", '{"crs_wkt": 3}', '{"crs_wkt": "x", "offset_m": [0, 0, 0]}'):
        (here / "drive" / "map_frame.json").write_text(text)
        fails("info", "drive", says=("map_frame.json",))


def test_images_alone(hdmap, here):
    options = ("--lidar", "none", "--no-true-map", "--camera-height-m", "2.1")
    code, out, err = hdmap("simulate", "demo_town", "-o", "images", *TINY, *options)
    assert code == 0, err
    assert "0 sweeps" in out
    made = json.loads((here / "images/truth/simulation.json").read_text())
    assert made["settings"]["lidar"] == "none"
    assert not made["settings"]["true_map"]
    (mount,) = made["ego_SE3_sensor"].values()
    assert mount[2][3] == pytest.approx(2.1 - 0.33)
    assert not (here / "images/sensors/lidar").exists()
    assert not (here / "images/truth/vector_map.gpkg").exists()
    code, out, _ = hdmap("info", "images")
    assert code == 0
