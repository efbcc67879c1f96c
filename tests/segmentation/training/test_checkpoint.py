"""A checkpoint is whole or it is not used."""

import hashlib
import io
import logging
import os

import pytest

torch = pytest.importorskip("torch")

from hdmap_tools.errors import CheckpointError  # noqa: E402
from hdmap_tools.segmentation.training.checkpoint import (  # noqa: E402
    CHECKPOINT,
    PREVIOUS,
    read_checkpoint,
    read_state,
    write_checkpoint,
    write_state,
)


def state(step):
    return {"step": step, "model": {"w": torch.arange(1000.0) * step}, "best": None}


@pytest.fixture
def run(tmp_path):
    for step in (1, 2, 3):
        write_checkpoint(tmp_path, state(step))
    return tmp_path


def test_the_newest_comes_back_and_the_one_before_is_kept(run):
    found = read_checkpoint(run)
    assert found["step"] == 3
    assert torch.equal(found["model"]["w"], state(3)["model"]["w"])
    assert read_state(run / PREVIOUS)["step"] == 2
    assert sorted(path.name for path in run.iterdir()) == [PREVIOUS, CHECKPOINT]


@pytest.mark.parametrize("kept", [0, 5, 20, 40, 1000, -1])
def test_a_truncated_one_is_left_for_the_one_before_with_a_warning(run, kept, caplog):
    content = (run / CHECKPOINT).read_bytes()
    (run / CHECKPOINT).write_bytes(content[:kept])
    with caplog.at_level(logging.WARNING, "hdmap_tools"):
        assert read_checkpoint(run)["step"] == 2
    (record,) = caplog.records
    assert str(run / CHECKPOINT) in record.message
    assert str(run / PREVIOUS) in record.message


@pytest.mark.parametrize("where", [10, 60, 500, -3])
def test_a_changed_byte_is_noticed(run, where):
    content = bytearray((run / CHECKPOINT).read_bytes())
    content[where] ^= 0x40
    (run / CHECKPOINT).write_bytes(content)
    with pytest.raises(CheckpointError, match="truncated or damaged"):
        read_state(run / CHECKPOINT)


def test_killed_between_the_two_renames_it_goes_on_from_the_one_before(run):
    os.replace(run / CHECKPOINT, run / PREVIOUS)
    assert read_checkpoint(run)["step"] == 3


def test_what_a_killed_writer_left_behind_is_overwritten(run):
    (run / f".{CHECKPOINT}.partial").write_bytes(b"half")
    write_checkpoint(run, state(4))
    assert read_checkpoint(run)["step"] == 4
    assert len(list(run.iterdir())) == 2


def test_none_that_is_whole_is_an_error_that_names_each(run):
    for name in (CHECKPOINT, PREVIOUS):
        (run / name).write_bytes((run / name).read_bytes()[:100])
    with pytest.raises(
        CheckpointError, match=r"no checkpoint to go on from.*checkpoint\.pt.*previous"
    ):
        read_checkpoint(run)


def test_an_empty_folder_has_none(tmp_path):
    with pytest.raises(CheckpointError, match="No such file"):
        read_checkpoint(tmp_path)


def test_a_file_of_something_else_is_named_so(tmp_path):
    torch.save(state(1), tmp_path / "other.pt")
    with pytest.raises(CheckpointError, match="no checkpoint of hdmap train"):
        read_state(tmp_path / "other.pt")


class _Evil:
    def __reduce__(self):
        return os.mkdir, ("evil",)


def test_a_checkpoint_from_elsewhere_runs_no_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    buffer = io.BytesIO()
    torch.save({"model": _Evil()}, buffer)
    payload = buffer.getvalue()
    (tmp_path / CHECKPOINT).write_bytes(b"HDMAPCK1" + hashlib.sha256(payload).digest() + payload)
    with pytest.raises(CheckpointError, match="cannot be loaded"):
        read_state(tmp_path / CHECKPOINT)
    assert not (tmp_path / "evil").exists()


def test_a_folder_that_is_gone_is_a_clear_error(tmp_path):
    with pytest.raises(CheckpointError, match="Cannot write"):
        write_state(tmp_path / "gone" / "best.pt", state(1))
