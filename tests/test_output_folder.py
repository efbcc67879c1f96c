"""Nothing that is not an older result of the same command is ever replaced."""

import json
from pathlib import Path

import pytest

from hdmap_tools.errors import OutputExistsError, StoreError
from hdmap_tools.output_folder import MARKER, result_folder


def make(path: Path, command: str = "run", overwrite: bool = False, text: str = "new") -> None:
    with result_folder(path, command, overwrite) as folder:
        (folder / "map.osm").write_text(text)
        (folder / "semantic_map").mkdir()


def test_a_result_appears_whole_and_leaves_nothing_beside_it(tmp_path):
    make(tmp_path / "deep" / "out")
    assert (tmp_path / "deep" / "out" / "map.osm").read_text() == "new"
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["out"]
    marker = json.loads((tmp_path / "deep" / "out" / MARKER).read_text())
    assert marker == {"command": "run", "entries": ["map.osm", "semantic_map"]}


def test_an_older_result_is_replaced_when_asked(tmp_path):
    make(tmp_path / "out", text="old")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        make(tmp_path / "out")
    make(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "map.osm").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_may_be_used(tmp_path):
    (tmp_path / "out").mkdir()
    make(tmp_path / "out")
    assert (tmp_path / "out" / "map.osm").exists()


@pytest.mark.parametrize("with_config", [True, False])
def test_a_folder_of_somebody_s_is_left_alone(tmp_path, with_config):
    (tmp_path / "project" / "drive").mkdir(parents=True)
    if with_config:
        (tmp_path / "project" / "hdmap.yaml").write_text("fusion: {}")
    with pytest.raises(OutputExistsError, match="left alone"):
        make(tmp_path / "project", overwrite=True)
    assert (tmp_path / "project" / "drive").is_dir()


def test_a_result_with_something_added_is_left_alone(tmp_path):
    make(tmp_path / "out")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(OutputExistsError, match="left alone"):
        make(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "notes.txt").exists()


def test_a_result_of_another_command_is_left_alone(tmp_path):
    make(tmp_path / "out", command="segment")
    with pytest.raises(OutputExistsError, match="left alone"):
        make(tmp_path / "out", command="run", overwrite=True)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"command": "run", "entries": 3}'])
def test_a_marker_that_is_none_does_not_help(tmp_path, content):
    make(tmp_path / "out")
    (tmp_path / "out" / MARKER).write_text(content)
    with pytest.raises(OutputExistsError, match="left alone"):
        make(tmp_path / "out", overwrite=True)


def test_a_link_or_a_file_is_left_alone(tmp_path):
    make(tmp_path / "real")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    (tmp_path / "file").write_text("x")
    for name in ("link", "dangling", "file"):
        with pytest.raises(OutputExistsError, match="left alone"):
            make(tmp_path / name, overwrite=True)


def test_an_error_leaves_the_old_result_and_no_rest(tmp_path):
    make(tmp_path / "out", text="old")

    def fail() -> None:
        with result_folder(tmp_path / "out", "run", True) as folder:
            (folder / "map.osm").write_text("half")
            raise KeyError("in the middle")

    with pytest.raises(KeyError):
        fail()
    assert (tmp_path / "out" / "map.osm").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_failing_rename_brings_the_old_result_back(tmp_path, monkeypatch):
    make(tmp_path / "out", text="old")
    real = Path.rename

    def rename(self, target):
        if Path(target) == tmp_path / "out" and self.name == "out":
            raise OSError(28, "No space left on device")
        return real(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(StoreError, match="No space left"):
        make(tmp_path / "out", overwrite=True)
    monkeypatch.undo()
    assert (tmp_path / "out" / "map.osm").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_very_long_name(tmp_path):
    with pytest.raises(StoreError, match="Cannot make"):
        make(tmp_path / ("x" * 300))
    make(tmp_path / ("y" * 200))
