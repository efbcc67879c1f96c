"""`hdmap reliability` on a built map, against a mask of the road."""

import json

import cv2
import numpy as np
import pytest

from hdmap_tools.compare.reliability import ReliabilityReport

from .conftest import LABELS


@pytest.fixture
def built(hdmap, street):
    """The street's map, and a mask of where it can be driven on."""
    code, _, err = hdmap(
        "build", "drive", "-o", "map", *LABELS, "--resolution", "0.2", "--no-cache"
    )
    assert code == 0, err
    mask = np.zeros((400, 800), np.uint8)  # 0.1 m from (280, 980) on
    y = 980.05 + 0.1 * np.arange(400)
    mask[np.abs(y - 1000.0) < 6.0] = 255
    cv2.imwrite("road.png", mask[::-1])
    sidecar = {
        "resolution_m": 0.1,
        "origin_xy_m": [280.0, 980.0],
        "size_px": [800, 400],
        "map_origin_latlon": [1.2882100868743724, 103.78475189208984],
    }
    (street / "road.json").write_text(json.dumps(sidecar))
    return street


def test_figures_and_diagram_are_written(hdmap, built):
    code, said, err = hdmap(
        "reliability",
        "map",
        "--truth",
        "road.png",
        "-o",
        "out",
        "--block-m",
        "5",
        "--json",
        "f.json",
    )
    assert code == 0, err
    report = ReliabilityReport.model_validate_json((built / "out" / "reliability.json").read_text())
    assert json.loads((built / "f.json").read_text()) == json.loads(report.to_json())
    assert f"observation.temperature={report.temperature:.4g}" in said
    assert cv2.imread(str(built / "out" / "reliability.png")) is not None
    assert report.before.num_cells + report.num_cells_fitted > 1000
    assert report.before.accuracy > 0.95
    # Labels without an error: the fit may only make the map surer, and better.
    assert report.after.nll <= report.before.nll + 1e-3
    assert report.temperature < 1.0
    # Reading with the temperature printed, nothing is left to fit.
    code, _, err = hdmap(
        "reliability", "map", "--truth", "road.png", "-o", "again", "--block-m", "5",
        "--set", f"observation.temperature={report.temperature:.6g}",
    )  # fmt: skip
    assert code == 0, err
    again = ReliabilityReport.model_validate_json(
        (built / "again" / "reliability.json").read_text()
    )
    assert again.temperature == pytest.approx(report.temperature, rel=0.02)
    assert again.before.ece == pytest.approx(report.after.ece, abs=1e-3)


def test_what_the_map_taught_itself_is_kept(hdmap, built):
    given = ("reliability", "map", "--truth", "road.png", "--block-m", "5")
    code, _, err = hdmap(*given, "-o", "out", "--set", "observation.intensity=learned")
    assert code == 0, err
    document = json.loads((built / "out" / "intensity.json").read_text())
    assert "lane_mark" in document["classes"]
    code, _, err = hdmap(
        *given, "-o", "again", "--set", "observation.intensity=learned",
        "--set", "observation.intensity_likelihood=out/intensity.json",
    )  # fmt: skip
    assert code == 0, err
    one, two = (json.loads((built / n / "reliability.json").read_text()) for n in ("out", "again"))
    assert two["before"]["nll"] == pytest.approx(one["before"]["nll"], abs=1e-4)


def test_bad_input_leaves_nothing(fails, built):
    fails("reliability", "map", "--truth", "none.png", "-o", "out", says=("none.png",))
    fails("reliability", "road.png", "--truth", "road.png", "-o", "out", says=("semantic map",))
    sidecar = json.loads((built / "road.json").read_text())
    (built / "road.json").write_text(json.dumps(sidecar | {"origin_xy_m": [9000.0, 0.0]}))
    fails("reliability", "map", "--truth", "road.png", "-o", "out", says=("another place",))
    (built / "road.json").write_text(json.dumps(sidecar))
    fails(
        "reliability", "map", "--truth", "road.png", "-o", "out", "--block-m", "900000",
        says=("fitted on",),
    )  # fmt: skip
    fails(
        "reliability", "map", "--truth", "road.png", "-o", "out", "--block-m", "0.1",
        says=("0.1 m", "cells"),
    )  # fmt: skip
    assert not (built / "out").exists()
