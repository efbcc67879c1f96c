"""The network that does not exist: its mean confusion is the matrix, its errors look like a network's."""

from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.config import SegmentationConfig
from hdmap_tools.errors import ConfigError, LabelError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.readers.av2 import read_av2
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.segmentation.assumed_confusion import assumed_confusion
from hdmap_tools.segmentation.confusion import ConfusionMatrix, find_confusion
from hdmap_tools.segmentation.label_noise import ViewedGround
from hdmap_tools.segmentation.label_png import read_label_png, write_label_png
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.segmentation.simulated import SimulatedSegmenter
from hdmap_tools.testing.street import camera as street_camera

PAZ = load_label_set("paz2020")
ROAD, MARK, SKY, SIDEWALK, CROSSWALK = (
    PAZ.id_of(name) for name in ("road", "lane marking", "sky", "sidewalk", "crosswalk")
)
CAMERA = street_camera().scaled(320, 200)
NUM_IMAGES = 50


def true_image(shift_m: float) -> np.ndarray:
    """A straight street: sidewalks, a dashed line in the middle, a crosswalk every 20 m."""
    ground = ViewedGround.of_camera(CAMERA)
    ahead = ground.x + shift_m
    labels = np.full(ground.reach.shape, SKY, np.uint8)
    labels[ground.is_ground] = SIDEWALK
    on_road = ground.is_ground & (np.abs(ground.y) < 4)
    labels[on_road] = ROAD
    labels[on_road & (np.mod(ahead, 20.0) < 4)] = CROSSWALK
    labels[on_road & (np.abs(ground.y) < 0.15) & (np.mod(ahead, 20.0) > 5)] = MARK
    return labels


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> tuple[Path, list[ImageRef], Trajectory]:
    """True label images of a drive along that street."""
    folder = tmp_path_factory.mktemp("truth")
    (folder / "label_set.json").write_text(PAZ.model_dump_json())
    images = []
    for k in range(NUM_IMAGES):
        images.append(ImageRef(CAMERA.name, 1000 + k, folder / "none"))
        write_label_png(folder / f"{images[-1].key}.png", true_image(2.0 * k))
    times = np.arange(1000, 1000 + NUM_IMAGES)
    moved = np.column_stack([2.0 * np.arange(NUM_IMAGES), np.zeros((NUM_IMAGES, 2))])
    poses = Trajectory(times, np.tile(np.eye(3), (NUM_IMAGES, 1, 1)), moved)
    return folder, images, poses


def matrix(**rows: dict[str, float]) -> ConfusionMatrix:
    counts = np.zeros((len(PAZ), len(PAZ)), np.int64)
    for name, row in rows.items():
        true = PAZ.id_of(name.replace("_", " "))
        for other, share in row.items():
            counts[true, PAZ.id_of(other.replace("_", " "))] = round(share * 1e6)
        counts[true, true] = 1_000_000 - counts[true].sum()
    return ConfusionMatrix(PAZ, PAZ, counts)


def segmenter(street, confusion, seed=0, cameras=None) -> SimulatedSegmenter:
    folder, _, poses = street
    return SimulatedSegmenter(folder, confusion, seed, cameras or {CAMERA.name: CAMERA}, poses)


def truth_of(street, image: ImageRef) -> np.ndarray:
    return read_label_png(street[0] / f"{image.key}.png")


def measured(street, confusion: ConfusionMatrix | None) -> ConfusionMatrix:
    """Over four drives of 25 images each."""
    total = ConfusionMatrix(PAZ, PAZ, np.zeros((len(PAZ), len(PAZ)), np.int64))
    for seed in range(4):
        network = segmenter(street, confusion, seed)
        for image in street[1][seed % 2 :: 2]:
            drawn = network.segment(image)
            total += ConfusionMatrix.measure(truth_of(street, image), drawn, PAZ, PAZ)
    return total


def shares(confusion: ConfusionMatrix) -> np.ndarray:
    return confusion.counts / np.maximum(confusion.counts.sum(axis=1, keepdims=True), 1)


def test_the_mean_confusion_over_a_drive_is_the_matrix_asked_for(street):
    wanted = ConfusionMatrix.load("simulated")
    # Errors on the ground are one draw a drive: several drives, or the mean is a matter of luck.
    found = measured(street, None)
    for label in (ROAD, MARK, SKY, SIDEWALK, CROSSWALK):
        # Blobs make far fewer independent draws than pixels: a few points are left.
        np.testing.assert_allclose(shares(found)[label], shares(wanted)[label], atol=0.04)


def test_a_matrix_of_another_kind_is_met_as_well(street):
    wanted = matrix(lane_marking={"road": 0.6}, road={"sidewalk": 0.1, "crosswalk": 0.05})
    found = shares(measured(street, wanted))
    assert found[MARK, ROAD] == pytest.approx(0.6, abs=0.04)
    assert found[ROAD, SIDEWALK] == pytest.approx(0.1, abs=0.02)
    assert found[ROAD, CROSSWALK] == pytest.approx(0.05, abs=0.02)
    # Rows without counts, and labels that no row names, stay as they are.
    assert found[SKY, SKY] == found[SIDEWALK, SIDEWALK] == found[CROSSWALK, CROSSWALK] == 1.0


def test_a_matrix_without_errors_gives_the_truth(street):
    network = segmenter(street, matrix())
    for image in street[1][:3]:
        np.testing.assert_array_equal(network.segment(image), truth_of(street, image))


def test_errors_come_in_blobs_at_edges_and_far_away(street):
    network = segmenter(street, matrix(road={"sidewalk": 0.08}))
    ground = ViewedGround.of_camera(CAMERA)
    range_m = np.hypot(ground.x, ground.y)
    places = {
        "near": (range_m < 10) & (np.abs(ground.y) < 2),
        "far": (range_m > 14) & (range_m < 30) & (np.abs(ground.y) < 2),
        "edge": (range_m < 14) & (np.abs(np.abs(ground.y) - 4) < 0.2),
        "inside": (range_m < 14) & (np.abs(ground.y) < 2),
    }
    errors = {name: np.zeros(2) for name in (*places, "beside an error")}
    for image in street[1]:
        truth = truth_of(street, image)
        is_road = truth == ROAD
        wrong = network.segment(image) != truth
        for name, where in places.items():
            errors[name] += wrong[where & is_road].sum(), (where & is_road).sum()
        beside = is_road[:, 1:] & is_road[:, :-1] & wrong[:, :-1]
        errors["beside an error"] += wrong[:, 1:][beside].sum(), beside.sum()
    rate = {name: wrong / pixels for name, (wrong, pixels) in errors.items()}
    assert rate["beside an error"] > 0.7  # independent pixels would give 0.08
    assert rate["far"] > 1.8 * rate["near"]
    assert rate["edge"] > 2 * rate["inside"]


def test_errors_on_the_ground_come_back_in_the_next_image_and_others_do_not(street):
    network = segmenter(street, matrix(road={"sidewalk": 0.3}, sky={"building": 0.3}))
    ground = ViewedGround.of_camera(CAMERA)
    on_ground = ground.is_ground & (np.hypot(ground.x, ground.y) < 12)
    # The same place again: a pose and a truth of its own for a new time.
    folder, images, poses = street
    first = images[0]
    again = ImageRef(CAMERA.name, 1, first.path)
    write_label_png(folder / f"{again.key}.png", truth_of(street, first))
    times = np.concatenate([[1], poses.timestamps_ns])
    both = Trajectory(
        times,
        np.concatenate([poses.rotations[:1], poses.rotations]),
        np.concatenate([poses.translations[:1], poses.translations]),
    )
    network = SimulatedSegmenter(folder, network.confusion, 0, {CAMERA.name: CAMERA}, both)
    truth = truth_of(street, first)
    one, two = (network.segment(image) != truth for image in (first, again))
    (folder / f"{again.key}.png").unlink()
    for where, low, high in (
        (on_ground & (truth == ROAD), 0.1, 0.6),
        (truth == SKY, -0.3, 0.3),
    ):
        assert low < np.corrcoef(one[where], two[where])[0, 1] < high


def test_labels_follow_from_the_seed_and_the_image(street):
    image = street[1][5]
    one, same, other = (segmenter(street, None, seed) for seed in (3, 3, 4))
    labels = one.segment(image)
    one.segment(street[1][6])
    np.testing.assert_array_equal(one.segment(image), labels)
    np.testing.assert_array_equal(same.segment(image), labels)
    assert (other.segment(image) != labels).mean() > 0.005
    assert one.fingerprint == same.fingerprint != other.fingerprint
    assert one.fingerprint != segmenter(street, matrix(), 3).fingerprint


def test_pixels_to_be_ignored_stay_so(street, tmp_path):
    (tmp_path / "label_set.json").write_text(PAZ.model_dump_json())
    labels = true_image(0.0)
    labels[150:, :100] = 255
    write_label_png(tmp_path / CAMERA.name / "1000.png", labels)
    network = SimulatedSegmenter(tmp_path, None, 0, {CAMERA.name: CAMERA}, street[2])
    drawn = network.segment(ImageRef(CAMERA.name, 1000, tmp_path / "none"))
    np.testing.assert_array_equal(drawn == 255, labels == 255)


def test_cameras_of_any_size_and_direction_work(street):
    image = street[1][0]
    up = PinholeCamera(
        CAMERA.name, 320, 200, 200.0, 200.0, 160, 100, SE3(np.eye(3), np.array([0, 0, 1.5]))
    )
    network = segmenter(street, None, cameras={CAMERA.name: up})
    assert network.segment(image).shape == (200, 320)


def test_the_shipped_matrix_is_what_its_recipe_gives():
    shipped, made = ConfusionMatrix.load("simulated"), assumed_confusion()
    assert shipped == made
    assert "Assumed, not measured" in shipped.source
    assert (shipped.counts.sum(axis=1) > 0).all()
    assert (np.diag(shares(shipped)) > 0.45).all()
    recalls = np.diag(shares(shipped))
    assert np.argsort(recalls)[-1] == SKY


def test_the_assumed_matrix_is_taken_for_the_simulated_network_and_no_other():
    assert find_confusion(PAZ, "simulated") == ConfusionMatrix.load("simulated")
    assert find_confusion(PAZ, "truth") is None
    assert find_confusion(PAZ, "precomputed") is None


# --- from the configuration ----------------------------------------------------------


def test_the_configuration_asks_for_it_by_name(simulated_drive):
    drive = read_av2(simulated_drive)
    network = open_segmenter(SegmentationConfig(model=Path("simulated"), seed=9), drive)
    assert isinstance(network, SimulatedSegmenter)
    truth = read_label_png(simulated_drive / "truth/label_images" / f"{drive.images[0].key}.png")
    assert 0.01 < (network.segment(drive.images[0]) != truth).mean() < 0.2


def test_a_matrix_of_other_labels_is_refused(simulated_drive):
    config = SegmentationConfig(
        model=Path("simulated"), confusion=Path("road-segmentation-adas-0001")
    )
    with pytest.raises(LabelError, match=r"confusion matrix has the .* labels of .*paz2020"):
        open_segmenter(config, read_av2(simulated_drive))


def test_a_drive_without_truth_is_refused(simulated_drive, tmp_path):
    import shutil

    shutil.copytree(
        simulated_drive, tmp_path / "log", ignore=shutil.ignore_patterns("truth", "lidar")
    )
    with pytest.raises(ConfigError, match="hdmap simulate"):
        open_segmenter(SegmentationConfig(model=Path("simulated")), read_av2(tmp_path / "log"))


def test_a_matrix_to_err_by_needs_the_simulated_network(simulated_drive):
    config = SegmentationConfig(model=Path("network.onnx"), confusion=Path("m.json"))
    with pytest.raises(ConfigError, match="--model simulated"):
        open_segmenter(config, read_av2(simulated_drive))


def test_a_profile_for_it_is_refused(simulated_drive):
    config = SegmentationConfig(model=Path("simulated"), profile="x")
    with pytest.raises(ConfigError, match="--profile"):
        open_segmenter(config, read_av2(simulated_drive))
