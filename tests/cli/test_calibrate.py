"""`hdmap calibrate` from files to files."""

import json
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from hdmap_tools.calibration.calibration_files import (
    Calibration,
    read_calibration,
    write_calibration,
)
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.open_drive import open_drive

FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MOUNT = SE3(FORWARD, np.array([1.5, 0.1, 1.6]))
CAMERA = PinholeCamera(
    "CAM", 960, 600, 800.0, 801.0, 481.0, 301.0, MOUNT, (-0.1, 0.02, 5e-4, -4e-4, 0)
)


class Done(NamedTuple):
    """What a command line came to."""

    code: int
    out: str
    err: str


@pytest.fixture
def cli(hdmap):
    return lambda *arguments: Done(*hdmap(*arguments))


def board_photo(tilt_x, tilt_y, shift):
    """A photo by a plain warp: what is found in it matters here, not how exactly."""
    squares = np.kron((np.indices((7, 10)).sum(axis=0) + 1) % 2, np.ones((40, 40)))
    paper = np.pad(squares * 200 + 30, 40, constant_values=230).astype(np.uint8)
    height, width = paper.shape
    centred = np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1.0]])
    turn, _ = cv2.Rodrigues(np.array([tilt_x, tilt_y, 0.1]))
    pose = np.column_stack([turn[:, :2], [*shift, 600.0]])
    matrix = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]) @ pose @ centred
    return cv2.warpPerspective(paper, matrix, (640, 480), borderValue=110, flags=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    tilts = [(0.5, 0.1), (-0.5, 0.2), (0.1, 0.5), (0.2, -0.5), (0.4, 0.4), (-0.4, -0.3)]
    for k, (x, y) in enumerate(tilts):
        shift = (30.0 * (k % 3 - 1), 20.0 * (k % 2))
        cv2.imwrite(str(folder / f"{k}.png"), board_photo(x, y, shift))
    return folder


def test_intrinsics_of_a_folder_of_photos(cli, photos, tmp_path):
    out = tmp_path / "lens"
    args = ("calibrate", "intrinsics", photos, "--board", "9x6", "--square-m", 0.1, "-o", out)
    done = cli(*args, "--name", "CAM")
    assert done.code == 0, done.err
    assert "CAM: 6 views" in done.out
    assert "only 6 views" in done.err
    report = json.loads((out / "report.json").read_text())
    assert report["camera"]["fx_px"] == pytest.approx(700, rel=0.02)
    assert report["num_views"] == 6
    names = [view["image"].rsplit("/", 1)[-1] for view in report["views"]]
    assert names == [f"{k}.png" for k in range(6)]
    camera = read_calibration(out).cameras["CAM"]
    assert camera.fx == report["camera"]["fx_px"]
    assert camera.distortion[4] == report["camera"]["distortion"]["k3"]
    picture = cv2.imread(str(out / "coverage.png"))
    assert picture is not None
    assert picture.shape[1] > 640
    # The same again: refused, then replaced by the same bytes.
    first = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    assert cli(*args, "--name", "CAM").code == 1
    assert cli(*args, "--name", "CAM", "--overwrite").code == 0
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == first


def refused(done, *words):
    assert done.code == 1
    errors = [line for line in done.err.splitlines() if line.startswith("Error: ")]
    assert len(errors) == 1, done.err
    for word in words:
        assert word in errors[0], errors[0]


def test_photos_that_cannot_be_used(cli, photos, tmp_path):
    def run(*images, board="9x6"):
        return cli(
            "calibrate",
            "intrinsics",
            *images,
            "--board",
            board,
            "--square-m",
            0.1,
            "-o",
            tmp_path / "o",
        )

    refused(run(photos, board="10x7"), "No picture of 6 shows", "10x7 inner corners", "0.png")
    refused(run(photos, board="nine"), "9x6")
    refused(run(tmp_path / "none"), "does not exist")
    (tmp_path / "empty").mkdir()
    refused(run(tmp_path / "empty"), "holds no pictures")
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), np.zeros((480, 641), np.uint8))
    refused(run(photos, other), "several sizes", "640x480", "641x480")
    refused(run(photos / "0.png", photos / "1.png"), "2 views show the board")
    cut = tmp_path / "cut.png"
    cut.write_bytes((photos / "0.png").read_bytes()[:900])
    refused(run(cut), "damaged")
    (tmp_path / "text.png").write_text("no picture")
    refused(run(tmp_path / "text.png"), "does not decode")
    assert not (tmp_path / "o").exists()


def test_copies_of_a_photo_count_once(cli, photos, tmp_path):
    copy = tmp_path / "copy.png"
    copy.write_bytes((photos / "0.png").read_bytes())
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((480, 640), 99, np.uint8))
    out = tmp_path / "lens"
    args = ("calibrate", "intrinsics", photos, copy, blank, "--board", "9x6", "--square-m", 0.1)
    done = cli(*args, "-o", out)
    assert done.code == 0, done.err
    report = json.loads((out / "report.json").read_text())
    assert report["num_views"] == 6
    assert report["repeated_images"] == [str(copy)]
    assert report["images_without_board"] == [str(blank)]
    assert "no board found in 1 images" in done.out


def write_pairs(path, points, uv):
    rows = np.column_stack([points, uv])
    np.savetxt(path, rows, delimiter=",", header="x_m,y_m,z_m,u_px,v_px", comments="", fmt="%.9f")


def pairs_of(camera, count=30, wrong=6):
    rng = np.random.default_rng(0)
    uv = rng.uniform((10, 10), (camera.width_px - 10, camera.height_px - 10), (count, 2))
    points = camera.ego_SE3_cam.translation + camera.rays_ego(uv) * rng.uniform(4, 25, (count, 1))
    uv += rng.normal(0, 0.3, uv.shape)
    uv[:wrong] = uv[:wrong][::-1]
    return points, uv


def test_extrinsics_in_the_frame_of_the_lidar_keep_the_other_sensors(cli, tmp_path):
    lidar = SE3(FORWARD.T, np.array([0.4, -0.3, 1.9]))
    start = Calibration({"CAM": replace(CAMERA, ego_SE3_cam=SE3.identity())}, {"up_lidar": lidar})
    write_calibration(tmp_path / "lens", start)
    points, uv = pairs_of(CAMERA)
    write_pairs(tmp_path / "pairs.csv", lidar.inverse().transform_from(points), uv)
    out = tmp_path / "mount"
    args = (
        "calibrate",
        "extrinsics",
        tmp_path / "pairs.csv",
        "--camera",
        tmp_path / "lens",
        "-o",
        out,
    )
    done = cli(*args, "--lidar", "up_lidar")
    assert done.code == 0, done.err
    assert "24 of 30 pairs agree" in done.out
    found = read_calibration(out)
    np.testing.assert_allclose(found.cameras["CAM"].ego_SE3_cam.matrix, MOUNT.matrix, atol=0.01)
    np.testing.assert_array_equal(found.mounts["up_lidar"].translation, lidar.translation)
    report = json.loads((out / "report.json").read_text())
    assert [entry["line"] for entry in report["left_out"]] == [2, 3, 4, 5, 6, 7]
    assert np.array(report["covariance"]).shape == (6, 6)
    assert report["points_frame"] == "up_lidar"
    refused(
        cli(*args, "--lidar", "down_lidar", "--overwrite"), "no mount of 'down_lidar'", "up_lidar"
    )
    refused(cli(*args, "--name", "REAR", "--overwrite"), "no camera 'REAR'", "CAM")


def test_pairs_that_cannot_be_used(cli, tmp_path):
    write_calibration(tmp_path / "lens", Calibration({"CAM": CAMERA}))
    path = tmp_path / "pairs.csv"

    def run():
        return cli(
            "calibrate", "extrinsics", path, "--camera", tmp_path / "lens", "-o", tmp_path / "o"
        )

    refused(run(), "cannot be read")
    points, uv = pairs_of(CAMERA, wrong=0)
    write_pairs(path, points[:3], uv[:3])
    refused(run(), "3 pairs; expected at least 6")
    path.write_text("x_m,y_m,z_m,u_px,v_px\n1,2,nan,3,4\n")
    refused(run(), "line 2: z_m is 'nan'")
    write_pairs(path, points * (1, -1, 1), uv)
    refused(run(), "left-handed")
    assert not (tmp_path / "o").exists()


def test_check_draws_the_sweep_of_a_drive(cli, simulated_drive, tmp_path):
    out = tmp_path / "check.png"
    done = cli("calibrate", "check", simulated_drive, "-o", out)
    assert done.code == 0, done.err
    drive = open_drive(simulated_drive)
    image = drive.images[0]
    picture = cv2.imread(str(out))
    plain = cv2.imread(str(image.path))
    assert picture.shape[0] > plain.shape[0]
    assert (picture[: plain.shape[0]] != plain).any(axis=2).mean() > 0.02
    refused(cli("calibrate", "check", simulated_drive, "-o", out), "exists")
    refused(
        cli("calibrate", "check", simulated_drive, "-o", out, "--index", 99, "--overwrite"),
        "there is no image 99",
    )


def test_check_with_another_calibration_draws_elsewhere(cli, simulated_drive, tmp_path):
    known = read_calibration(simulated_drive)
    camera = next(iter(known.cameras.values()))
    turned = replace(camera, ego_SE3_cam=camera.ego_SE3_cam @ SE3.from_yaw(0.1))
    write_calibration(tmp_path / "turned", known.with_camera(turned, is_mounted=True))
    write_calibration(tmp_path / "lens", Calibration({camera.name: camera}))
    pictures = []
    for k, given in enumerate(((), ("--calibration", tmp_path / "turned"))):
        out = tmp_path / f"{k}.png"
        assert cli("calibrate", "check", simulated_drive, "-o", out, *given).code == 0
        pictures.append(cv2.imread(str(out)))
    assert (pictures[0] != pictures[1]).any()
    args = ("calibrate", "check", simulated_drive, "-o", tmp_path / "2.png")
    refused(cli(*args, "--calibration", tmp_path / "lens"), "no mount of camera")


def test_check_without_a_drive(cli, tmp_path):
    write_calibration(tmp_path / "mount", Calibration({}).with_camera(CAMERA, is_mounted=True))
    cv2.imwrite(str(tmp_path / "a.png"), np.full((600, 960, 3), 128, np.uint8))
    points, _ = pairs_of(CAMERA)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + ["end_header"]
    lines += [" ".join(f"{v:.6f}" for v in point) for point in points]
    (tmp_path / "a.ply").write_text("\n".join(lines) + "\n")
    args = ("calibrate", "check", "--image", tmp_path / "a.png", "-o", tmp_path / "o.png")
    done = cli(*args, "--points", tmp_path / "a.ply", "--calibration", tmp_path / "mount")
    assert done.code == 0, done.err
    assert "CAM: 30 of 30 points drawn" in done.out
    assert cli(*args).code == 2
    assert cli("calibrate", "check", "-o", tmp_path / "p.png").code == 2


def test_help_of_each_part_starts_with_examples(cli):
    for part in ("intrinsics", "extrinsics", "check"):
        done = cli("calibrate", part, "--help")
        assert done.code == 0
        assert done.out.split("Options:")[0].count(f"hdmap calibrate {part}") >= 2
