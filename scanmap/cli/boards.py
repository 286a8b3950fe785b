"""`scanmap board`: a board to print; and `scanmap calibrate scale`: a calibration for another resolution."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scanmap.cli.calibrating import CalibrationOut
from scanmap.cli.settings import size_of


def board(
    out: Annotated[Path, typer.Option("--out", metavar="F.pdf|F.png", help="The sheet; PDF is sharpest.")],
    board: Annotated[
        str, typer.Option("--board", metavar="NAME", help="chessboard:8x6:40mm or charuco:7x5:30mm:22mm.")
    ] = "charuco:7x5:30mm:22mm",
    paper: Annotated[str, typer.Option("--paper", metavar="a4|a3|letter", help="Size of the paper.")] = "a4",
) -> None:
    """A board to print, true to scale, with rulers to check the print.

    Print it at 100 % ("actual size"), glue it to something flat and stiff, measure ten squares, and give what you
    measured to --board of the calibrate commands.

    Example: scanmap board --out board.pdf --board charuco:7x5:30mm:22mm
    """
    from scanmap.cli.terminal import say
    from scanmap.solvers.board import parse_board
    from scanmap.solvers.board_sheet import draw_sheet

    parsed = parse_board(board)
    draw_sheet(parsed, out, paper.lower())
    across, down = parsed.squares
    size = f"{1e3 * across * parsed.square_m:g} x {1e3 * down * parsed.square_m:g} mm"
    say(f"wrote {out}: {parsed.name}, {size}; print it at 100 %, check the rulers, glue it to something flat")
    say(f"next: scanmap calibrate camera SOURCE --board {parsed.name}")


def scale(
    file: Annotated[Path, typer.Argument(metavar="F.toml", help="A calibration.")],
    size: Annotated[str, typer.Option("--size", metavar="WxH", help="The camera's other size, as 800x600.")],
    out: CalibrationOut,
) -> None:
    """The same head at another resolution that shows the same field of view (a binned or scaled picture).

    Not for one that shows a part of it: a cropped picture needs a calibration of its own.

    Example: scanmap calibrate scale calibration.toml --size 800x600 --out calibration-800.toml
    """
    from scanmap.calibration import Calibration
    from scanmap.calibration.keeping import refuse_path, save_beside
    from scanmap.cli.terminal import say, say_written

    width, height = size_of("--size", size)
    refuse_path(out)
    kept = save_beside(Calibration.load(file).rescaled(width, height), out)
    say_written(out, kept)
    say("it holds only if the camera shows the same field of view at both sizes: compare two pictures")
