"""Bad input to `simulate`, `points`, `reliability` and `evaluate`: one line, and nothing left behind."""

import json
import os
import shutil

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest

from hdmap_tools.config import load_config
from hdmap_tools.errors import PointMapError
from hdmap_tools.point_map.make import make_points
from hdmap_tools.point_map.point_map import PointMap

QUICK = ("--no-refine-poses",)
TINY = ("--length-m", "10", "--image-size", "64x64", "--lidar", "vlp16")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield tmp_path
    left = {p.name for p in tmp_path.iterdir()}
    assert not {name for name in left if name.startswith(".") or name == "out"}, left


@pytest.fixture
def drive(here, simulated_drive):
    shutil.copytree(simulated_drive, here / "drive")
    return here / "drive"


@pytest.fixture(scope="module")
def points_template(street_template, tmp_path_factory):
    """A point map of the street; a copy is for damaging."""
    out = tmp_path_factory.mktemp("points") / "points"
    config = load_config(None, {"points.refine_poses": False})
    make_points([street_template / "drive"], out, config)
    return out


@pytest.fixture
def points(street, points_template):
    shutil.copytree(points_template, street / "points")
    return street / "points"


BUILD = ("build", "drive", "-o", "out", "--labels", "labels", "--label-set", "adas-0001")


def _node(number: int, x_m: float, y_m: float, tags: str = "") -> str:
    degrees = 1 / 111_320
    return f'<node id="{number}" lat="{y_m * degrees}" lon="{x_m * degrees}">{tags}</node>'


def _lane(number: int, y_m: float, length_m: float, subtype: str = "road", width_m=3.5) -> str:
    first = 10 * number
    nodes = [_node(first + k, length_m * (k % 2), y_m - width_m * (k // 2)) for k in range(4)]
    return "".join(nodes) + (
        f'<way id="{first + 4}"><nd ref="{first}"/><nd ref="{first + 1}"/></way>'
        f'<way id="{first + 5}"><nd ref="{first + 2}"/><nd ref="{first + 3}"/></way>'
        f'<relation id="{first + 6}"><member type="way" ref="{first + 4}" role="left"/>'
        f'<member type="way" ref="{first + 5}" role="right"/>'
        f'<tag k="type" v="lanelet"/><tag k="subtype" v="{subtype}"/></relation>'
    )


@pytest.mark.parametrize(
    ("lanes", "says"),
    [
        (_lane(1, 0, 100, "walkway"), ("1 lanes, none of them for vehicles", "lanelets")),
        (
            "".join(_lane(k, 10 * k, 8) for k in range(1, 5)),
            ("8.0 m", "at least 10 m", "share end points"),
        ),
    ],
)
def test_a_map_without_a_drive_in_it(fails, here, lanes, says):
    (here / "m.osm").write_text(f'<?xml version="1.0"?><osm version="0.6">{lanes}</osm>')
    fails("simulate", "m.osm", "-o", "out", says=says)


def test_a_map_in_local_metres_needs_an_origin(fails, here):
    nodes = "".join(
        f'<node id="{k}" lat="0" lon="0"><tag k="local_x" v="{60 * (k % 2)}"/>'
        f'<tag k="local_y" v="{-3.5 * (k // 2)}"/></node>'
        for k in range(4)
    )
    (here / "m.osm").write_text(f'<?xml version="1.0"?><osm version="0.6">{nodes}</osm>')
    fails("simulate", "m.osm", "-o", "out", says=("local_x", "--origin LAT,LON"))


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--length-m", "1e9", "length_m"),
        ("--camera-hz", "1000", "camera_hz"),
        ("--lidar-hz", "0", "lidar_hz"),
        ("--image-size", "1x1", "image_width_px"),
        # Poses that the reader would refuse are refused before the drive, not after it.
        ("--pose-drift-m", "1e300", "pose_errors.drift_m"),
        ("--pose-noise-m", "1e6", "pose_errors.noise_m"),
        ("--calibration-error-m", "1e300", "calibration_error_m"),
        ("--speed", "1e-9", "speed_mps"),
        ("--start", "1e9,1e9", "nearest road lane"),
    ],
)
def test_absurd_options_of_simulate(fails, here, option, value, says):
    fails("simulate", "demo_town", "-o", "out", *TINY, option, value, says=(says,))


def test_a_drive_of_no_length_is_not_one_of_the_default_length(fails, here):
    fails("evaluate", "demo_town", "-o", "out", "--length-m", "0", says=("length_m",))


def _cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("how", [_cut, lambda path: path.write_bytes(b""), lambda p: p.unlink()])
@pytest.mark.parametrize("part", ["meta.json", "tiles/*", "cells/*", "poses/*"])
def test_a_damaged_point_map(points, fails, part, how):
    for path in points.glob(part):
        how(path)
    fails(*BUILD, "--points", "points", says=(part.split("/")[0],))
    assert not (points.parent / "out").exists()


@pytest.mark.parametrize("part", ["tiles", "cells"])
def test_a_tile_of_another_place(points, fails, part):
    sizes = {path: path.stat().st_size for path in (points / part).iterdir()}
    first, second = sorted(sizes, key=sizes.__getitem__)[-2:]
    first.write_bytes(second.read_bytes())
    fails(*BUILD, "--points", "points", says=(first.name, "another tile", "hdmap points"))


def test_values_changed_in_a_tile(points, fails):
    for path in (points / "tiles").iterdir():
        table = pyarrow.feather.read_table(path, memory_map=False)
        columns = {name: table[name].to_numpy().copy() for name in table.column_names}
        columns["z_mm"][:] += 5000
        pyarrow.feather.write_feather(pa.table(columns), path)
    fails(*BUILD, "--points", "points", says=("damaged",))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"tiles": []}, "no tiles"),
        ({"tiles": [{"x": 10**30, "y": 0, "num_points": 5}]}, "tiles.0.x"),
        (
            {
                "drives": [
                    {"id": "a", "poses": "../x.feather", "is_refined": False, "num_sweeps": 1}
                ]
            },
            "drives.0.poses",
        ),
        ({"schema_version": 9}, "schema_version"),
    ],
)
def test_a_wrong_description_of_a_point_map(points, fails, change, says):
    path = points / "meta.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    fails(
        *BUILD, "--points", "points", says=("meta.json" if says != "schema_version" else says, says)
    )
    fails("info", "points", says=(says,))


def test_a_simulated_drive_without_poses_is_not_taken_for_its_truth(drive, fails):
    (drive / "city_SE3_egovehicle.feather").unlink()
    fails("points", "drive", "-o", "out", *QUICK, says=("drive", "city_SE3_egovehicle.feather"))


def test_a_simulated_drive_without_sweeps(drive, fails):
    shutil.rmtree(drive / "sensors" / "lidar")
    fails("points", "drive", "-o", "out", *QUICK, says=("no lidar sweep", "0 sweeps"))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: cv2.imwrite(str(path), cv2.imread(str(path), -1)[::2, ::2]), "expected"),
        (_cut, "copy it again"),
    ],
)
def test_a_true_label_image_that_is_none(drive, fails, damage, says):
    damage(min((drive / "truth" / "label_images").glob("*/*.png")))
    arguments = ("--drive", "drive", "--labels", "drive/truth/label_images")
    fails("confusion", *arguments, "-o", "out", says=("Label image", ".png"))


@pytest.mark.parametrize("bands", ["", "a", "10,20", "0,-5", "20,10,0", "0,nan", "0,10,10"])
def test_range_bands_that_are_none(drive, fails, bands):
    arguments = ("--drive", "drive", "--labels", "drive/truth/label_images", "-o", "out")
    fails("confusion", *arguments, "--range-bands", bands, says=("ands",))


def test_a_truth_raster_with_an_unknown_code(drive, fails):
    from hdmap_tools.errors import FormatError
    from hdmap_tools.simulate.truth_raster import TruthRaster

    path = min((drive / "truth" / "raster").glob("*.png"))
    codes = cv2.imread(str(path), -1)
    codes[0, 0] = 199
    cv2.imwrite(str(path), codes)
    _, x, y = path.stem.split("_")
    with pytest.raises(FormatError, match="199"):
        TruthRaster.open(path.parent).codes(int(x), int(y))


def test_info_on_what_simulation_makes(street, simulated_drive, hdmap, fails):
    code, out, err = hdmap("info", simulated_drive)
    assert code == 0, err
    assert "simulated:\n  world: demo_town" in out
    assert "not readable yet" not in next(line for line in out.splitlines() if "raster" in line)
    code, _, err = hdmap("points", "drive", "-o", "points", "--export", "points.ply")
    assert code == 0, err
    code, out, err = hdmap("info", "points", "--json", "facts.json")
    assert code == 0, err
    facts = json.loads((street / "facts.json").read_text())
    assert facts["kind"] == "point map"
    assert facts["points"] > 10_000
    code, out, err = hdmap("info", "points.ply")
    assert code == 0, err
    assert f"points: {facts['points']}\n" in out
    (street / "points" / "meta.json").write_text("{}")
    fails("info", "points", says=("schema_version",))


def test_the_summary_says_what_became_of_the_poses():
    from hdmap_tools.cli.points import _refinement

    found = {
        "correction_m": 0.0213,
        "correction_deg": 0.05,
        "num_registered": 9,
        "num_sweeps": 10,
        "held": {"along": 0.0, "across": 1.0, "yaw": 0.5},
        "reason": "the scene does not hold along: as given",
    }
    said = _refinement(True, found)
    assert "2.1 cm and 0.050 degrees" in said
    assert "9 of 10" in said
    assert "held: across, yaw in 50% of sweeps (the scene does not hold along" in said
    assert _refinement(False, found | {"reason": "no hold"}) == "as given: no hold"
    assert _refinement(False, None).startswith("as given")


def test_broken_coordinates_in_a_drive_leave_a_point_map(drive, hdmap):
    for path in sorted((drive / "sensors" / "lidar").iterdir())[:2]:
        table = pyarrow.feather.read_table(path, memory_map=False)
        columns = {name: table[name].to_numpy().copy() for name in table.column_names}
        columns["x"][:50], columns["y"][50:60] = np.nan, np.inf
        pyarrow.feather.write_feather(pa.table(columns), path)
    code, out, err = hdmap("points", "drive", "-o", "points", *QUICK)
    assert code == 0, err
    assert "NaN" in err
    assert "poses as given" in out


def _write_ply(path, points):
    header = "".join(f"property double {axis}\n" for axis in "xyz")
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{header}end_header\n"
    )
    path.write_bytes(head.encode() + np.ascontiguousarray(points, "<f8").tobytes())


@pytest.mark.parametrize(
    ("axis", "value"), [(0, 1e300), (0, 1e9), (0, np.nan), (2, -1e7), (2, 1e9), (1, np.inf)]
)
def test_points_not_of_this_earth_are_left_out(here, hdmap, axis, value):
    cloud = np.random.default_rng(0).uniform(-20, 20, (5000, 3)) * (1, 1, 0.001)
    cloud[:9, axis] = value
    _write_ply(here / "c.ply", cloud)
    code, _, err = hdmap("points", "c.ply", "-o", "points")
    assert code == 0, err
    assert "c.ply: 9 points" in err
    assert PointMap.open(here / "points").bounds_m == (-25.6, -25.6, 25.6, 25.6)


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_points_that_a_full_disk_cut_short_are_not_kept(here, monkeypatch, suffix):
    from hdmap_tools.geometry.map_frame import MapFrame
    from hdmap_tools.open3d_import import open3d
    from hdmap_tools.point_map.point_files import write_point_file
    from hdmap_tools.point_map.values import MapPoints

    points = MapPoints(np.zeros((1000, 3)), np.ones(1000, np.uint8), np.ones(1000, bool))
    assert write_point_file(here / f"whole.{suffix}", [points], MapFrame()) == 1000
    write = open3d().t.io.write_point_cloud

    def cut_short(path, cloud):
        write(path, cloud)
        os.truncate(path, os.path.getsize(path) // 2)
        return True  # as open3d does

    monkeypatch.setattr(open3d().t.io, "write_point_cloud", cut_short)
    with pytest.raises(PointMapError, match="check free space"):
        write_point_file(here / f"cut.{suffix}", [points], MapFrame())
    assert not (here / f"cut.{suffix}").exists()


def test_folders_made_for_an_output_go_with_it(here, fails):
    fails("demo", "-o", "demo", "--length-m", "1", says=("length_m",))
    (here / "c.ply").write_bytes(b"")
    fails("points", "c.ply", "-o", "new/folder/points", says=("c.ply",))
    assert [p.name for p in here.iterdir()] == ["c.ply"]
