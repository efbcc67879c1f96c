"""The whole way, from a made drive with known truth to its map."""

import json

import cv2
import numpy as np
import pytest
import yaml

from hdmap_tools.config import load_config
from hdmap_tools.formats.gpkg import read_gpkg
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.readers.open_drive import open_drive

from .conftest import LABELS

OUTPUTS = {
    ".hdmap-result.json",
    "agreement.png",
    "features.gpkg",
    "hdmap.yaml",
    "lanelet2_map.osm",
    "metrics.json",
    "overview.png",
    "semantic_map",
}


def write_mask(street):
    """The street's road as a mask with its JSON: y within 6 m of 1000, north up."""
    mask = np.zeros((400, 600), dtype=np.uint8)  # 60 m x 40 m at 0.1 m from (290, 980)
    mask[140:260] = 255
    cv2.imwrite(str(street / "drive" / "road_mask.png"), mask)
    (street / "drive" / "road_mask.json").write_text(
        json.dumps(
            {
                "map": "singapore-onenorth",
                "map_origin_latlon": [1.2882100868743724, 103.78475189208984],
                "resolution_m": 0.1,
                "origin_xy_m": [290, 980],
                "size_px": [600, 400],
            }
        )
    )


@pytest.fixture
def made(street, hdmap):
    write_mask(street)
    code, out, err = hdmap("run", "drive", "-o", "out", *LABELS)
    assert code == 0, err
    return street / "out", out


def test_everything_is_written(made):
    folder, said = made
    assert {p.name for p in folder.iterdir()} == OUTPUTS
    assert "3 images" in said
    assert "surface: drivable IoU" in said
    for name in ("overview.png", "agreement.png"):
        assert cv2.imread(str(folder / name)).std() > 5


def test_the_road_is_where_it_is(made):
    metrics = json.loads((made[0] / "metrics.json").read_text())
    scores = {m: c["groups"]["drivable"] for m, c in metrics["comparisons"].items()}
    assert set(scores) == {"surface", "sparse", "planar"}
    assert scores["surface"]["iou"] > 0.95
    assert scores["sparse"]["iou"] > 0.95
    # Without lidar the box's label falls on the road behind it.
    assert 0.85 < scores["planar"]["iou"] < scores["surface"]["iou"]


def test_marks_become_lines_on_the_paint(made):
    marks = [e for e in read_gpkg(made[0] / "features.gpkg") if e.element_type == "lane_mark"]
    assert marks
    longest = max(marks, key=lambda e: e.geometry.length)
    y = np.array(longest.geometry.coords)[:, 1] - 1000.0
    # Paint runs along y = 0, 3, -3 m.
    assert np.abs(y - 3.0 * np.round(y.mean() / 3.0)).max() < 0.15
    assert longest.geometry.length > 8.0


def test_two_runs_give_the_same_bytes(made, hdmap):
    folder, _ = made
    code, _, err = hdmap("run", "drive", "-o", "again", *LABELS)
    assert code == 0, err
    for name in OUTPUTS - {"metrics.json", "semantic_map"}:
        assert (folder / name).read_bytes() == (folder.parent / "again" / name).read_bytes(), name
    one, two = (
        SemanticMap.open(f / "semantic_map").read() for f in (folder, folder.parent / "again")
    )
    assert one.equals(two)


def test_the_configuration_used_is_written_and_can_be_used_again(made, hdmap):
    folder, _ = made
    config = load_config(folder / "hdmap.yaml")
    assert config.fusion.resolution_m == 0.1
    code, _, err = hdmap("run", "drive", "-o", "third", "--config", folder / "hdmap.yaml")
    assert code == 0, err
    assert (folder / "lanelet2_map.osm").read_bytes() == (
        folder.parent / "third" / "lanelet2_map.osm"
    ).read_bytes()


def test_the_steps_alone_give_what_the_whole_gives(made, hdmap):
    folder, _ = made
    for arguments in (
        ("build", "drive", "-o", "map", *LABELS),
        ("vectorize", "map", "-o", "features.gpkg"),
        ("export", "features.gpkg", "-o", "lanelet2_map.osm"),
        ("export", "features.gpkg", "-o", "map.geojson", "--format", "geojson"),
        ("compare", "map", "drive/road_mask.png", "--json", "c.json", "--picture", "c.png"),
        ("info", "map"),
        ("info", "drive"),
        ("info", "lanelet2_map.osm"),
        ("segment", "drive", "-o", "labels2", *LABELS),
    ):
        code, _, err = hdmap(*arguments)
        assert code == 0, (arguments, err)
    here = folder.parent
    assert (here / "lanelet2_map.osm").read_bytes() == (folder / "lanelet2_map.osm").read_bytes()
    assert (
        SemanticMap.open(here / "map")
        .read()
        .equals(SemanticMap.open(folder / "semantic_map").read())
    )
    assert json.loads((here / "c.json").read_text())["groups"]["drivable"]["iou"] > 0.95
    for png in (here / "labels").rglob("*.png"):
        other = here / "labels2" / png.relative_to(here / "labels")
        assert np.array_equal(cv2.imread(str(png), 0), cv2.imread(str(other), 0))


def test_two_halves_merge_to_the_whole(street, hdmap):
    tables = street / "drive" / "v1.0-mini" / "sample_data.json"
    rows = json.loads(tables.read_text())
    images = sorted(
        (r for r in rows if r["filename"].endswith(".png")), key=lambda r: r["timestamp"]
    )
    parts = {"first": images[:1], "second": images[1:], "whole": images}
    others = [r for r in rows if r not in images]
    for name, part in parts.items():
        tables.write_text(json.dumps(others + part))
        fixed = ("--set", "fusion.intensity_threshold=50")
        code, _, err = hdmap("build", "drive", "-o", name, *LABELS, *fixed)
        assert code == 0, err
    whole = SemanticMap.open(street / "whole").read()
    first, second = (SemanticMap.open(street / name).read() for name in ("first", "second"))
    assert first.merge(second).equals(whole)
    assert whole.subtract(second).equals(first)
    # On the command line a drive's parts bear one name, so adding them is refused.
    code, _, err = hdmap("merge", "first", "second", "-o", "sum")
    assert code == 1
    assert "adding it twice would count it twice" in err


def test_a_relative_output_in_a_new_folder(street, hdmap):
    code, _, err = hdmap("build", "drive", "-o", "deep/down/map", *LABELS)
    assert code == 0, err
    assert SemanticMap.open(street / "deep" / "down" / "map").tile_indices()


def test_a_run_without_lidar_by_plane(street, hdmap):
    tables = street / "drive" / "v1.0-mini" / "sample_data.json"
    rows = json.loads(tables.read_text())
    tables.write_text(json.dumps([r for r in rows if not r["filename"].endswith(".bin")]))
    code, out, err = hdmap("run", "drive", "-o", "out", *LABELS, "--association", "planar")
    assert code == 0, err
    assert "3 images" in out


def test_what_is_dumped_is_what_was_asked(street, hdmap):
    code, _, err = hdmap(
        "run", "drive", "-o", "out", *LABELS, "--resolution", "0.5", "--set", "vectorize.seed=7"
    )
    assert code == 0, err
    document = yaml.safe_load((street / "out" / "hdmap.yaml").read_text())
    assert document["fusion"]["resolution_m"] == 0.5
    assert document["vectorize"]["seed"] == 7


def test_lanelet2_loads_it_and_every_vertex_is_within_a_centimetre(made):
    lanelet2 = pytest.importorskip("lanelet2", reason="no lanelet2 wheel for this platform")
    folder, _ = made
    features = read_gpkg(folder / "features.gpkg")
    frame: MapFrame = features.frame
    origin = frame.to_wgs84(np.array([[300.0, 1000.0, 0.0]]))[0]
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(origin[1], origin[0]))
    loaded, errors = lanelet2.io.loadRobust(str(folder / "lanelet2_map.osm"), projector)
    assert list(errors) == []
    found = []
    for point in loaded.pointLayer:
        gps = projector.reverse(lanelet2.core.BasicPoint3d(point.x, point.y, point.z))
        found.append([gps.lon, gps.lat, gps.alt])
    back = frame.from_wgs84(np.array(found))
    original = np.concatenate(
        [np.array(e.geometry.coords) for e in features if e.geometry_type == "LineString"]
    )
    distance = np.linalg.norm(original[:, None] - back[None], axis=2).min(axis=1)
    assert len(original) > 20
    assert distance.max() < 0.01


def test_the_drive_of_the_tests_is_read_as_it_was_made(street):
    drive = open_drive(street / "drive")
    assert len(drive.images) == len(drive.sweeps) == 3
