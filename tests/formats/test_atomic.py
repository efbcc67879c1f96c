import multiprocessing
import os
import stat
import time
from pathlib import Path

import pytest

from hdmap_tools.errors import FormatError, OutputExistsError
from hdmap_tools.formats.atomic import atomic_output


def test_writes_and_leaves_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "map.osm"
    with atomic_output(target, False) as temporary:
        assert temporary.suffix == ".osm"
        assert not target.exists()
        temporary.write_text("new")
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["map.osm"]


def test_existing_file_is_refused_and_untouched(tmp_path: Path) -> None:
    target = tmp_path / "map.osm"
    target.write_text("old")
    with (
        pytest.raises(OutputExistsError, match=r"map\.osm exists; use --overwrite"),
        atomic_output(target, False),
    ):
        pytest.fail("must not be entered")
    assert target.read_text() == "old"
    with atomic_output(target, True) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"


def test_file_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "map.osm"

    def race() -> None:
        with atomic_output(target, False) as temporary:
            temporary.write_text("mine")
            target.write_text("theirs")

    with pytest.raises(OutputExistsError):
        race()
    assert target.read_text() == "theirs"
    assert os.listdir(tmp_path) == ["map.osm"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_the_old_file_and_no_litter(
    tmp_path: Path, error: type[BaseException]
) -> None:
    target = tmp_path / "map.gpkg"
    target.write_text("old")

    def fail() -> None:
        with atomic_output(target, True) as temporary:
            temporary.write_text("half")
            temporary.with_name("map.gpkg-journal").write_text("sidecar")
            raise error

    with pytest.raises(error):
        fail()
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["map.gpkg"]


def test_validation_refuses_before_the_rename(tmp_path: Path) -> None:
    target = tmp_path / "map.osm"
    target.write_text("old")

    def validate(path: Path) -> None:
        assert path.read_text() == "bad"
        raise FormatError("refused")

    with (
        pytest.raises(FormatError, match="refused"),
        atomic_output(target, True, validate=validate) as temporary,
    ):
        temporary.write_text("bad")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["map.osm"]


def test_nothing_written_missing_folder_and_folder_as_target(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="nothing was changed"), atomic_output(tmp_path / "a"):
        pass
    nowhere = tmp_path / "none" / "a"
    with pytest.raises(FormatError, match=r"folder .* does not exist"), atomic_output(nowhere):
        pass
    with pytest.raises(OutputExistsError, match="is a folder"), atomic_output(tmp_path, True):
        pass
    assert os.listdir(tmp_path) == []


def test_permissions_are_those_of_an_ordinary_file(tmp_path: Path) -> None:
    (tmp_path / "ordinary").write_text("")
    with atomic_output(tmp_path / "a") as temporary:
        temporary.write_text("")
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("ordinary", "a")}
    assert len(modes) == 1


def test_a_symbolic_link_stays_and_its_target_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    with atomic_output(tmp_path / "link", True) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"


def _write_slowly(target: Path) -> None:
    with atomic_output(target, True) as temporary:
        temporary.write_text("half")
        (target.parent / "started").write_text("")
        time.sleep(60)


def test_killed_in_the_middle_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "map.osm"
    target.write_text("old")
    process = multiprocessing.get_context("fork").Process(target=_write_slowly, args=(target,))
    process.start()
    deadline = time.monotonic() + 20
    while not (tmp_path / "started").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.join()
    assert target.read_text() == "old"
