"""`scanmap calibrate camera`, `laser`, `axis`: from a printed board to a calibrated head."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption, again

if TYPE_CHECKING:
    from scanmap.calibration import Calibration
    from scanmap.session.calibrating import BoardJob, Solved
    from scanmap.view.board_live import BoardView

calibrate = typer.Typer(
    name="calibrate",
    help="Calibrate a head: camera, laser and axis from a printed board (`scanmap board`), then judge the result.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

PicturesArgument = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="Folder of pictures, video, recording (.mcap); live: camera (of --config), 0, /dev/video0 or a URL.",
    ),
]
BoardOption = Annotated[
    str, typer.Option("--board", metavar="NAME", help="chessboard:8x6:40mm or charuco:7x5:30mm:22mm, as measured.")
]
CalibrationOut = Annotated[
    Path, typer.Option("--out", metavar="F.toml", help="The calibration; an old one is kept beside.")
]
FiguresOption = Annotated[
    Path | None, typer.Option("--figures", metavar="DIR", help="Draw the pictures of the check as PNG there.")
]
RrdOption = Annotated[
    Path | None, typer.Option("--rrd", metavar="F.rrd", help="The check in space, for scanmap view F.rrd.")
]
ViewOption = Annotated[
    bool, typer.Option("--view/--no-view", help="Live: serve picture, coverage and hints on 127.0.0.1 and show them.")
]


@calibrate.callback()
def _calibrate() -> None:
    pass


@calibrate.command()
def camera(
    source: PicturesArgument,
    board: BoardOption,
    out: CalibrationOut = Path("calibration.toml"),
    figures: FiguresOption = None,
    rrd: RrdOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    view: ViewOption = True,
) -> None:
    """Intrinsics and distortion from pictures of a board.

    About 20 pictures: near and far, tilted up, down, left and right by 30 deg, in every corner of the picture. With
    --calibration the head of that file is kept (a drawing's), else laser and axis are to be calibrated next.

    Example: scanmap calibrate camera pictures/ --board chessboard:8x6:40mm --figures check
    """
    from scanmap.calibration import Calibration
    from scanmap.session import calibrating as session
    from scanmap.solvers.intrinsics import describe_fit

    base = Calibration.load(calibration) if calibration is not None else None

    def solve(job: BoardJob, say: Callable[[str], None]) -> Solved:
        solved = session.solve_camera(job, base)
        describe_fit(solved.fit, say)
        return solved

    _run("camera", (source, board, config, set_), out, (figures, rrd), (base, view), solve)


@calibrate.command()
def laser(
    source: PicturesArgument,
    board: BoardOption,
    out: CalibrationOut = Path("calibration.toml"),
    calibration: CalibrationOption = None,
    margin_mm: Annotated[
        float | None,
        typer.Option(
            "--margin-mm", metavar="MM", min=0.0, help="How far the flat sheet goes on beyond the squares; 3 squares."
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only hold the calibration against the pictures; exit 1 if it is off.")
    ] = False,
    figures: FiguresOption = None,
    rrd: RrdOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    view: ViewOption = True,
) -> None:
    """Laser plane from pictures of the board with the laser line on it.

    About 15 pictures: board near and far, turned both ways, the line across its squares. The camera comes from
    --calibration, by default from --out, where `calibrate camera` left it.

    Example: scanmap calibrate laser pictures/ --board chessboard:8x6:40mm --figures check
    """
    from scanmap.cli.terminal import say
    from scanmap.session import board_report
    from scanmap.session import calibrating as session

    base = _base(calibration, out, "scanmap calibrate camera SOURCE")
    margin_m = None if margin_mm is None else 1e-3 * margin_mm
    if check:
        with ExitStack() as opened:
            job = _job("laser", (source, board, config, set_), base, view, opened)
            rms_m, rms_px, boards = session.check_laser(job, base, margin_m)
        say(f"passed: the line on {boards} boards lies {1e3 * rms_m:.2f} mm rms ({rms_px:.2f} px) off the laser plane")
        return

    def solve(job: BoardJob, say: Callable[[str], None]) -> Solved:
        solved = session.solve_laser(job, base, margin_m)
        for line in board_report.laser_words(solved, base):
            say(line)
        return solved

    _run("laser", (source, board, config, set_), out, (figures, rrd), (base, view), solve)


@calibrate.command()
def axis(
    source: PicturesArgument,
    board: BoardOption,
    out: CalibrationOut = Path("calibration.toml"),
    calibration: CalibrationOption = None,
    figures: FiguresOption = None,
    rrd: RrdOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    view: ViewOption = True,
) -> None:
    """Head offset and tilt of the axis from a board that stands still while the head turns.

    SOURCE is a scan in which the board is in sight over at least 15 deg: a recording, or a folder with scan.csv. Live
    (SOURCE = camera), the head makes the sweep of --config.

    Example: scanmap calibrate axis board.mcap --board chessboard:8x6:40mm
    """
    from scanmap.session import board_report
    from scanmap.session import calibrating as session

    base = _base(calibration, out, "scanmap calibrate laser SOURCE")

    def solve(job: BoardJob, say: Callable[[str], None]) -> Solved:
        solved = session.solve_axis(job, base)
        for line in board_report.axis_words(solved):
            say(line)
        return solved

    _run("axis", (source, board, config, set_), out, (figures, rrd), (base, view), solve)


def _base(calibration: str | None, out: Path, before: str) -> Calibration:
    """The calibration to go on from."""
    from scanmap.calibration import Calibration
    from scanmap.errors import ConfigError

    path = Path(calibration) if calibration is not None else out
    if not path.is_file():
        raise ConfigError(
            f"{path}: no such calibration to go on from; {before} --out {shlex.quote(str(path))} comes first, "
            "or give one with --calibration"
        )
    return Calibration.load(path)


def _job(
    part: str,
    what: tuple[str, str, str | None, list[str] | None],
    base: Calibration | None,
    view: bool,
    opened: ExitStack,
) -> BoardJob:
    """Where the pictures come from, with what is said of them; closed with `opened`."""
    from scanmap import config as configuration
    from scanmap.calibration.keeping import recorded_command
    from scanmap.cli.collecting import Collecting
    from scanmap.cli.terminal import stop_on_signal
    from scanmap.session.calibrating import BoardJob
    from scanmap.solvers.board import parse_board

    source, board, config, set_ = what
    asked = opened.enter_context(stop_on_signal()).orderly("stopping: the calibration is made of the views so far")
    command = recorded_command(sys.argv[1:])
    job = BoardJob(source, parse_board(board), configuration.load(config, set_ or ()), command=command)
    shown = _live_view(part, job.config.view.live_port, opened) if view and job.is_live else None
    return replace(job, report=Collecting(part, asked, live=job.is_live, base=base, view=shown))


def _live_view(part: str, port: int, opened: ExitStack) -> BoardView:
    from scanmap import session
    from scanmap.cli.terminal import say
    from scanmap.view.board_live import BoardView

    shown = BoardView(port, coverage=part == "camera")
    opened.callback(shown.close)
    say(session.watching_words(port))
    return shown


def _run(
    part: str,
    what: tuple[str, str, str | None, list[str] | None],
    out: Path,
    pictures: tuple[Path | None, Path | None],
    live: tuple[Calibration | None, bool],
    solve: Callable[[BoardJob, Callable[[str], None]], Solved],
) -> None:
    """Collect, solve, say, write, draw."""
    from scanmap.calibration.keeping import parts_lost, refuse_file, refuse_folder, refuse_path
    from scanmap.cli.collecting import SHOWN_REJECTED
    from scanmap.cli.terminal import say, say_written
    from scanmap.session import board_report
    from scanmap.session import calibrating as session

    figures, rrd = pictures
    base, view = live
    refuse_path(out)
    refuse_folder("--figures", figures)
    refuse_file("--rrd", rrd, ".rrd")
    with ExitStack() as opened:
        job = _job(part, what, base, view, opened)
        for line in board_report.board_words(job.board, base):
            say(line)
        solved = solve(job, say)
    unsaid = len(solved.views.rejected) - len(solved.fit.rejected) - SHOWN_REJECTED
    if unsaid > 0 and not job.is_live:
        say(f"not used: {unsaid} more pictures")
    for left_out in solved.fit.rejected:
        say(f"left out: {left_out.name}: {left_out.reason}")
    lost = parts_lost(solved.calibration, out)
    kept = session.write_calibration(solved.calibration, out, f"{part}_rms_px")
    say_written(out, kept)
    if lost and kept is not None:
        say(f"note: {kept} had the {' and the '.join(lost)} too; --calibration {kept} would have kept its head")
    for path in board_report.draw(part, solved, figures, rrd):
        say(f"wrote {path}")
    following = {"camera": "laser", "laser": "axis"}.get(part)
    if following is not None:
        _, board, config, set_ = what
        words = f"--board {board} --out {shlex.quote(str(out))}{again(config, set_)}"
        say(f"next: scanmap calibrate {following} SOURCE {words}")
