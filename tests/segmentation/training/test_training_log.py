"""The log goes on where the checkpoint is."""

import csv
import math
import sys

import pytest

from hdmap_tools.errors import FormatError
from hdmap_tools.segmentation.training.training_log import LOG_NAME, TrainingLog, read_log


@pytest.fixture(autouse=True)
def no_tensorboard(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)


def filled(run, steps, from_step=0):
    log = TrainingLog(run, ["step", "loss", "iou road"], from_step)
    for step in steps:
        log.add({"step": step, "loss": 1 / step, "iou road": math.nan})
    log.close()


def test_rows_are_written_as_they_come(tmp_path):
    filled(tmp_path, [3, 6])
    with (tmp_path / LOG_NAME).open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [["step", "loss", "iou road"], ["3", "0.333333", ""], ["6", "0.166667", ""]]


def test_rows_after_the_checkpoint_are_dropped(tmp_path):
    filled(tmp_path, [3, 6, 9])
    filled(tmp_path, [8], from_step=6)
    assert [row["step"] for row in read_log(tmp_path)] == ["3", "6", "8"]


def test_a_new_run_begins_a_new_log(tmp_path):
    filled(tmp_path, [3])
    filled(tmp_path, [1])
    assert [row["step"] for row in read_log(tmp_path)] == ["1"]


def test_another_file_of_that_name_is_refused(tmp_path):
    (tmp_path / LOG_NAME).write_text("time,what\n1,begin\n")
    with pytest.raises(FormatError, match="no log of a training"):
        read_log(tmp_path)
