"""`hdmap info`: short for people, whole in JSON."""

import json

import cv2
import numpy as np
import pytest

from hdmap_tools.formats.by_name import write_vector_map
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.vector_map import VectorMap

from .conftest import LABELS

OSM = """<?xml version="1.0"?>
<osm version="0.6" generator="me">
  <node id="1" lat="49.0" lon="8.4"/>
  <node id="2" lat="49.0001" lon="8.4"/>
  {nodes}
  <way id="100"><nd ref="1"/><nd ref="2"/><tag k="type" v="curbstone"/></way>
  {ways}
</osm>
"""


@pytest.fixture
def map_with_much_to_skip(tmp_path):
    nodes = "".join(
        f'<node id="{k}" lat="49.0" lon="8.4"><tag k="type" v="kind{k}"/></node>'
        for k in range(10, 40)
    )
    ways = "".join(
        f'<way id="{k}"><nd ref="1"/><nd ref="2"/><tag k="type" v="odd_kind_number_{k}"/></way>'
        for k in range(200, 230)
    )
    path = tmp_path / "m.osm"
    path.write_text(OSM.format(nodes=nodes, ways=ways))
    return path


def test_what_was_skipped_is_said_in_a_line_and_kept_whole(map_with_much_to_skip, hdmap, tmp_path):
    code, out, err = hdmap("info", map_with_much_to_skip, "--json", tmp_path / "f.json")
    assert code == 0, err
    assert "skipped: 30 node, 30 way (--json lists them)\n" in out
    assert len(out.splitlines()) < 12
    (warning,) = err.splitlines()
    assert "30 node, 30 way (-v or info --json lists them)" in warning
    assert len(warning) - len(str(map_with_much_to_skip)) < 200
    facts = json.loads((tmp_path / "f.json").read_text())
    assert facts["provenance"]["skipped"]["way:odd_kind_number_229"] == 1
    assert facts["provenance"]["skipped_ids"]["way:odd_kind_number_229"] == ["229"]
    # Asked for more, the log has each.
    _, _, err = hdmap("-v", "info", map_with_much_to_skip)
    assert "way:odd_kind_number_229" in err


def test_bounds_are_named_and_plugins_are_a_line_each(mark, hdmap, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = {"a": 1.0, "b": [1, 2]}
    provenance = {
        "plugins": [{"name": "marks", "version": "1.2", "options": options}, "not a plugin"],
        "seed": 7,
        "note": "x" * 500,
    }
    vector_map = VectorMap(MapFrame.from_origin(49.0, 8.4), (mark,), provenance)
    write_vector_map(vector_map, "m.gpkg")
    code, out, err = hdmap("info", "m.gpkg", "--json", "f.json")
    assert code == 0, err
    assert "bounds m: west 0.0, south 0.0, east 10.0, north 0.0\n" in out
    assert "plugin: marks 1.2\n" in out
    assert "seed: 7\n" in out
    assert "{" not in out
    assert max(map(len, out.splitlines())) <= 120
    facts = json.loads((tmp_path / "f.json").read_text())
    assert facts["provenance"] == provenance
    assert facts["bounds_m"] == {"west": 0.0, "south": 0.0, "east": 10.0, "north": 0.0}
    write_vector_map(VectorMap(MapFrame(), ()), "empty.gpkg")
    code, out, _ = hdmap("info", "empty.gpkg")
    assert code == 0
    assert "bounds m: none\n" in out


def test_a_mask(hdmap, fails, tmp_path):
    mask = np.zeros((20, 30), dtype=np.uint8)
    mask[:5] = 255
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    fails("info", tmp_path / "m.png", says=("m.json",))
    sidecar = {
        "resolution_m": 0.5,
        "origin_xy_m": [10, 20],
        "size_px": [30, 20],
        "map_origin_latlon": [49.0, 8.4],
    }
    (tmp_path / "m.json").write_text(json.dumps(sidecar))
    code, out, err = hdmap("info", tmp_path / "m.png")
    assert code == 0, err
    for line in (
        "kind: mask",
        "place: transverse Mercator at latitude 49.000000, longitude 8.400000, heights above WGS84",
        "classes: road, crosswalk, lane_mark",
        "resolution m: 0.5",
        "size: 30 x 20 pixels",
        "marked: 25.0%",
        "bounds m: west 10.0, south 20.0, east 25.0, north 30.0",
    ):
        assert line in out.splitlines()


def test_figures_are_no_map_and_a_run_s_folder_is_described(street, hdmap, fails):
    code, _, err = hdmap("run", "drive", "-o", "out", *LABELS)
    assert code == 0, err
    fails("info", "out/metrics.json", says=("figures of a run", "out"))
    code, out, err = hdmap("info", "out")
    assert code == 0, err
    assert "kind: semantic map" in out


def test_a_map_that_cannot_be_read_yet_is_marked(street, hdmap, monkeypatch):
    from dataclasses import replace

    from hdmap_tools import describe
    from hdmap_tools.readers.open_drive import open_drive

    maps = tuple(
        street / name for name in ("log_map_archive_x____PIT.json", "m.osm", "m.png", "m.xodr")
    )
    monkeypatch.setattr(
        describe, "open_drive", lambda *given: replace(open_drive(*given), reference_maps=maps)
    )
    code, out, err = hdmap("info", "drive")
    assert code == 0, err
    listed = [line.strip() for line in out.splitlines() if str(street) in line]
    marked = [line.endswith(" (not readable yet)") for line in listed]
    assert marked == [True, False, False, True]


def test_a_json_file_that_exists_is_replaced_when_asked(mark, hdmap, fails, tmp_path):
    write_vector_map(VectorMap(MapFrame(), (mark,)), tmp_path / "m.gpkg")
    for command in (("info", tmp_path / "m.gpkg"), ("plugins", "list")):
        (tmp_path / "f.json").write_text("something else")
        fails(*command, "--json", tmp_path / "f.json", says=("f.json", "--overwrite"))
        code, _, err = hdmap(*command, "--json", tmp_path / "f.json", "--overwrite")
        assert code == 0, err
        assert json.loads((tmp_path / "f.json").read_text())
