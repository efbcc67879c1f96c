"""`hdmap train` from a drive to one file that segments it, and what it refuses."""

import json
import sys

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torchvision")
pytest.importorskip("segmentation_models_pytorch")

from hdmap_tools.cli.main import main  # noqa: E402
from hdmap_tools.segmentation.embedded import read_embedded  # noqa: E402
from hdmap_tools.segmentation.training.training_log import read_log  # noqa: E402


@pytest.fixture(autouse=True)
def no_tensorboard(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)


def hdmap(*arguments):
    with pytest.raises(SystemExit) as exit_info:
        main([str(a) for a in arguments])
    return exit_info.value.code


QUICK = ("--batch", 4, "--crop", 64, "--threads", 1, "-q")


def test_from_a_drive_to_a_file_that_is_enough(simulated_drive, tmp_path, capsys):
    run, model = tmp_path / "run", tmp_path / "tiny.onnx"
    data = f"drive:{simulated_drive}"
    begun = hdmap(
        "train", data, "--val", data, "-o", run, "--label-set", "street", "--epochs", 2, *QUICK
    )
    said = capsys.readouterr()
    assert begun == 0, said.err
    assert "mIoU" in said.out
    settings = json.loads((run / "run.json").read_text())
    assert settings["data"] == [data]
    assert settings["label_set"]["name"] == "street"
    assert settings["preset"]["augmentation"]["crop_px"] == 64
    assert len(read_log(run)) == 1

    assert hdmap("train", "--resume", "-o", run, "-q") == 0
    assert hdmap("train", "--export", run, model) == 0
    assert "MB" in capsys.readouterr().out
    assert read_embedded(model).label_set.name == "street"
    assert read_embedded(model).profile.name == "tiny"
    out = tmp_path / "labels"
    assert hdmap("segment", simulated_drive, "-o", out, "--model", model, "--no-cache", "-q") == 0
    assert list(out.rglob("*.png"))


def test_an_older_run_is_kept_unless_told_otherwise(simulated_drive, tmp_path, capsys):
    run = tmp_path / "run"
    command = ("train", simulated_drive, "-o", run, "--epochs", 1, *QUICK)
    assert hdmap(*command) == 0
    before = (run / "checkpoint.pt").read_bytes()
    assert hdmap(*command) == 1
    assert "--resume" in capsys.readouterr().err
    assert (run / "checkpoint.pt").read_bytes() == before
    assert hdmap(*command, "--overwrite", "--seed", 3) == 0
    assert (run / "checkpoint.pt").read_bytes() != before


def test_a_folder_of_something_else_is_left_alone(simulated_drive, tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    command = ("train", simulated_drive, "-o", tmp_path / "mine", "--overwrite", *QUICK)
    assert hdmap(*command) == 1
    assert "no run of hdmap train" in capsys.readouterr().err
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("-o", "run"), 2, "Give DATA"),
        (("drive:x",), 2, "--out"),
        (("drive:none", "-o", "run"), 1, "none"),
        (("tape:none", "-o", "run"), 1, "'tape' is unknown"),
        (("--resume", "-o", "run"), 1, "no run of hdmap train"),
        (("x", "--resume", "-o", "run"), 2, "run's own settings"),
        (("--export", "run", "x.onnx"), 1, "no run of hdmap train"),
        (("x", "--export", "run", "x.onnx"), 2, "--export goes with"),
        (("x", "-o", "run", "--name", "n"), 2, "--name goes with --export"),
    ],
)
def test_bad_usage_is_one_clear_line(arguments, code, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert hdmap("train", *arguments) == code
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_preset_is_named(simulated_drive, tmp_path, capsys):
    command = ("train", simulated_drive, "-o", tmp_path / "run", "--preset", "huge")
    assert hdmap(*command) == 1
    assert "'huge'; there are paz2020, small" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
