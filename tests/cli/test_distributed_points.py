"""`hdmap points` over workers: the same files, and its options are those of `hdmap build`."""

import socket

import pytest

pytest.importorskip("distributed", reason="needs the extra `distributed`")

POINTS = ("points", "drive", "--no-refine-poses")


def files(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_workers_make_the_same_point_map_and_leave_nothing_else(street, hdmap):
    code, _, err = hdmap(*POINTS, "-o", "whole")
    assert code == 0, err
    code, out, err = hdmap(*POINTS, "-o", "points", "--workers", "2", "--worker-memory", "2GB")
    assert code == 0, err
    assert "nuscenes:scene-0001: poses as given" in out
    assert files(street / "points") == files(street / "whole")
    assert not [path for path in street.iterdir() if path.name.startswith(".")]


def test_a_scheduler_that_is_not_there(street, fails, monkeypatch):
    from hdmap_tools.distributed import cluster

    monkeypatch.setattr(cluster, "_ANSWERS_WITHIN_S", 1.0)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        fails(*POINTS, "-o", "points", "--scheduler", address, says=(address, "--workers"))
    assert not (street / "points").exists()


@pytest.mark.parametrize(
    ("arguments", "says", "code"),
    [
        (("--workers", "1", "--scheduler", "tcp://x:1"), "not both", 2),
        (("--worker-memory", "2GB"), "--worker-memory needs --workers", 2),
        (("--workers", "1", "--worker-memory", "much"), "2GB", 2),
        (("--workers", "0"), "--workers", 2),
    ],
)
@pytest.mark.parametrize("command", ["points", "build"])
def test_options_that_do_not_go_together(street, fails, command, arguments, says, code):
    fails(command, "drive", "-o", "points", *arguments, says=(says,), code=code)
    assert not (street / "points").exists()


def test_a_point_cloud_needs_no_workers(street, fails):
    arguments = ("cloud.pcd", "-o", "points", "--workers", "2")
    fails("points", *arguments, says=("cloud.pcd", "one process", "--workers"))


@pytest.mark.slow
def test_workers_without_enough_memory(street, fails):
    arguments = (*POINTS, "-o", "points", "--workers", 1, "--worker-memory", "150MB")
    fails(*arguments, says=("Workers died again and again", "memory", "Nothing was written"))
    assert not [p.name for p in street.iterdir() if p.name not in ("drive", "labels", "cache")]
