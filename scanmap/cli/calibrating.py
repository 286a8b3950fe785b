"""`scanmap calibrate ...` and `scanmap board`: from a printed board to a calibrated head."""

from __future__ import annotations

import typer

calibrate = typer.Typer(
    name="calibrate",
    help="Calibrate a head: camera, laser and axis from a printed board (`scanmap board`), then judge the result.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@calibrate.callback()
def _calibrate() -> None:
    pass
