"""The recorded drives: known counts, known alignment, and how their sweeps were made."""

import json
from pathlib import Path

import numpy as np
import pyarrow.feather
import pytest

from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.av2 import read_av2
from hdmap_tools.readers.drive import Drive, SweepRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.readers.motion import compensate_ego_motion, undo_ego_motion_compensation
from hdmap_tools.readers.open_drive import open_drive

pytestmark = pytest.mark.realdata

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
LOG_WITHOUT_SENSORS = "3bffdcff-c3a7-38b6-a0f2-64196d130958"


@pytest.fixture(scope="module")
def nuscenes(data_root: Path) -> Drive:
    return open_drive(data_root / "nuscenes")


@pytest.fixture(scope="module")
def av2(data_root: Path) -> Drive:
    return open_drive(data_root / "av2", scene=LOG)


def test_the_nuscenes_keyframe(nuscenes: Drive) -> None:
    assert nuscenes.id == "nuscenes:scene-keyframe"
    assert nuscenes.warnings == ()
    assert len(nuscenes.cameras) == 6
    assert len(nuscenes.images) == 6
    assert [path.name for path in nuscenes.reference_maps] == ["drivable_mask.png"]
    sweep = nuscenes.read_sweep(nuscenes.sweeps[0])
    assert len(sweep.points_ego) == 34_688
    assert set(np.unique(sweep.ring)) == set(range(32))
    assert sweep.intensity.max() == 255
    for ref in nuscenes.images:
        assert read_image(ref, nuscenes.cameras[ref.camera]).shape == (900, 1600, 3)


def test_an_image_is_met_by_exactly_its_own_pose(nuscenes: Drive) -> None:
    folder = nuscenes.root / "v1.0-mini"
    poses = {r["token"]: r for r in json.loads((folder / "ego_pose.json").read_text())}
    rows = json.loads((folder / "sample_data.json").read_text())
    own = {nuscenes.root / r["filename"]: poses[r["ego_pose_token"]] for r in rows}
    assert len({ref.timestamp_ns for ref in nuscenes.images}) == 6
    for ref in nuscenes.images:
        row = own[ref.path]
        found = nuscenes.trajectory.interpolate(ref.timestamp_ns)
        truth = SE3.from_quaternion(*row["rotation"], np.array(row["translation"]))
        np.testing.assert_array_equal(found.translation, truth.translation)
        np.testing.assert_allclose(found.rotation, truth.rotation, rtol=0, atol=1e-15)


def test_lidar_points_lie_on_the_map_and_on_the_ground(nuscenes: Drive) -> None:
    """Figures of the data's own description: 0.83 near the ground, 0.08 above 2 m."""
    import cv2

    mask = cv2.imread(str(nuscenes.reference_maps[0]), cv2.IMREAD_GRAYSCALE)
    x0, y0 = json.loads(nuscenes.reference_maps[0].with_suffix(".json").read_text())["origin_xy_m"]
    sweep = nuscenes.read_sweep(nuscenes.sweeps[0])
    distance = np.linalg.norm(sweep.points_ego[:, :2], axis=1)
    points = nuscenes.trajectory.interpolate(sweep.timestamp_ns).transform_from(
        sweep.points_ego[(distance > 2.5) & (distance < 40)]
    )

    def share_on_mask(selected: np.ndarray) -> float:
        rows = np.floor((y0 + 200 - selected[:, 1]) * 10).astype(int)
        cols = np.floor((selected[:, 0] - x0) * 10).astype(int)
        return float((mask[rows, cols] > 0).mean())

    near_ground = points[np.abs(points[:, 2]) < 0.15]  # lower than a kerb is high
    assert share_on_mask(near_ground) > 0.8
    assert share_on_mask(points[points[:, 2] > 2.0]) < 0.1
    assert share_on_mask(near_ground + (15.0, 0.0, 0.0)) < 0.1  # off the road, the mask says no


def test_the_av2_log(av2: Drive, data_root: Path) -> None:
    assert av2.warnings == ()
    assert len(av2.trajectory) == 2706
    assert len(av2.cameras) == 9
    assert av2.images == ()
    assert [len(av2.read_sweep(ref).points_ego) for ref in av2.sweeps] == [99_229, 99_466]
    assert [path.suffix for path in av2.reference_maps] == [".json"]

    bare = open_drive(data_root / "av2" / LOG_WITHOUT_SENSORS)
    assert (len(bare.cameras), len(bare.images), len(bare.sweeps)) == (0, 0, 0)
    assert len(bare.trajectory) > 2000
    bare.frame.require_same(av2.frame)
    # Both logs are in Pittsburgh, on one street.
    lon, lat = av2.frame.to_wgs84(av2.trajectory.translations[:1])[0, :2]
    assert (round(lon, 1), round(lat, 1)) == (-80.0, 40.5)


def test_the_av2_sweeps_read_as_the_data_sets_own_package_does(av2: Drive) -> None:
    pytest.importorskip("av2", reason="av2 has no wheel for this Python")
    from av2.structures.sweep import Sweep as TheirSweep

    for ref in av2.sweeps:
        theirs = TheirSweep.from_feather(ref.path)
        np.testing.assert_array_equal(av2.read_sweep(ref).points_ego, theirs.xyz)


def test_av2_points_lie_on_the_ground_raster(av2: Drive) -> None:
    folder = av2.root / "map"
    height = np.load(next(folder.glob("*.npy")))
    placement = json.loads(next(folder.glob("*Sim2*.json")).read_text())

    def heights_above_ground_m(ref: SweepRef, pose_time_ns: int) -> np.ndarray:
        points = av2.read_sweep(ref).points_ego
        city = av2.trajectory.interpolate(pose_time_ns).transform_from(points)
        cols, rows = np.floor((city[:, :2] + placement["t"]) * placement["s"]).astype(int).T
        inside = (rows >= 0) & (cols >= 0) & (rows < height.shape[0]) & (cols < height.shape[1])
        ground = np.full(len(city), np.nan)
        ground[inside] = height[rows[inside], cols[inside]]
        return city[:, 2] - ground

    for ref in av2.sweeps:
        above = heights_above_ground_m(ref, ref.timestamp_ns)
        assert np.isfinite(above).mean() >= 0.97
        near = np.linalg.norm(av2.read_sweep(ref).points_ego[:, :2], axis=1) < 30
        assert (above[near] < -0.3).mean() < 0.001  # nothing is seen below the ground
        assert abs(np.median(above[near & (np.abs(above) < 0.3)])) < 0.02
        displaced = heights_above_ground_m(ref, ref.timestamp_ns - 6_000_000_000)
        assert (displaced[near] < -0.3).mean() > 0.02


def elevation_spread_deg(points_ego: np.ndarray, lasers: np.ndarray, ego_SE3_lidar: SE3) -> float:
    """Median over lasers of the robust spread of elevation seen from the lidar."""
    seen = ego_SE3_lidar.inverse().transform_from(points_ego)
    distance = np.linalg.norm(seen, axis=1)
    elevation = np.degrees(np.arcsin(seen[:, 2] / distance))
    spreads = []
    for laser in np.unique(lasers):
        own = elevation[(lasers == laser) & (distance > 4) & (distance < 40)]
        if len(own) >= 200:
            spreads.append(1.4826 * np.median(np.abs(own - np.median(own))))
    assert len(spreads) > 10
    return float(np.median(spreads))


def test_av2_sweeps_are_published_compensated(av2: Drive) -> None:
    """A laser draws a cone around its own lidar: only where the motion is undone."""
    mounts = pyarrow.feather.read_table(
        av2.root / "calibration" / "egovehicle_SE3_sensor.feather", memory_map=False
    ).to_pylist()
    for ref in av2.sweeps:
        sweep = av2.read_sweep(ref)
        table = pyarrow.feather.read_table(ref.path, memory_map=False)
        offsets = table["offset_ns"].to_numpy()
        for name, lasers in (("up_lidar", range(32)), ("down_lidar", range(32, 64))):
            row = next(m for m in mounts if m["sensor_name"] == name)
            mount = SE3.from_quaternion(
                *(row[k] for k in ("qw", "qx", "qy", "qz")),
                np.array([row[k] for k in ("tx_m", "ty_m", "tz_m")]),
            )
            own = np.isin(sweep.ring, lasers)
            points, times, ring = sweep.points_ego[own], offsets[own], sweep.ring[own]
            motion = (times, ref.timestamp_ns, av2.trajectory)
            stored = elevation_spread_deg(points, ring, mount)
            undone = elevation_spread_deg(
                undo_ego_motion_compensation(points, *motion), ring, mount
            )
            again = elevation_spread_deg(compensate_ego_motion(points, *motion), ring, mount)
            assert undone < 0.006
            assert stored > 6 * undone
            assert again > 12 * undone


def test_compensating_again_would_move_the_points(av2: Drive) -> None:
    once_more = read_av2(av2.root, is_compensated=False)
    ref = av2.sweeps[0]
    moved = once_more.read_sweep(ref).points_ego - av2.read_sweep(ref).points_ego
    assert 0.05 < np.percentile(np.linalg.norm(moved, axis=1), 95) < 1.0
    assert isinstance(once_more.trajectory, Trajectory)
