"""The `hdmap` command: finds its commands, and turns errors into one line and an exit code.

Exit codes: 0 done; 1 an error, said in one line; 2 wrong usage; 3 done, but a
vectorizer failed and its elements are missing; 130 interrupted; 143 terminated.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import logging
import re
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any, Final

import click

from hdmap_tools import __version__

_COMMANDS: Final = {
    "run": "Turn a drive into a map.",
    "segment": "Write label images of a drive's images.",
    "points": "Turn drives into a dense point map.",
    "build": "Fuse a drive into a semantic map.",
    "vectorize": "Run vectorizer plugins over a semantic map.",
    "export": "Write a vector map in another format.",
    "compare": "Hold a semantic map against a reference, where the map has evidence.",
    "confusion": "Measure a network's confusion matrix on annotated images.",
    "train": "Train a segmentation network on labelled images, or export a trained one to ONNX.",
    "reliability": "Hold a map's probabilities against truth, and fit the temperature that makes them true.",
    "calibrate": "Find a camera's lens and mount, and check them by eye.",
    "merge": "Add semantic maps: the sum equals the map built from all drives at once.",
    "history": "List the versions of a semantic map, compare them, go back to one.",
    "simulate": "Drive through a map: images, lidar sweeps, poses, and their exact truth.",
    "evaluate": "Measure the paper's methods and ours on simulated drives with exact truth.",
    "demo": "Simulate a short drive, map it, and hold the map against the truth.",
    "info": "Say what a drive, a semantic map, a point map or a vector file holds.",
    "plugins": "List, describe and check vectorizer plugins.",
}
"""Name and summary of each command; the module of a command is imported when it is called."""

EXIT_ERROR: Final = 1
EXIT_PLUGIN_FAILED: Final = 3
EXIT_INTERRUPTED: Final = 130
EXIT_TERMINATED: Final = 143

_ACCESS_ADVICE: Final = "check that it can be read and written"
_SPACE_ADVICE: Final = "free some space, or write to another disk"
_OS_ADVICE: Final = {
    errno.EACCES: _ACCESS_ADVICE,
    errno.EPERM: _ACCESS_ADVICE,
    errno.EROFS: "it is read-only; write to another folder",
    errno.ENOSPC: _SPACE_ADVICE,
    errno.EDQUOT: _SPACE_ADVICE,
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "check the path: a part of it is a file",
    errno.EISDIR: "it is a folder; give a file",
    errno.EMFILE: "raise the limit of open files with `ulimit -n`",
    errno.EIO: "the disk or the network failed; check it and run again",
}
"""What to do about errors of the system that no command foresaw."""


class _LazyGroup(click.Group):
    """A group that imports a command's module only when the command is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module = importlib.import_module(f"hdmap_tools.cli.{cmd_name}")
        command: click.Command = module.command
        return _with_verbosity(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))


def _with_verbosity(command: click.Command) -> click.Command:
    """The command, taking -v and -q too: people add them to the end of the line that failed."""
    for sub_command in command.commands.values() if isinstance(command, click.Group) else ():
        _with_verbosity(sub_command)
    if not any("--verbose" in parameter.opts for parameter in command.params):
        # Not in each command's help: `hdmap --help` says it once.
        command.params += [
            click.Option(
                ["-v", "--verbose"], count=True, hidden=True, expose_value=False, callback=_set_more
            ),
            click.Option(
                ["-q", "--quiet"],
                is_flag=True,
                hidden=True,
                expose_value=False,
                callback=_set_quiet,
            ),
        ]
    return command


def _set_more(ctx: click.Context, _: click.Parameter, count: int) -> None:
    if count:
        ctx.obj["verbose"] += count
        _set_level(ctx.obj)


def _set_quiet(ctx: click.Context, _: click.Parameter, is_quiet: bool) -> None:
    if is_quiet:
        ctx.obj["progress"] = False
        _set_level(ctx.obj)


def _set_level(said: dict[str, Any]) -> None:
    levels = (logging.WARNING, logging.INFO, logging.DEBUG)
    level = levels[min(said["verbose"], 2)] if said["progress"] else logging.ERROR
    logging.getLogger("hdmap_tools").setLevel(level)


@click.group(
    cls=_LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Each command has its own --help, which starts with examples, and takes -v and -q too.",
)
@click.version_option(__version__, prog_name="hdmap")
@click.option("-v", "--verbose", count=True, help="Say more; -vv shows the traceback of an error.")
@click.option("-q", "--quiet", is_flag=True, help="Only errors.")
@click.pass_context
def hdmap(ctx: click.Context, verbose: int, quiet: bool) -> None:
    """From a drive to an HD map.

    \b
    Examples:
      hdmap run path/to/drive -o out
      hdmap plugins list
    """
    ctx.obj = {"progress": not quiet, "verbose": verbose}
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    logging.getLogger("hdmap_tools").handlers[:] = [handler]
    _set_level(ctx.obj)


def main(args: list[str] | None = None) -> None:
    """Run the command line; the console script's entry."""
    arguments = list(sys.argv[1:] if args is None else args)
    show_traceback = _wants_traceback(arguments)
    with _termination_as_interrupt() as terminations:
        try:
            code: Any = hdmap.main(args=arguments, prog_name="hdmap", standalone_mode=False)
        except click.ClickException as error:
            error.show()
            sys.exit(error.exit_code)
        except (click.Abort, KeyboardInterrupt):
            click.echo("Terminated." if terminations else "Interrupted.", err=True)
            sys.exit(EXIT_TERMINATED if terminations else EXIT_INTERRUPTED)
        except Exception as error:
            if show_traceback:
                raise
            click.echo(f"Error: {_described(error)}", err=True)
            sys.exit(EXIT_ERROR)
    sys.exit(code if isinstance(code, int) else 0)


@contextlib.contextmanager
def _termination_as_interrupt() -> Iterator[list[int]]:
    """Let SIGTERM unwind the stack like Ctrl-C, so that temporary folders go; gives those that came."""
    received: list[int] = []

    def interrupt(number: int, _: FrameType | None) -> None:
        received.append(number)
        if len(received) == 1:  # a second one must not cut the cleaning short
            raise KeyboardInterrupt

    # Only the main thread may set handlers, and a caller's own way to end is left alone.
    is_ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    )
    if not is_ours:
        yield received
        return
    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield received
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _described(error: Exception) -> str:
    """What went wrong and what to do, on one line."""
    from hdmap_tools.errors import HDMapError

    text = " ".join(str(error).split())
    if isinstance(error, HDMapError):
        return text
    if isinstance(error, OSError):
        if error.strerror:
            text = error.strerror + ("" if error.filename is None else f": {error.filename!r}")
        advice = _OS_ADVICE.get(error.errno or 0)
        return f"{text} ({advice + '; ' if advice else ''}-vv shows where)"
    if isinstance(error, MemoryError):
        return "Out of memory; take a coarser resolution or a shorter drive."
    return (
        f"Unexpected {type(error).__name__}: {text}. This is a bug in hdmap_tools or in a package it "
        "uses; run again with -vv for the traceback."
    )


def _wants_traceback(arguments: list[str]) -> bool:
    """Whether -vv, or -v twice, was given, before or after the command."""
    count = 0
    for argument in arguments:
        if argument == "--":
            break
        if argument == "--verbose":
            count += 1
        elif re.fullmatch("-[qv]+", argument):
            count += argument.count("v")
    return count >= 2
