"""What is wrong is said in one line, with a non-zero exit, and nothing half-written is left."""

import json

import cv2
import numpy as np
import pytest
from shapely.geometry import LineString

from hdmap_tools.cli.main import main
from hdmap_tools.formats.gpkg import read_gpkg, write_gpkg
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.elements import LaneMark
from hdmap_tools.map_model.vector_map import VectorMap
from hdmap_tools.testing.fake_plugins import FakePlugins

from .conftest import LABELS, START_NS

TABLES = "drive/v1.0-mini"
RUN = ("run", "drive", "-o", "out", *LABELS)


def edit(street, table, change):
    path = street / TABLES / f"{table}.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def one_file(street, pattern):
    return min((street / "drive").rglob(pattern))


@pytest.fixture(autouse=True)
def nothing_half_written(street):
    """No test of this module may leave an output or a temporary behind."""
    before = {p.name for p in street.iterdir()}
    yield
    left = {p.name for p in street.iterdir()} - before - {"cache"}
    assert not {name for name in left if "partial" in name or "tmp" in name or name == "out"}, left


def test_missing_calibration(street, fails):
    edit(street, "calibrated_sensor", lambda rows: [r for r in rows if not r["camera_intrinsic"]])
    fails(*RUN, says=("calibrated_sensor",))


def test_a_camera_without_a_pose(street, fails):
    def without(rows):
        return [
            r | ({} if r["filename"].endswith(".bin") else {"ego_pose_token": "gone"}) for r in rows
        ]

    edit(street, "sample_data", without)
    fails(*RUN, says=("FRONT", "no ego pose"))


def test_a_truncated_sweep(street, fails):
    sweep = one_file(street, "*.bin")
    sweep.write_bytes(sweep.read_bytes()[:-7])
    fails(*RUN, says=(sweep.name, "20"))


def test_an_image_that_does_not_decode(street, fails, hdmap):
    image = min((street / "drive" / "samples" / "FRONT").iterdir())
    image.write_bytes(image.read_bytes()[:1000])
    # Precomputed labels never open the image; the overview's photo does.
    for path in (street / "drive" / "samples" / "FRONT").iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    fails(*RUN, says=("FRONT",))


def test_a_label_outside_the_label_set(street, fails):
    path = min((street / "labels").rglob("*.png"))
    labels = cv2.imread(str(path), 0)
    labels[0, 0] = 9
    cv2.imwrite(str(path), labels)
    fails(*RUN, says=("label id 9", "adas-0001", "0..3"))


def test_a_missing_label_image(street, fails):
    (street / "labels" / "FRONT" / f"{START_NS}.png").unlink()
    fails(*RUN, says=(str(START_NS),))


def test_nan_and_infinite_points_are_left_out(street, hdmap, caplog):
    code, _, err = hdmap(*RUN[:3], "clean", *LABELS)
    assert code == 0, err
    for sweep in (street / "drive").rglob("*.bin"):
        points = np.fromfile(sweep, np.float32).reshape(-1, 5)
        bad = np.full((40, 5), np.nan, np.float32)
        bad[::2] = np.inf
        np.concatenate([points, bad]).tofile(sweep)
    code, _, err = hdmap(*RUN[:3], "damaged", *LABELS)
    assert code == 0, err
    clean, damaged = (
        SemanticMap.open(street / n / "semantic_map").read() for n in ("clean", "damaged")
    )
    assert damaged.equals(clean)


@pytest.mark.parametrize(
    ("setting", "word"),
    [("fusion.resolution_m=0.4", "resolution_m"), ("fusion.count_mode=point", "count_mode")],
)
def test_a_map_of_another_kind_to_merge(street, hdmap, fails, setting, word):
    assert hdmap("build", "drive", "-o", "a", *LABELS)[0] == 0
    assert hdmap("build", "drive", "-o", "b", *LABELS, "--set", setting)[0] == 0
    fails("merge", "a", "b", "-o", "out", says=(word, "cannot be added"))


def test_an_unknown_plugin(street, fails):
    config = street / "hdmap.yaml"
    config.write_text("vectorize: {vectorizers: [crosswalk_polygons]}")
    fails(*RUN, "--config", config, says=("crosswalk_polygons", "crosswalk_polygon"))


@pytest.fixture
def fakes(tmp_path_factory, monkeypatch):
    made = FakePlugins(tmp_path_factory.mktemp("fakes"))
    monkeypatch.syspath_prepend(str(made.folder))
    return made


def test_a_plugin_that_raises_loses_only_its_own_elements(street, hdmap, fakes):
    code, _, err = hdmap("run", "drive", "-o", "good", *LABELS)
    assert code == 0, err
    fakes.add(
        "clumsy-plugins",
        {"clumsy": "def vectorize(self, *_, **__):\n    raise RuntimeError('out of ideas')"},
    )
    code, _, err = hdmap("run", "drive", "-o", "with_clumsy", *LABELS)
    assert code == 3
    lines = [line for line in err.splitlines() if line.startswith("Error: ")]
    assert len(lines) == 1
    assert "clumsy (clumsy-plugins 1.0)" in lines[0]
    assert "out of ideas" in lines[0]
    good, other = (read_gpkg(street / n / "features.gpkg") for n in ("good", "with_clumsy"))
    assert good.elements == other.elements
    metrics = json.loads((street / "with_clumsy" / "metrics.json").read_text())
    assert list(metrics["failures"]) == ["clumsy"]


def test_plugins_on_the_command_line(hdmap, fakes, fails):
    fakes.add("broken-plugins", {"broken": "module: import not_there_at_all"})
    code, out, _ = hdmap("plugins", "list")
    assert code == 0
    rows = {line.split()[0]: line for line in out.splitlines()}
    assert {"crosswalk_polygon", "lane_mark_skeleton", "road_boundary", "broken"} <= set(rows)
    assert "not_there_at_all" in rows["broken"]
    assert "hdmap-tools" in rows["road_boundary"]
    code, out, _ = hdmap("plugins", "info", "road_boundary")
    assert code == 0
    assert "Emits:        road_boundary" in out
    code, out, _ = hdmap("plugins", "check", "crosswalk_polygon")
    assert code == 0, out
    fails("plugins", "info", "road_bondary", says=("road_bondary", "road_boundary"))
    fails("plugins", "check", "broken", says=("not_there_at_all",))


def test_an_unknown_plugin_option(street, fails):
    fails(
        *RUN,
        "--set",
        "vectorize.options={crosswalk_polygon: {colour: red}}",
        says=("crosswalk_polygon", "colour"),
    )


def test_an_output_that_exists(street, hdmap, fails):
    assert hdmap("run", "drive", "-o", "first", *LABELS)[0] == 0
    before = (street / "first" / "lanelet2_map.osm").read_bytes()
    fails("run", "drive", "-o", "first", *LABELS, says=("first", "--overwrite"))
    assert (street / "first" / "lanelet2_map.osm").read_bytes() == before


def test_a_failing_run_leaves_the_good_result_in_place(street, hdmap, fails):
    assert hdmap("run", "drive", "-o", "first", *LABELS)[0] == 0
    before = (street / "first" / "lanelet2_map.osm").read_bytes()
    sweep = one_file(street, "*.bin")
    sweep.write_bytes(b"short")
    fails("run", "drive", "-o", "first", "--overwrite", *LABELS, says=(sweep.name,))
    assert (street / "first" / "lanelet2_map.osm").read_bytes() == before
    assert SemanticMap.open(street / "first" / "semantic_map").tile_indices()


def test_overwriting_never_touches_a_folder_that_is_no_result(street, fails):
    fails("run", "drive", "-o", "drive", "--overwrite", *LABELS, says=("left alone",))
    fails("build", "drive", "-o", "labels", "--overwrite", *LABELS, says=("left alone",))
    assert len(list((street / "labels").rglob("*.png"))) == 3


def test_no_origin_for_a_geographic_export(street, hdmap, fails):
    edit(street, "log", lambda rows: [r | {"location": "nowhere"} for r in rows])
    fails(*RUN, says=("--origin LAT,LON[,ALT]",))
    code, _, err = hdmap("run", "drive", "-o", "placed", *LABELS, "--origin", "49.0,8.4,115")
    assert code == 0, err
    line = LineString([(0, 0, 0), (5, 0, 0)])
    write_gpkg(VectorMap(MapFrame(), (LaneMark(id="a", geometry=line),)), street / "metres.gpkg")
    fails("export", "metres.gpkg", "-o", "out.osm", says=("--origin",))
    assert not (street / "out.osm").exists()
    code, _, err = hdmap("export", "metres.gpkg", "-o", "out.osm", "--origin", "49.0,8.4")
    assert code == 0, err


@pytest.mark.parametrize("origin", ["49", "a,b", "1,2,3,4", "95,8"])
def test_an_origin_that_is_none(street, fails, origin):
    edit(street, "log", lambda rows: [r | {"location": "nowhere"} for r in rows])
    fails(*RUN, "--origin", origin, says=("rigin",))


HOSTILE = {
    "malformed": '<osm version="0.6"><node id="1" lat="1"',
    "entities": '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><osm>&b;</osm>',
    "external": '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY x SYSTEM "file:///etc/passwd">]><osm>&x;</osm>',
    "huge": '<osm version="0.6"><node id="1" lat="1" lon="1" v="' + "a" * 30_000_000 + '"/></osm>',
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_malformed_or_hostile_xml(street, fails, kind):
    (street / "map.osm").write_text(HOSTILE[kind])
    line = fails("export", "map.osm", "-o", "copy.gpkg", "--format", "gpkg", says=("map.osm",))
    assert "root:" not in line
    assert not (street / "copy.gpkg").exists()


def test_wrong_configuration(street, fails):
    (street / "hdmap.yaml").write_text("fusion: {resolution_m: -1}")
    fails(*RUN, "--config", "hdmap.yaml", says=("fusion.resolution_m",))
    (street / "hdmap.yaml").write_text("fusion: {resolutoin_m: 1}")
    fails(*RUN, "--config", "hdmap.yaml", says=("resolutoin_m",))
    fails(*RUN, "--config", "missing.yaml", says=("missing.yaml",))
    fails(*RUN, "--set", "fusion.resolution_m", says=("STEP.FIELD=VALUE",))


def test_a_drive_that_is_none(street, fails):
    (street / "empty").mkdir()
    fails("run", "empty", "-o", "out", says=("empty",))
    fails("run", "nowhere", "-o", "out", says=("nowhere", "does not exist"))
    fails("info", "nowhere", says=("nowhere",))


def test_a_drive_without_images(street, fails):
    edit(street, "sample_data", lambda rows: [r for r in rows if r["filename"].endswith(".bin")])
    fails(*RUN, says=("no images",))


def test_images_without_a_sweep(street, fails):
    edit(
        street, "sample_data", lambda rows: [r for r in rows if not r["filename"].endswith(".bin")]
    )
    fails(*RUN, says=("no image has a lidar sweep", "planar"))


def test_a_camera_that_is_not_there(street, fails):
    fails(*RUN, "--camera", "CAM_SIDEWAYS", says=("CAM_SIDEWAYS", "FRONT"))


def test_comparing_with_a_mask_elsewhere(street, hdmap, fails):
    assert hdmap("build", "drive", "-o", "map", *LABELS)[0] == 0
    cv2.imwrite(str(street / "mask.png"), np.zeros((10, 10), np.uint8))
    sidecar = {
        "resolution_m": 0.1,
        "origin_xy_m": [90000, 90000],
        "size_px": [10, 10],
        "map_origin_latlon": [1.2882100868743724, 103.78475189208984],
    }
    (street / "mask.json").write_text(json.dumps(sidecar))
    fails("compare", "map", "mask.png", says=("overlap",))


def test_a_full_disk(street, fails, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hdmap_tools.formats.gpkg.atomic_output", full)
    fails(*RUN, says=("No space left on device",))


def test_a_bug_is_called_a_bug(street, fails, monkeypatch):
    monkeypatch.setattr("hdmap_tools.pipeline.vectorize_map", lambda *_, **__: 1 / 0)
    fails(*RUN, says=("Unexpected ZeroDivisionError", "-vv"))
    with pytest.raises(ZeroDivisionError):
        main(["-vv", *RUN])
