"""Builds spread over processes: the same counts, whoever dies on the way."""

import signal
import socket

import pytest

from hdmap_tools.distributed.cluster import Workers, connected
from hdmap_tools.fusion.semantic_map import SemanticMap

from .conftest import LABELS

pytest.importorskip("distributed", reason="needs the extra `distributed`")
psutil = pytest.importorskip("psutil")

SEGMENTS = ("--set", "fusion.images_per_segment=1")
BUILD = ("build", "drive", *LABELS, *SEGMENTS)


@pytest.fixture
def whole(street, hdmap):
    """The map of a build in one process."""
    code, _, err = hdmap(*BUILD, "-o", "whole")
    assert code == 0, err
    return SemanticMap.open(street / "whole")


def test_workers_make_the_same_map(street, hdmap, whole):
    code, out, err = hdmap(*BUILD, "-o", "map", "--workers", "2")
    assert code == 0, err
    assert "3 images" in out
    made = SemanticMap.open(street / "map")
    assert made.read().equals(whole.read())
    assert made.drives == whole.drives
    (drive_id,) = made.drives
    assert made.segments_of(drive_id) == whole.segments_of(drive_id) == {0, 1, 2}


def test_a_worker_that_dies_is_replaced(street, hdmap, whole, monkeypatch):
    """Killed when it holds counts that are to be written: they must be made again."""
    original, killed = SemanticMap.add_by_workers, []

    def killing(self, *arguments, **more):
        if not killed:
            worker = max(
                psutil.Process().children(recursive=True), key=lambda p: p.memory_info().rss
            )
            killed.append(worker.pid)
            worker.send_signal(signal.SIGKILL)
        return original(self, *arguments, **more)

    monkeypatch.setattr(SemanticMap, "add_by_workers", killing)
    code, _, err = hdmap(*BUILD, "-o", "map", "--workers", "2")
    assert code == 0, err
    assert killed
    made = SemanticMap.open(street / "map")
    assert made.read().equals(whole.read())
    assert made.drives == whole.drives


def test_an_error_of_a_worker_is_told_as_if_it_were_ours(street, hdmap, fails):
    labels = sorted((street / "labels").rglob("*.png"))
    labels[-1].write_bytes(b"")
    fails(*BUILD, "-o", "map", "--workers", "1", says=(labels[-1].name,))
    assert not (street / "map").exists()


def test_a_scheduler_that_is_not_there(street, fails, monkeypatch):
    from hdmap_tools.distributed import cluster

    monkeypatch.setattr(cluster, "_ANSWERS_WITHIN_S", 1.0)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        fails(*BUILD, "-o", "map", "--scheduler", address, says=(address, "--workers"))


def test_workers_and_a_scheduler_at_once(street, fails):
    fails(
        *BUILD,
        "-o",
        "map",
        "--workers",
        "1",
        "--scheduler",
        "tcp://x:1",
        says=("not both",),
        code=2,
    )


@pytest.mark.slow
def test_a_worker_without_enough_memory(street, hdmap, fails, whole):
    arguments = (*BUILD, "-o", "map", "--workers", 1, "--worker-memory", "170MB")
    fails(*arguments, says=("Workers died again and again", "memory", "is kept"))
    assert not (street / "map").exists()
    code, _, err = hdmap(*BUILD, "-o", "map")
    assert code == 0, err
    assert SemanticMap.open(street / "map").read().equals(whole.read())


def test_two_clusters_on_one_machine_do_not_meet():
    # The second would be told that the port of the first one's pages is taken; and all is for this machine alone.
    with connected(Workers(1)) as one, connected(Workers(1)) as other:
        assert one.submit(abs, -1).result() == other.submit(abs, -1).result() == 1
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        addresses = {
            listening.laddr.ip
            for process in processes
            for listening in process.net_connections()
            if listening.status == psutil.CONN_LISTEN
        }
    assert addresses == {"127.0.0.1"}
