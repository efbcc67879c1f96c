"""-v, -vv and -q, before the command and after it."""

import logging

import pytest

from hdmap_tools.cli.main import main


@pytest.fixture
def wrong(tmp_path):
    return ("info", tmp_path / "nothing")


@pytest.mark.parametrize(
    ("before", "after", "level"),
    [
        ((), (), logging.WARNING),
        (("-v",), (), logging.INFO),
        ((), ("-v",), logging.INFO),
        ((), ("-vv",), logging.DEBUG),
        (("-v",), ("--verbose",), logging.DEBUG),
        (("-q",), (), logging.ERROR),
        ((), ("-q",), logging.ERROR),
        ((), ("--quiet", "-v"), logging.ERROR),
    ],
)
@pytest.mark.parametrize("command", [("plugins", "list"), ("info", "--default-config")])
def test_it_counts_wherever_it_stands(before, after, level, command, hdmap):
    code, _, err = hdmap(*before, *command, *after)
    assert code == 0, err
    assert logging.getLogger("hdmap_tools").level == level


def test_one_command_s_wish_is_forgotten_by_the_next(hdmap):
    hdmap("plugins", "list", "-vv")
    hdmap("plugins", "list")
    assert logging.getLogger("hdmap_tools").level == logging.WARNING


@pytest.mark.parametrize(
    ("before", "after"), [(("-vv",), ()), ((), ("-vv",)), (("-v",), ("-v",)), ((), ("-v", "-v"))]
)
def test_two_show_the_traceback(before, after, wrong):
    with pytest.raises(Exception, match="does not exist"):
        main([*before, *map(str, wrong), *after])


@pytest.mark.parametrize(("before", "after"), [((), ()), (("-v",), ()), ((), ("-q",))])
def test_fewer_give_one_line(before, after, wrong, fails):
    fails(*before, *wrong, *after, says=("does not exist",))


def test_after_two_dashes_it_is_a_name(hdmap, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = hdmap("info", "--", "-vv")
    assert code == 1
    assert "-vv does not exist" in err
    assert "Traceback" not in err


def test_a_command_s_help_does_not_repeat_it(hdmap):
    _, out, _ = hdmap("plugins", "list", "--help")
    assert "--verbose" not in out
    _, out, _ = hdmap("--help")
    assert "takes -v and -q too" in " ".join(out.split())
