"""The `hdmap` command: finds its commands, and turns errors into one line and an exit code.

Exit codes: 0 done; 1 an error, said in one line; 2 wrong usage; 3 done, but a
vectorizer failed and its elements are missing.
"""

from __future__ import annotations

import importlib
import logging
import re
import sys
from typing import Any, Final

import click

from hdmap_tools import __version__

_COMMANDS: Final = {
    "run": "Turn a drive into a map.",
    "segment": "Write label images of a drive's images.",
    "build": "Fuse a drive into a semantic map.",
    "vectorize": "Run vectorizer plugins over a semantic map.",
    "export": "Write a vector map in another format.",
    "compare": "Hold a semantic map against a reference, where the map has evidence.",
    "confusion": "Measure a network's confusion matrix on annotated images.",
    "merge": "Add semantic maps: the sum equals the map built from all drives at once.",
    "info": "Say what a drive, a semantic map or a vector file holds.",
    "plugins": "List, describe and check vectorizer plugins.",
}
"""Name and summary of each command; the module of a command is imported when it is called."""

EXIT_ERROR: Final = 1
EXIT_PLUGIN_FAILED: Final = 3


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
    try:
        code: Any = hdmap.main(args=arguments, prog_name="hdmap", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("Interrupted.", err=True)
        sys.exit(130)
    except Exception as error:
        from hdmap_tools.errors import HDMapError

        if show_traceback:
            raise
        if isinstance(error, HDMapError):
            message = " ".join(str(error).split())
        elif isinstance(error, OSError):
            message = " ".join(str(error).split()) + " (-vv shows where)"
        elif isinstance(error, MemoryError):
            message = "Out of memory; take a coarser resolution or a shorter drive."
        else:
            message = (
                f"Unexpected {type(error).__name__}: {' '.join(str(error).split())}. This is a bug in "
                "hdmap_tools or in a package it uses; run again with -vv for the traceback."
            )
        click.echo(f"Error: {message}", err=True)
        sys.exit(EXIT_ERROR)
    sys.exit(code if isinstance(code, int) else 0)


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
