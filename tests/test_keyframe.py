"""The whole way on recorded data: one real keyframe, a real network, the real map of the place."""

import json

import numpy as np
import pytest

from hdmap_tools.association.ground import GroundedSweep
from hdmap_tools.association.sparse import associate_sparse
from hdmap_tools.compare.mask_file import load_mask
from hdmap_tools.config import Config
from hdmap_tools.formats.gpkg import read_gpkg
from hdmap_tools.pipeline import run
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.segmentation.open_segmenter import open_segmenter

pytestmark = pytest.mark.realdata

ROAD, MARK = 1, 3


@pytest.fixture(scope="module")
def run_folder(data_root, tmp_path_factory):
    pytest.importorskip("openvino", reason="the keyframe's network is an OpenVINO model")
    folder = tmp_path_factory.mktemp("keyframe")
    for name in ("one", "two"):
        run(data_root / "nuscenes", folder / name, Config())
    return folder


@pytest.fixture(scope="module")
def labelled_points(data_root):
    """City points (N, 3) within 40 m and their labels, by the sparse method."""
    pytest.importorskip("openvino", reason="the keyframe's network is an OpenVINO model")
    config = Config()
    drive = open_drive(data_root / "nuscenes")
    segmenter = open_segmenter(config.segmentation, drive)
    sweep = drive.read_sweep(drive.sweeps[0])
    grounded = GroundedSweep.from_sweep(
        sweep,
        drive.trajectory.interpolate(sweep.timestamp_ns),
        config.association.max_range_m,
        config.association.ground_tolerance_m,
    )
    seen = [
        associate_sparse(
            segmenter.segment(image),
            segmenter.label_set,
            drive.cameras[image.camera],
            drive.trajectory.interpolate(image.timestamp_ns),
            grounded,
            config.association,
        )
        for image in drive.images
    ]
    return np.concatenate([o.points_city for o in seen]), np.concatenate([o.labels for o in seen])


@pytest.fixture(scope="module")
def is_on_mask(data_root):
    mask = load_mask(data_root / "nuscenes" / "drivable_mask.png")
    x0, y0, _, _ = mask.bounds_m

    def look_up(points):
        cells = np.floor((points[:, :2] - (x0, y0)) / mask.sidecar.resolution_m).astype(int)
        return mask.is_marked[cells[:, 1], cells[:, 0]]

    return look_up


def test_points_labelled_road_lie_on_the_real_map(labelled_points, is_on_mask):
    points, labels = labelled_points
    road = points[labels == ROAD]
    assert len(road) > 5000
    assert is_on_mask(road).mean() >= 0.92


def test_the_check_would_notice_a_shift(labelled_points, is_on_mask):
    points, labels = labelled_points
    moved = points[labels == ROAD] + (15.0, 0.0, 0.0)
    assert is_on_mask(moved).mean() < 0.3


def test_the_map_agrees_with_the_real_map(run_folder):
    metrics = json.loads((run_folder / "one" / "metrics.json").read_text())
    scores = {m: c["groups"]["drivable"] for m, c in metrics["comparisons"].items()}
    assert scores["sparse"]["iou"] >= 0.80
    # Following the ground beats a plane, and knows where it could not see.
    assert scores["surface"]["iou"] > scores["planar"]["iou"] + 0.1
    assert scores["surface"]["precision"] >= 0.93


def test_two_runs_give_identical_files(run_folder):
    for name in (
        "lanelet2_map.osm",
        "features.gpkg",
        "overview.png",
        "agreement.png",
        "hdmap.yaml",
    ):
        assert (run_folder / "one" / name).read_bytes() == (run_folder / "two" / name).read_bytes()


def test_the_real_lanelet2_library_loads_it(run_folder):
    lanelet2 = pytest.importorskip("lanelet2", reason="no lanelet2 wheel for this platform")
    features = read_gpkg(run_folder / "one" / "features.gpkg")
    assert len(features) > 5
    frame = features.frame
    lon, lat, _ = frame.to_wgs84(np.array([[411.3, 1180.9, 0.0]]))[0]
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(lat, lon))
    loaded, errors = lanelet2.io.loadRobust(str(run_folder / "one" / "lanelet2_map.osm"), projector)
    assert list(errors) == []
    back = []
    for point in loaded.pointLayer:
        gps = projector.reverse(lanelet2.core.BasicPoint3d(point.x, point.y, point.z))
        back.append([gps.lon, gps.lat, gps.alt])
    back = frame.from_wgs84(np.array(back))
    for element in features:
        outline = (
            element.geometry.exterior if element.geometry_type == "Polygon" else element.geometry
        )
        vertices = np.array(outline.coords)
        nearest = np.linalg.norm(vertices[:, None] - back[None], axis=2).min(axis=1)
        assert nearest.max() < 0.01, element.id
