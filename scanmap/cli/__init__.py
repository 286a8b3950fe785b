"""The commands, a file per theme. The only module that prints, exits, or sets logging up.

Nothing heavy is imported here: `scanmap --help` must answer at once, so every command imports its own means.
"""

from __future__ import annotations

import errno
import sys
from typing import Annotated

import typer

from scanmap import __version__
from scanmap.cli import (
    boards,
    calibrating,
    designing,
    hardware,
    judging,
    latency,
    live,
    look,
    recovering,
    scanning,
    settings,
    tabling,
    terminal,
)
from scanmap.errors import ConfigError, ScanmapError, in_words

app = typer.Typer(
    name="scanmap",
    help="A webcam and a line laser on a turning head become a calibrated room scanner. "
    "With no hardware attached, `scanmap scan --out room.ply` scans the digital twin's room.",
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command()(scanning.scan)
app.command()(scanning.replay)
app.command()(look.view)
app.command("map")(look.make_map)
app.command()(look.info)
app.command()(settings.config)
app.command()(recovering.recover)
app.command()(live.live)
app.command()(hardware.doctor)
app.command()(hardware.init)
app.add_typer(hardware.stage)
calibrating.calibrate.command()(tabling.table)
calibrating.calibrate.command("self")(judging.self_)
calibrating.calibrate.command()(judging.check)
calibrating.calibrate.command()(latency.latency)
app.command()(boards.board)
calibrating.calibrate.command()(boards.scale)
app.add_typer(calibrating.calibrate)
app.command()(designing.design)


def _version(asked: bool) -> None:
    if asked:
        print(f"scanmap {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks and log everything; goes anywhere.")] = False,
) -> None:
    pass


def main(argv: list[str] | None = None) -> None:
    """Entry point: runs a command and exits; 0 done, 1 failed, 2 usage, 130 interrupted.

    Errors of our own are one line on stderr; anything else is a bug and says how to see the traceback.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    terminal.set_up_logging(debug)
    code = _run([word for word in words if word != "--debug"] or ["--help"], debug)
    terminal.output.flush()
    if terminal.output.error is not None:
        terminal.complain(f"the output could not be printed: {terminal.output.error.strerror}")
        code = code or 1
    sys.exit(code)


def _run(words: list[str], debug: bool) -> int:
    """The exit code of a command; every error said in one line, or raised when debugging."""
    try:
        return int(app(words, prog_name="scanmap", standalone_mode=False) or 0)
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.EPIPE:
            return 0
        usage = _usage(error)
        if debug and not usage:
            raise
        bug = f"{type(error).__name__}: {error}. This is a bug; the same command with --debug shows where"
        terminal.complain(usage or (str(error) if isinstance(error, ScanmapError | OSError) else bug))
        return 2 if usage or isinstance(error, ConfigError) else 1


def _usage(error: Exception) -> str:
    """What is wrong with the command line itself, and what would be right; empty for any other error."""
    if type(error).__name__ == "NoArgsIsHelpError":
        commands = ", ".join(getattr(error.ctx.command, "commands", ()))  # type: ignore[attr-defined]
        path = error.ctx.command_path  # type: ignore[attr-defined]
        return f"{path} does nothing by itself; commands: {commands}; try {path} --help"
    say_it = getattr(error, "format_message", None)
    if say_it is None:
        return ""
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "scanmap"
    valid = ", ".join(getattr(context.command, "commands", ())) if context is not None else ""
    commands = f"; commands: {valid}" if valid else ""
    return f"{in_words(str(say_it()).rstrip('.'))}{commands}; try {command} --help"
