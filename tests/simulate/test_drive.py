"""A whole small drive, judged by the data set's own package, by its own truth, and by its bytes."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.errors import OutputExistsError, WorldError
from hdmap_tools.formats.gpkg import read_gpkg
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.readers.av2 import read_av2
from hdmap_tools.readers.image import read_image
from hdmap_tools.segmentation.label_png import read_label_png
from hdmap_tools.segmentation.precomputed import PrecomputedSegmenter
from hdmap_tools.simulate import drive as drive_module
from hdmap_tools.simulate import recorder as recorder_module
from hdmap_tools.simulate.drive import simulate_drive
from hdmap_tools.simulate.drive_plan import plan_drive, planned_shots
from hdmap_tools.simulate.read_world import read_world, shipped_world
from hdmap_tools.simulate.settings import (
    CameraRig,
    LidarPreset,
    PoseErrors,
    SimulationSettings,
)
from hdmap_tools.simulate.truth_raster import TruthRaster

PAZ = load_label_set("paz2020")
GROUND = [
    PAZ.id_of(name)
    for name in ("road", "lane marking", "crosswalk", "sidewalk", "curb", "manhole", "vegetation")
]
TINY = SimulationSettings(
    seed=5,
    length_m=10,
    camera_hz=1.0,
    lidar_hz=4.0,
    speed_mps=6,
    image_width_px=128,
    image_height_px=80,
    lidar=LidarPreset.VLP16,
)


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_our_reader_reads_all_of_it(simulated_drive):
    drive = read_av2(simulated_drive)
    assert drive.warnings == ()
    made = json.loads((simulated_drive / "truth" / "simulation.json").read_text())
    plan = plan_drive(
        read_world(shipped_world()), SimulationSettings.model_validate(made["settings"])
    )
    times = [image.timestamp_ns for image in drive.images]
    assert times == [shot.timestamp_ns for shot in plan.shots if shot.camera == 0]
    times = [sweep.timestamp_ns for sweep in drive.sweeps]
    assert times == [shot.timestamp_ns for shot in plan.shots if shot.camera is None]
    assert len(drive.images) >= 3
    assert drive.frame == read_world(shipped_world()).frame
    assert drive.frame.is_georeferenced
    assert drive.trajectory.length_m == pytest.approx(16, abs=0.3)
    for image in drive.images:
        rgb = read_image(image, drive.cameras[image.camera])
        assert rgb.std() > 10
        assert image.timestamp_ns in drive.trajectory.timestamps_ns
    folder = simulated_drive / "truth" / "label_images"
    labels = PrecomputedSegmenter(folder, PAZ, drive.cameras)
    assert labels.name == "truth"
    assert {PAZ.id_of("road"), PAZ.id_of("sky")} <= set(np.unique(labels.segment(drive.images[0])))
    vectors = read_gpkg(simulated_drive / "truth" / "vector_map.gpkg")
    vectors.frame.require_same(drive.frame)
    assert vectors.counts()["lane_mark"] > 0
    sweep = drive.read_sweep(drive.sweeps[0])
    # float32 is kept: float16 could not hold most of these.
    assert (sweep.points_ego.astype(np.float16) != sweep.points_ego).mean() > 0.9


def projected(drive, image, points_city, shift_px=(0, 0), log=None):
    """Columns and rows (M, 2) of city points in an image by av2's own projection, and which rows."""
    from av2.geometry.camera.pinhole_camera import PinholeCamera as TheirCamera
    from av2.utils.io import read_city_SE3_ego

    camera = TheirCamera.from_feather(log, image.camera)
    pose = read_city_SE3_ego(log)[image.timestamp_ns]
    points_ego = pose.inverse().transform_point_cloud(points_city)
    uv, _, is_valid = camera.project_ego_to_img(points_ego)
    uv = np.round(uv[:, :2] + shift_px).astype(int)
    inside = is_valid & (uv >= 1).all(axis=1)
    inside &= (uv < np.array([camera.width_px, camera.height_px]) - 1).all(axis=1)
    return uv[inside], np.flatnonzero(inside)


def agreement(log: Path, shift_px=(0, 0)) -> tuple[float, float, int]:
    """Of ground points that nothing hides: label as in the raster, exactly or within a pixel."""
    from av2.structures.sweep import Sweep as TheirSweep
    from av2.utils.io import read_city_SE3_ego

    drive = read_av2(log)
    raster = TruthRaster.open(log / "truth" / "raster")
    poses = read_city_SE3_ego(log)
    exact, around, count = 0, 0, 0
    for image in drive.images:
        labels = read_label_png(log / "truth/label_images" / f"{image.key}.png")
        sweep = drive.nearest_sweep(image.timestamp_ns, 0.2)
        theirs = TheirSweep.from_feather(sweep.path)
        city = poses[sweep.timestamp_ns].transform_point_cloud(theirs.xyz.astype(np.float64))
        near = np.linalg.norm(theirs.xyz[:, :2], axis=1) < 30
        truth = raster.labels_at(city)
        is_ground = near & np.isin(truth, GROUND)
        is_ground &= np.abs(city[:, 2] - raster.height_at(city)) < 0.04
        uv, rows = projected(drive, image, city[is_ground], shift_px, log)
        wanted = truth[is_ground][rows]
        seen = labels[uv[:, 1], uv[:, 0]]
        is_open = np.isin(seen, GROUND)
        block = np.stack(
            [labels[uv[:, 1] + dv, uv[:, 0] + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)]
        )
        exact += (seen == wanted)[is_open].sum()
        around += (block == wanted).any(axis=0)[is_open].sum()
        count += is_open.sum()
    return exact / count, around / count, count


def test_lidar_points_land_on_the_pixels_of_what_they_hit(simulated_drive):
    pytest.importorskip("av2", reason="av2 has no wheel for this Python")
    exact, around, count = agreement(simulated_drive)
    assert count > 1000
    assert exact > 0.97
    assert around > 0.99
    # The measure notices: six pixels off, and it drops.
    assert agreement(simulated_drive, (6, 6))[1] < around - 0.02


def test_the_data_sets_package_loads_map_and_ground(simulated_drive):
    pytest.importorskip("av2", reason="av2 has no wheel for this Python")
    from av2.map.map_api import ArgoverseStaticMap
    from av2.structures.sweep import Sweep as TheirSweep
    from av2.utils.io import read_city_SE3_ego, read_ego_SE3_sensor

    static = ArgoverseStaticMap.from_map_dir(simulated_drive / "map", build_raster=True)
    assert len(static.vector_lane_segments) > 5
    for lane in static.vector_lane_segments.values():
        for successor in lane.successors:
            if successor in static.vector_lane_segments:
                assert lane.id in static.vector_lane_segments[successor].predecessors
    assert set(read_ego_SE3_sensor(simulated_drive)) == {
        "ring_front_center",
        "up_lidar",
        "down_lidar",
    }
    poses = read_city_SE3_ego(simulated_drive)
    sweeps = sorted((simulated_drive / "sensors" / "lidar").iterdir())
    path = sweeps[5]
    points = poses[int(path.stem)].transform_point_cloud(
        TheirSweep.from_feather(path).xyz.astype(np.float64)
    )
    ground = static.raster_ground_height_layer.get_ground_height_at_xy(points)
    on_road = static.raster_drivable_area_layer.get_raster_values_at_coords(
        points[:, :2], fill_value=0
    ).astype(bool)
    above = (points[:, 2] - ground)[on_road]
    assert on_road.sum() > 500
    assert np.abs(np.median(above)) < 0.02
    assert (np.abs(above) < 0.05).mean() > 0.8
    vehicle = np.array([pose.translation for pose in poses.values()])
    assert static.raster_drivable_area_layer.get_raster_values_at_coords(
        vehicle[:, :2], fill_value=0
    ).all()


@pytest.mark.slow
def test_the_same_settings_give_the_same_bytes_and_another_seed_others(tmp_path):
    world = shipped_world()
    one = bytes_of(simulate_drive(world, tmp_path / "one", TINY))
    same = bytes_of(simulate_drive(world, tmp_path / "elsewhere" / "two", TINY))
    assert list(one) == list(same)
    assert [name for name in one if one[name] != same[name]] == []
    other = plan_drive(read_world(world), TINY.model_copy(update={"seed": 6}))
    this = plan_drive(read_world(world), TINY)
    assert other.start_ns != this.start_ns
    assert not np.array_equal(other.city_SE3_ego.translations, this.city_SE3_ego.translations)


@pytest.mark.slow
def test_errors_are_on_what_is_given_and_truth_is_kept(tmp_path):
    errors = PoseErrors(noise_m=0.05, noise_deg=0.2, drift_m=0.3)
    settings = TINY.model_copy(
        update={"pose_errors": errors, "calibration_error_m": 0.02, "calibration_error_deg": 0.3}
    )
    world = shipped_world()
    plan = plan_drive(read_world(world), settings)
    log = simulate_drive(world, tmp_path / "log", settings)
    drive = read_av2(log)
    given, true = drive.trajectory, plan.city_SE3_ego
    np.testing.assert_array_equal(given.timestamps_ns, true.timestamps_ns)
    off_m = np.linalg.norm(given.translations - true.translations, axis=1)
    assert 0.02 < off_m.mean() < 0.4
    from hdmap_tools.readers.feather import read_columns

    truth = read_columns(
        log / "truth" / "city_SE3_egovehicle.feather", ("tx_m", "ty_m", "tz_m"), (), ValueError
    )
    np.testing.assert_array_equal(np.column_stack(list(truth.values())), true.translations)
    (camera,) = drive.cameras.values()
    error: SE3 = plan.cameras[0].ego_SE3_cam.inverse() @ camera.ego_SE3_cam
    assert 0.001 < np.linalg.norm(error.translation) < 0.12
    document = json.loads((log / "truth" / "simulation.json").read_text())
    np.testing.assert_allclose(
        document["ego_SE3_sensor"][camera.name], plan.cameras[0].ego_SE3_cam.matrix
    )
    # What the sensors see does not depend on the errors: only where points are said to lie.
    exact = simulate_drive(world, tmp_path / "exact", TINY)
    one, two = bytes_of(log / "sensors" / "cameras"), bytes_of(exact / "sensors" / "cameras")
    assert one == two
    moved, still = (
        (read := read_av2(folder)).read_sweep(read.sweeps[0]).points_ego for folder in (log, exact)
    )
    assert 1e-3 < np.abs(moved - still).max() < 2.0


def test_each_camera_has_its_own_phase_and_sweeps_follow_each_other():
    settings = SimulationSettings(camera_rig=CameraRig.FRONT3, camera_hz=5, lidar_hz=10)
    shots = planned_shots(settings, 3, 100_000_000, 10**18, 10**18 + 2_050_000_000)
    times = [shot.timestamp_ns for shot in shots]
    assert times == sorted(times)
    sweeps = [shot.timestamp_ns for shot in shots if shot.camera is None]
    assert len(sweeps) == 20
    assert set(np.diff(sweeps)) == {100_000_000}
    assert max(sweeps) + 100_000_000 <= 10**18 + 2_050_000_000
    firsts = [min(s.timestamp_ns for s in shots if s.camera == k) for k in range(3)]
    assert len(set(firsts)) == 3
    assert max(firsts) - min(firsts) < 200_000_000
    for k, count in enumerate((11, 10, 10)):
        own = [s.timestamp_ns for s in shots if s.camera == k]
        assert len(own) == count
        assert np.ptp(np.diff(own)) <= 1


def test_every_shot_lies_on_a_stretch_and_no_stretch_is_long():
    settings = TINY.model_copy(update={"length_m": 700.0, "speed_mps": 12.0})
    plan = plan_drive(read_world(shipped_world()), settings)
    stretches = plan.stretches()
    assert sum(len(shots) for _, shots in stretches) == len(plan.shots)
    assert len(stretches) >= 5
    for (first, last), shots in stretches:
        assert last - first < 150
        for shot in shots:
            end_ns = shot.timestamp_ns + (plan.lidar.turn_ns if shot.camera is None else 0)
            assert first - 1e-6 <= plan.arc_at(shot.timestamp_ns)
            assert plan.arc_at(end_ns) <= last + 1e-6


def test_the_vehicle_keeps_to_the_limits_of_a_vehicle():
    plan = plan_drive(
        read_world(shipped_world()), TINY.model_copy(update={"length_m": 400.0, "speed_mps": 12.0})
    )
    poses = plan.city_SE3_ego
    seconds = np.diff(poses.timestamps_ns) / 1e9
    speed = np.linalg.norm(np.diff(poses.translations, axis=0), axis=1)[seconds > 0.005]
    assert (speed / seconds[seconds > 0.005]).max() < 12.5
    roll_pitch = np.abs(poses.rotations[:, 2, :2]).max()
    assert 0.0 < roll_pitch < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "function"),
    [
        (recorder_module.write_log, "write_jpeg"),
        (recorder_module.truth_files, "write_true_labels"),
        (drive_module, "write_truth_raster"),
        (recorder_module, "RayCaster"),
    ],
)
def test_nothing_is_left_when_any_thread_fails_on_the_way(tmp_path, monkeypatch, module, function):
    def broken(*_args, **_options):
        raise RuntimeError("the disk is full")

    monkeypatch.setattr(module, function, broken)
    with pytest.raises(RuntimeError, match="disk is full"):
        simulate_drive(shipped_world(), tmp_path / "log", TINY)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_building_of_the_true_map_ends_when_recording_fails(tmp_path, monkeypatch):
    reported = []

    def endless(*_args, progress):
        while len(reported) < 10_000:
            time.sleep(0.01)
            reported.append(len(reported))
            progress(len(reported), 10_000)

    def broken(*_args):
        raise RuntimeError("the disk is full")

    monkeypatch.setattr(drive_module, "write_truth_raster", endless)
    monkeypatch.setattr(recorder_module.write_log, "write_jpeg", broken)
    with pytest.raises(RuntimeError, match="disk is full"):
        simulate_drive(shipped_world(), tmp_path / "log", TINY)
    assert len(reported) < 10_000


@pytest.mark.slow
def test_progress_rises_to_all_there_is(tmp_path):
    told = []
    drive = simulate_drive(
        shipped_world(), tmp_path / "log", TINY, progress=lambda *told_now: told.append(told_now)
    )
    files = {
        "images": list(drive.glob("sensors/cameras/*/*.jpg")),
        "sweeps": list(drive.glob("sensors/lidar/*.feather")),
        "tiles": list(drive.glob("truth/raster/*.npy")),
    }
    for what, written in files.items():
        steps = [(done, total) for name, done, total in told if name == what]
        assert steps == sorted(steps)
        assert steps[-1] == (len(written), len(written))


def test_what_exists_is_replaced_only_when_asked(tmp_path, simulated_drive):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    for overwrite in (False, True):
        with pytest.raises(OutputExistsError):
            simulate_drive(shipped_world(), tmp_path / "mine", TINY, overwrite=overwrite)
    assert (tmp_path / "mine" / "notes.txt").read_text() == "keep"
    with pytest.raises(OutputExistsError, match="--overwrite"):
        simulate_drive(shipped_world(), simulated_drive, TINY)


def test_a_drive_that_is_over_before_anything_is_seen_is_refused():
    settings = TINY.model_copy(update={"camera_hz": 0.05, "lidar_hz": 0.05, "speed_mps": 10.0})
    with pytest.raises(WorldError, match="no camera and no lidar sees anything"):
        plan_drive(read_world(shipped_world()), settings)


def test_names_of_the_log_do_not_depend_on_its_folder_and_hold_no_odd_characters():
    world = replace(read_world(shipped_world()), name="Straße / 1 ____ x")
    plan = plan_drive(world, TINY)
    assert plan.log_id == "Stra-e-1-x-5"


def test_images_alone_are_those_of_the_whole_drive(tmp_path):
    whole = simulate_drive(shipped_world(), tmp_path / "whole", TINY)
    settings = TINY.model_copy(update={"lidar": LidarPreset.NONE, "true_map": False})
    alone = simulate_drive(shipped_world(), tmp_path / "alone", settings)
    for folder in ("sensors/cameras", "truth/label_images"):
        assert bytes_of(alone / folder) == bytes_of(whole / folder)
    assert bytes_of(whole / "sensors" / "lidar")
    assert {p.name for p in (alone / "sensors").iterdir()} == {"cameras"}
    assert {p.name for p in (alone / "truth").iterdir()} == {
        "city_SE3_egovehicle.feather",
        "label_images",
        "simulation.json",
    }
    drive = read_av2(alone)
    assert len(drive.images) >= 1
    assert drive.sweeps == ()
    document = json.loads((alone / "truth" / "simulation.json").read_text())
    assert set(document["ego_SE3_sensor"]) == set(drive.cameras)


def test_no_image_and_no_lidar_is_refused(tmp_path):
    settings = TINY.model_copy(update={"lidar": LidarPreset.NONE, "camera_hz": 0.01})
    with pytest.raises(WorldError, match="no camera and no lidar"):
        simulate_drive(shipped_world(), tmp_path / "nothing", settings)


def test_cameras_ride_as_high_as_asked():
    world = read_world(shipped_world())
    low, high = (
        plan_drive(world, TINY.model_copy(update={"camera_height_m": height})).cameras[0]
        for height in (1.2, 2.4)
    )
    np.testing.assert_allclose(
        high.ego_SE3_cam.translation - low.ego_SE3_cam.translation, [0.0, 0.0, 1.2], atol=1e-12
    )
    np.testing.assert_array_equal(high.ego_SE3_cam.rotation, low.ego_SE3_cam.rotation)
