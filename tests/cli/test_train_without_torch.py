"""Without the extra, `hdmap train` says how to get it, and its help works."""

import importlib.util

import pytest

from hdmap_tools.cli.main import main
from hdmap_tools.errors import MissingExtraError
from hdmap_tools.segmentation.training import extra


@pytest.fixture
def no_torch(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        extra.importlib.util, "find_spec", lambda name: None if name == "torch" else found(name)
    )


def test_training_names_the_extra(no_torch):
    with pytest.raises(MissingExtraError, match=r"torch.*pip install 'hdmap_tools\[train\]'"):
        extra.require_training()


def test_the_command_names_the_extra(no_torch, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(["train", "drive:x", "-o", str(tmp_path / "run")])
    assert exit_info.value.code == 1
    assert "hdmap_tools[train]" in capsys.readouterr().err


def test_help_needs_no_torch(no_torch, capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(["train", "--help"])
    assert exit_info.value.code == 0
    assert "hdmap train --export" in capsys.readouterr().out
