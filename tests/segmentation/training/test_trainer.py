"""Training learns, says so, and ends the same whether it was interrupted or not."""

import itertools
import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from hdmap_tools.errors import CheckpointError, ConfigError, LabelError  # noqa: E402
from hdmap_tools.segmentation.confusion import ConfusionMatrix  # noqa: E402
from hdmap_tools.segmentation.training.checkpoint import (  # noqa: E402
    BEST,
    CHECKPOINT,
    read_checkpoint,
    read_state,
)
from hdmap_tools.segmentation.training.presets import AdamW  # noqa: E402
from hdmap_tools.segmentation.training.trainer import CONFUSION_NAME, train  # noqa: E402
from hdmap_tools.segmentation.training.training_log import read_log  # noqa: E402
from hdmap_tools.segmentation.training.validation import mean_iou  # noqa: E402

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def no_tensorboard(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)


def weights(run):
    return read_checkpoint(run)["model"]


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_it_learns_the_toy_world(tmp_path, toy_pairs, toy_run_settings):
    told, progress = [], []
    settings = toy_run_settings(epochs=40)
    train(
        tmp_path / "run",
        toy_pairs(8),
        toy_pairs(4, first=100),
        settings,
        told=told.append,
        stepped=progress.append,
    )
    assert told[-1]["step"] == 80 == settings.total_steps == len(progress)
    assert progress == sorted(progress)
    assert progress[-1] == 1
    assert told[-1]["loss"] < 0.3 * told[0]["loss"]
    confusion = ConfusionMatrix.load(tmp_path / "run" / CONFUSION_NAME)
    assert mean_iou(confusion) > 0.85  # on images that it never saw
    assert confusion.counts.sum() == 4 * 46 * 64
    best = read_state(tmp_path / "run" / BEST)
    assert ConfusionMatrix.from_json(best["confusion"]) == confusion
    rows = read_log(tmp_path / "run")
    assert [int(row["step"]) for row in rows] == [row["step"] for row in told]
    # Moving the scores of the labels in the end may only help.
    assert mean_iou(confusion) >= max(float(row["miou"]) for row in rows) - 1e-5


def test_the_same_seed_gives_the_same_weights_and_another_others(
    tmp_path, toy_pairs, toy_run_settings
):
    for name, seed, workers in (("a", 0, 0), ("b", 0, 2), ("c", 1, 0)):
        settings = toy_run_settings(epochs=3, seed=seed)
        train(tmp_path / name, toy_pairs(8), None, settings, workers=workers)
    a, b, c = (weights(tmp_path / name) for name in "abc")
    assert same(a, b)
    assert not same(a, c)


def test_the_mean_of_the_last_weights_is_judged_and_kept(tmp_path, toy_pairs, toy_run_settings):
    run, seen = tmp_path / "run", []
    settings = toy_run_settings(epochs=15)
    preset = settings.preset.model_copy(update={"averaged_steps": 4, "fits_offsets": False})
    settings = settings.model_copy(update={"preset": preset})

    def look(_):
        if (run / CHECKPOINT).exists():  # of the step before
            seen.append(weights(run))

    train(run, toy_pairs(8), None, settings, checkpoint_every_s=0, stepped=look)
    steps = [*seen, weights(run)]
    assert len(steps) == settings.total_steps == 30
    mean = dict(steps[0])
    for number, now in enumerate(steps[1:], 1):
        share = max(1 / 4, 9 / (9 + number))
        mean = {
            name: value + share * (now[name] - value) if value.is_floating_point() else now[name]
            for name, value in mean.items()
        }
    kept = read_state(run / BEST)["model"]
    for name, value in mean.items():
        torch.testing.assert_close(kept[name], value, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(kept["stage1.0.weight"], steps[-1]["stage1.0.weight"], atol=1e-5)


class _StopError(Exception):
    pass


def stop_after(number):
    count = itertools.count(1)

    def stepped(_):
        if next(count) == number:
            raise _StopError

    return stepped


@pytest.mark.parametrize("broken", [False, True], ids=["whole", "newest truncated"])
def test_going_on_ends_where_an_uninterrupted_run_ends(
    tmp_path, toy_pairs, toy_run_settings, broken
):
    settings = toy_run_settings(epochs=6)
    train(tmp_path / "whole", toy_pairs(8), toy_pairs(2, 50), settings)
    with pytest.raises(_StopError):
        train(
            tmp_path / "cut",
            toy_pairs(8),
            toy_pairs(2, 50),
            settings,
            checkpoint_every_s=0,
            stepped=stop_after(8),
        )
    assert read_checkpoint(tmp_path / "cut")["step"] == 7
    if broken:
        newest = tmp_path / "cut" / CHECKPOINT
        newest.write_bytes(newest.read_bytes()[:-100])
    train(tmp_path / "cut", toy_pairs(8), toy_pairs(2, 50), settings, resume=True)
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "cut"))
    a, b = (read_log(tmp_path / name) for name in ("whole", "cut"))
    for row in (*a, *b):
        del row["minutes"]
    assert [{**row, "loss": ""} for row in a] == [{**row, "loss": ""} for row in b]
    assert (tmp_path / "whole" / CONFUSION_NAME).read_text() == (
        tmp_path / "cut" / CONFUSION_NAME
    ).read_text()


def test_a_finished_run_that_goes_on_changes_nothing(tmp_path, toy_pairs, toy_run_settings):
    settings = toy_run_settings(epochs=2)
    train(tmp_path / "run", toy_pairs(8), toy_pairs(2, 50), settings)
    before = weights(tmp_path / "run")
    confusion = (tmp_path / "run" / CONFUSION_NAME).read_text()
    train(tmp_path / "run", toy_pairs(8), toy_pairs(2, 50), settings, resume=True)
    assert same(before, weights(tmp_path / "run"))
    assert (tmp_path / "run" / CONFUSION_NAME).read_text() == confusion


def test_other_settings_are_refused_by_name(tmp_path, toy_pairs, toy_run_settings):
    train(tmp_path / "run", toy_pairs(8), None, toy_run_settings(epochs=1))
    with pytest.raises(CheckpointError, match=r"other settings: seed was 0, is 5"):
        train(tmp_path / "run", toy_pairs(8), None, toy_run_settings(epochs=1, seed=5), resume=True)
    changed = toy_run_settings(epochs=1, preset={"batch": 2})
    with pytest.raises(CheckpointError, match=r"batch was 4, is 2"):
        train(tmp_path / "run", toy_pairs(8), None, changed, resume=True)


def test_there_must_be_something_to_go_on_from(tmp_path, toy_pairs, toy_run_settings):
    with pytest.raises(CheckpointError, match="no run of hdmap train"):
        train(tmp_path / "none", toy_pairs(8), None, toy_run_settings(), resume=True)


def test_pairs_of_other_labels_are_refused(tmp_path, toy_pairs, toy_run_settings):
    from hdmap_tools.labels.label_set import load_label_set

    with pytest.raises(LabelError, match=r"'toy'.*shall learn 'street'"):
        train(
            tmp_path / "run",
            toy_pairs(8),
            None,
            toy_run_settings(label_set=load_label_set("street")),
        )


def test_a_rate_that_bursts_the_weights_is_an_error(tmp_path, toy_pairs, toy_run_settings):
    settings = toy_run_settings(preset={"optimizer": AdamW(learning_rate=1e30, warm_up=0.01)})
    with pytest.raises(ConfigError, match=r"loss is (nan|inf).*lower --learning-rate"):
        train(tmp_path / "run", toy_pairs(8), None, settings)


def test_a_batch_without_a_labelled_pixel_teaches_nothing_wrong(
    tmp_path, toy_pairs, toy_run_settings
):
    class Blank(toy_pairs):
        def read(self, index):
            rgb, ids = super().read(index)
            return rgb, np.full_like(ids, 255)

    train(tmp_path / "run", Blank(8), None, toy_run_settings(epochs=1))
    assert all(torch.isfinite(w).all() for w in weights(tmp_path / "run").values())


def test_a_time_limit_ends_the_run_with_the_rate_lowered(tmp_path, toy_pairs, toy_run_settings):
    told = []
    settings = toy_run_settings(epochs=None, max_minutes=3 / 60)
    began = time.monotonic()
    train(tmp_path / "run", toy_pairs(8), toy_pairs(2, 50), settings, told=told.append)
    assert 3 <= time.monotonic() - began < 60
    rates = [row["learning_rate"] for row in told]
    assert rates[-1] < 0.1 * settings.preset.optimizer.learning_rate
    assert told[-1]["minutes"] >= 3 / 60
    # What was worked before an interruption counts.
    assert read_checkpoint(tmp_path / "run")["elapsed_s"] >= 3


@pytest.mark.parametrize(
    ("epochs", "minutes", "step", "elapsed_s", "expected"),
    [
        (10, None, 5, 1e9, 0.25),
        (None, 2.0, 10**9, 30, 0.25),
        (10, 2.0, 5, 60, 0.5),
        (10, 2.0, 15, 60, 0.75),
        (10, None, 99, 0, 1.0),
    ],
)
def test_progress_follows_what_is_further_along(
    toy_run_settings, epochs, minutes, step, elapsed_s, expected
):
    settings = toy_run_settings(epochs=epochs, max_minutes=minutes)
    assert settings.progress(step, elapsed_s) == pytest.approx(expected)


_CHILD = textwrap.dedent(
    """
    import importlib.util, sys
    from pathlib import Path
    spec = importlib.util.spec_from_file_location("toy", sys.argv[1])
    toy = importlib.util.module_from_spec(spec)
    sys.modules["toy"] = toy
    spec.loader.exec_module(toy)
    from hdmap_tools.segmentation.training.trainer import train
    train(
        Path(sys.argv[2]), toy.ToyPairs(8), toy.ToyPairs(2, 50),
        toy.toy_settings(epochs=40, processes=int(sys.argv[3])),
        resume=sys.argv[4] == "resume", workers=1, checkpoint_every_s=0,
    )
    """
)


def child(run, processes=1, resume=False, launcher=()):
    command = [sys.executable, *launcher]
    script = run.parent / "child.py"
    script.write_text(_CHILD)
    return [
        *command,
        str(script),
        str(HERE / "conftest.py"),
        str(run),
        str(processes),
        "resume" if resume else "new",
    ]


@pytest.mark.slow
def test_a_run_killed_again_and_again_ends_as_if_it_never_was(
    tmp_path, toy_pairs, toy_run_settings
):
    train(tmp_path / "whole", toy_pairs(8), toy_pairs(2, 50), toy_run_settings(epochs=40))
    run = tmp_path / "killed"
    rng = np.random.default_rng(0)
    steps, resume = [], False
    for _ in range(6):
        process = subprocess.Popen(
            child(run, resume=resume), env={**os.environ, "OMP_NUM_THREADS": "1"}
        )
        reached = steps[-1] if steps else 0
        until = time.monotonic() + 120
        while process.poll() is None and time.monotonic() < until:
            if (run / CHECKPOINT).exists() and _step_of(run) > reached + 2:
                time.sleep(rng.uniform(0, 0.1))  # anywhere: in a step, in the writing
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
        steps.append(read_checkpoint(run)["step"])
        resume = True
    assert steps == sorted(set(steps)), "each went on from where the one before was"
    assert steps[-1] < 80, "killed before it was done"
    subprocess.run(child(run, resume=True), check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert same(weights(tmp_path / "whole"), weights(run))


def _step_of(run):
    try:
        return read_state(run / CHECKPOINT)["step"]
    except CheckpointError:  # just being replaced
        return 0


@pytest.mark.slow
def test_two_processes_under_torchrun_learn_one_network(tmp_path):
    run = tmp_path / "run"
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        child(run, processes=2, launcher=launcher),
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert mean_iou(ConfusionMatrix.load(run / CONFUSION_NAME)) > 0.8
    state = read_checkpoint(run)
    assert state["step"] == 80
    assert not any(name.startswith("module.") for name in state["model"])
    rows = read_log(run)
    assert [int(row["step"]) for row in rows] == list(range(5, 81, 5))
    assert all(math.isfinite(float(row["loss"])) for row in rows)
