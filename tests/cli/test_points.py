"""`hdmap points`, and mapping with what it makes."""

import json

import numpy as np
import pytest
import yaml

from hdmap_tools.point_map.point_files import read_point_file
from hdmap_tools.point_map.point_map import PointMap

from .conftest import LABELS

QUICK = ("--no-refine-poses",)


@pytest.fixture
def points(street, hdmap):
    code, out, err = hdmap("points", "drive", "-o", "points", *QUICK, "--json", "points.json")
    assert code == 0, err
    assert "nuscenes:scene-0001: poses as given" in out
    return street / "points"


def test_a_point_map_is_made_and_replaced_only_when_asked(points, fails, hdmap):
    report = json.loads((points.parent / "points.json").read_text())
    made = PointMap.open(points)
    assert report["num_points"] == made.num_points > 10_000
    assert report["refined_poses"] == {"nuscenes:scene-0001": False}
    fails("points", "drive", "-o", "points", *QUICK, says=("points", "--overwrite"))
    before = (points / "meta.json").read_bytes()
    code, _, err = hdmap("points", "drive", "-o", "points", *QUICK, "--overwrite")
    assert code == 0, err
    assert (points / "meta.json").read_bytes() == before
    assert not [p for p in points.parent.iterdir() if p.name.startswith(".")]


def test_a_run_with_points_is_dense_and_its_configuration_says_so(points, hdmap):
    code, _, err = hdmap("run", "drive", "-o", "out", *LABELS, "--points", "points")
    assert code == 0, err
    metrics = json.loads((points.parent / "out" / "metrics.json").read_text())
    assert metrics["association"] == "dense"
    assert metrics["num_observations"]["FRONT"] > 3000
    config = yaml.safe_load((points.parent / "out" / "hdmap.yaml").read_text())
    assert config["association"]["method"] == "dense"
    assert config["association"]["points"] == str(points)


def test_the_method_asked_for_wins_over_points(points, hdmap):
    arguments = ("drive", "-o", "map", *LABELS, "--points", "points", "--json", "map.json")
    code, _, err = hdmap("build", *arguments, "--association", "surface")
    assert code == 0, err
    surface = json.loads((points.parent / "map.json").read_text())["num_tiles"]
    (points.parent / "c.yaml").write_text("association: {method: surface}\n")
    more = ("--config", "c.yaml", "--overwrite", "--set", "association.clip_ahead_m=6")
    code, _, err = hdmap("build", *arguments, *more)
    assert code == 0, err
    assert json.loads((points.parent / "map.json").read_text())["num_tiles"] <= surface


def test_dense_without_points_makes_them_and_says_so(street, hdmap):
    arguments = ("--association", "dense", "--set", "points.refine_poses=false")
    code, _, err = hdmap("build", "drive", "-o", "map", *LABELS, *arguments)
    assert code == 0, err
    assert "hdmap points" in err
    assert sorted(p.name for p in street.iterdir() if p.name not in ("cache",)) == [
        "drive",
        "labels",
        "map",
    ]


@pytest.mark.parametrize("suffix", ["pcd", "ply", "laz"])
def test_points_go_out_and_come_in_as_a_map_of_someone_else(points, hdmap, suffix):
    if suffix == "laz":
        pytest.importorskip("laspy")
    export = ("--export", f"p.{suffix}", "--overwrite")
    code, _, err = hdmap("points", "drive", "-o", "points", *QUICK, *export)
    assert code == 0, err
    made = PointMap.open(points)
    cloud = read_point_file(points.parent / f"p.{suffix}")
    own = made.points_in(made.bounds_m)
    assert len(cloud) == made.num_points
    city = cloud.in_frame(made.meta.frame)
    np.testing.assert_allclose(city.mean(axis=0), own.points_city.mean(axis=0), atol=0.002)
    assert cloud.is_ground.sum() == own.is_ground.sum()
    code, _, err = hdmap("build", "drive", "-o", "map", *LABELS, "--points", f"p.{suffix}")
    assert code == 0, err


def test_a_point_map_of_another_place_is_refused_before_the_work(points, fails, street):
    meta = json.loads((points / "meta.json").read_text())
    for tile in meta["tiles"]:
        tile["x"] += 1000
    (points / "meta.json").write_text(json.dumps(meta))
    fails("build", "drive", "-o", "map", *LABELS, "--points", "points", says=("overlap", "scene"))
    assert not (street / "map").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("none", "-o", "p"), ("none",)),
        (("drive", "drive", "-o", "p"), ("once",)),
        (("cloud.pcd", "drive", "-o", "p"), ("alone",)),
        (("cloud.pcd", "-o", "p"), ("cloud.pcd",)),
        (("empty.ply", "-o", "p"), ("empty.ply",)),
        (("drive", "-o", "p", "--export", "p.xyz"), (".laz",)),
        (("drive", "-o", "p", "--set", "points.voxel_mm=70"), ("voxel_mm",)),
    ],
)
def test_bad_input_is_named_and_leaves_nothing(street, fails, arguments, says):
    (street / "empty.ply").write_bytes(b"")
    fails("points", *arguments, *QUICK, says=says)
    assert not (street / "p").exists()
    assert not [p for p in street.iterdir() if p.name.startswith(".")]


def test_mapping_with_what_is_no_point_map_is_refused(street, fails):
    for path in ("drive", "none"):
        fails("build", "drive", "-o", "map", *LABELS, "--points", path, says=(path, "point map"))
