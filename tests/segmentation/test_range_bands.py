"""Distance of a pixel over level ground, and counts by distance."""

import json

import numpy as np
import pytest

from hdmap_tools.errors import ConfigError, LabelError, ShapeError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation.confusion import ConfusionMatrix, RangeBand
from hdmap_tools.segmentation.range_bands import band_image, ground_range_m
from hdmap_tools.testing.street import LOOKING_AHEAD, camera

ADAS = load_label_set("adas-0001")
EDGES = (0.0, 10.0, 20.0)


def test_ground_points_project_onto_pixels_of_their_distance():
    pitched = SE3.from_quaternion(1.0, 0.01, 0.03, -0.02, np.array([1.7, 0.1, 1.5]))
    cam = PinholeCamera(
        "F", 640, 400, 470.0, 476.0, 314.3, 187.7,
        pitched @ SE3(LOOKING_AHEAD, np.zeros(3)), (-0.05, 0.01, 0.0, 0.0, 0.0),
    )  # fmt: skip
    ranges = ground_range_m(cam, -0.3)
    rng = np.random.default_rng(0)
    points = np.column_stack(
        [rng.uniform(4, 40, 3000), rng.uniform(-12, 12, 3000), np.full(3000, -0.3)]
    )
    projection = cam.project(points)
    ok = projection.is_valid
    assert ok.sum() > 500
    u, v = np.rint(projection.uv[ok]).astype(int).T
    expected = np.hypot(*(points[ok, :2] - cam.ego_SE3_cam.translation[:2]).T)
    # A pixel is so far across at that distance: range squared over (height times focal length).
    np.testing.assert_array_less(np.abs(ranges[v, u] - expected), 0.05 + expected**2 / (1.8 * 470))


def test_the_horizon_and_above_are_in_the_last_band():
    ranges = ground_range_m(camera())
    assert np.isinf(ranges[:187]).all()
    assert np.isfinite(ranges[190:]).all()
    assert (np.diff(ranges[190:, 300]) < 0).all()
    bands = band_image(ranges, EDGES)
    assert bands.dtype == np.uint8
    assert (bands[:187] == 2).all()
    np.testing.assert_array_equal(bands == 0, ranges < 10.0)
    np.testing.assert_array_equal(bands == 1, (ranges >= 10.0) & (ranges < 20.0))
    # A camera below the ground sees none of it.
    assert np.isinf(ground_range_m(camera(), 3.0)).all()


@pytest.mark.parametrize(
    "edges", [(), (0.0,), (1.0, 2.0), (0.0, 5.0, 5.0), (0.0, np.inf), (0.0, -1.0)]
)
def test_edges_that_are_none_are_refused(edges):
    with pytest.raises(ConfigError, match="0,10,20,40"):
        band_image(np.zeros((2, 2)), edges)


def measured(seed: int = 0) -> ConfusionMatrix:
    rng = np.random.default_rng(seed)
    true, said = (rng.integers(0, 4, (30, 40)).astype(np.uint8) for _ in range(2))
    true[:3] = 255
    bands = rng.integers(0, 3, (30, 40)).astype(np.uint8)
    return ConfusionMatrix.measure(true, said, ADAS, ADAS, band_image=bands, range_edges_m=EDGES)


def test_bands_count_their_own_pixels():
    true = np.array([[0, 1, 1], [3, 255, 1]], np.uint8)
    said = np.array([[0, 1, 3], [3, 1, 1]], np.uint8)
    bands = np.array([[0, 0, 1], [1, 1, 2]], np.uint8)
    matrix = ConfusionMatrix.measure(true, said, ADAS, ADAS, band_image=bands, range_edges_m=EDGES)
    assert matrix == matrix
    assert matrix.counts.sum() == 5
    assert [b.counts.sum() for b in matrix.bands] == [2, 2, 1]
    assert matrix.bands[1].counts[1, 3] == 1
    assert [b.name for b in matrix.bands] == ["0-10 m", "10-20 m", "20 m and beyond"]
    near = matrix.of_band(0)
    assert near.agreement(["road"], ["road"]).recall == 1.0
    assert matrix.of_band(1).agreement(["road"], ["road"]).recall == 0.0
    whole = ConfusionMatrix.measure(true, said, ADAS, ADAS)
    np.testing.assert_array_equal(whole.counts, matrix.counts)
    assert whole != matrix
    assert set(matrix.label_agreement()) == set(ADAS.names)


def test_matrices_of_the_same_bands_add_up():
    a, b = measured(0), measured(1)
    total = a + b
    for one, x, y in zip(total.bands, a.bands, b.bands, strict=True):
        np.testing.assert_array_equal(one.counts, x.counts + y.counts)
    plain = ConfusionMatrix(ADAS, ADAS, a.counts)
    with pytest.raises(LabelError, match="cannot be added"):
        _ = a + plain


def test_bands_come_back_from_json_and_files_without_them_too():
    matrix = measured()
    text = matrix.to_json()
    assert ConfusionMatrix.from_json(text) == matrix
    assert ConfusionMatrix.from_json(text).to_json() == text
    plain = ConfusionMatrix(ADAS, ADAS, matrix.counts, "s")
    assert "bands" not in json.loads(plain.to_json())
    assert ConfusionMatrix.from_json(plain.to_json()) == plain


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d["bands"][0]["counts"][0].__setitem__(0, 10**6), "add up"),
        (lambda d: d["bands"][0].__setitem__("max_m", 9.0), "without gaps"),
        (lambda d: d["bands"].pop(), "infinity"),
        (lambda d: d["bands"][0]["counts"].pop(), "expected"),
        (lambda d: d["bands"][0]["counts"][0].pop(), "confusion matrix|inhomogeneous|differ"),
    ],
)
def test_bands_that_do_not_fit_are_refused(change, says):
    document = json.loads(measured().to_json())
    change(document)
    with pytest.raises(LabelError, match=says):
        ConfusionMatrix.from_json(json.dumps(document))


def test_bands_of_another_size_are_refused():
    image = np.zeros((4, 5), np.uint8)
    with pytest.raises(ShapeError, match="Range bands"):
        ConfusionMatrix.measure(image, image, ADAS, ADAS, band_image=image[:3], range_edges_m=EDGES)
    with pytest.raises(ShapeError, match="Range bands"):
        ConfusionMatrix.measure(image, image, ADAS, ADAS, band_image=image + 3, range_edges_m=EDGES)
    counts = np.zeros((4, 4), np.int64)
    with pytest.raises(LabelError, match="without gaps"):
        ConfusionMatrix(ADAS, ADAS, counts, bands=(RangeBand(1.0, np.inf, counts),))
