"""The commands, a file per theme. The only module that prints, exits, or sets logging up.

Nothing heavy is imported here: `scanmap --help` must answer at once, so every command imports its own means.
"""

from __future__ import annotations

import logging
import sys
from typing import Annotated

import typer

from scanmap import __version__
from scanmap.cli import look, scanning, settings
from scanmap.errors import ConfigError, ScanmapError

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
    logging.basicConfig(level=logging.DEBUG if debug else logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        app([word for word in words if word != "--debug"], prog_name="scanmap")
    except ScanmapError as error:
        if debug:
            raise
        print(f"scanmap: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ConfigError) else 1)
    except KeyboardInterrupt:
        print("scanmap: interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if debug:
            raise
        print(
            f"scanmap: {type(error).__name__}: {error}. This is a bug; the same command with --debug shows where",
            file=sys.stderr,
        )
        sys.exit(1)
