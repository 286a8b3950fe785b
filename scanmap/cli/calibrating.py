"""`scanmap calibrate camera`, `laser`, `axis`: from a printed board to a calibrated head."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption

if TYPE_CHECKING:
    from scanmap.calibration import Calibration
    from scanmap.cli.terminal import Stop
    from scanmap.session.calibrating import BoardJob, Solved
    from scanmap.solvers.detection import Rejected, View
    from scanmap.solvers.pictures import Views

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
# Live: so many good views without a wish left are enough.
LIVE_VIEWS = {"camera": 20, "laser": 15}
SHOWN_REJECTED = 12
LINE_EVERY_S = 5.0  # so much silence at most, while pictures of a folder are looked at


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

    _run("camera", (source, board, config, set_), out, (figures, rrd), solve)


@calibrate.command()
def laser(
    source: PicturesArgument,
    board: BoardOption,
    out: CalibrationOut = Path("calibration.toml"),
    calibration: CalibrationOption = None,
    margin_mm: Annotated[
        float | None,
        typer.Option("--margin-mm", min=0.0, help="How far the flat sheet goes on beyond the squares; 3 squares."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only hold the calibration against the pictures; exit 1 if it is off.")
    ] = False,
    figures: FiguresOption = None,
    rrd: RrdOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Laser plane from pictures of the board with the laser line on it.

    About 15 pictures: board near and far, turned both ways, the line across its squares. The camera comes from
    --calibration, by default from --out, where `calibrate camera` left it.

    Example: scanmap calibrate laser pictures/ --board chessboard:8x6:40mm --figures check
    """
    from scanmap.cli.terminal import say, stop_on_signal
    from scanmap.session import board_report
    from scanmap.session import calibrating as session

    base = _base(calibration, out, "scanmap calibrate camera SOURCE")
    margin_m = None if margin_mm is None else 1e-3 * margin_mm
    if check:
        with stop_on_signal() as stop:
            job = _job("laser", source, board, config, set_, stop)
            rms_m, rms_px, boards = session.check_laser(job, base, margin_m)
        say(f"passed: the line on {boards} boards lies {1e3 * rms_m:.2f} mm rms ({rms_px:.2f} px) off the laser plane")
        return

    def solve(job: BoardJob, say: Callable[[str], None]) -> Solved:
        solved = session.solve_laser(job, base, margin_m)
        for line in board_report.laser_words(solved, base):
            say(line)
        return solved

    _run("laser", (source, board, config, set_), out, (figures, rrd), solve)


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

    _run("axis", (source, board, config, set_), out, (figures, rrd), solve)


def _base(calibration: str | None, out: Path, before: str) -> Calibration:
    """The calibration to go on from."""
    from scanmap.calibration import Calibration
    from scanmap.errors import ConfigError

    path = Path(calibration) if calibration is not None else out
    if not path.is_file():
        raise ConfigError(
            f"{path}: no such calibration to go on from; {before} --out {path} comes first, "
            "or give one with --calibration"
        )
    return Calibration.load(path)


def _job(part: str, source: str, board: str, config: str | None, set_: list[str] | None, stop: Stop) -> BoardJob:
    from scanmap import config as configuration
    from scanmap.calibration.keeping import recorded_command
    from scanmap.session.calibrating import BoardJob
    from scanmap.solvers.board import parse_board

    asked = stop.orderly("stopping: the calibration is made of the views so far")
    command = recorded_command(sys.argv[1:])
    job = BoardJob(source, parse_board(board), configuration.load(config, set_ or ()), command=command)
    return replace(job, report=_reporter(part, asked, live=job.is_live))


def _reporter(part: str, asked: Callable[[], bool], *, live: bool) -> Callable[[Views, View | Rejected], bool]:
    """Says what is new; live, also what to show next. False ends the collection."""
    from scanmap.cli.terminal import say
    from scanmap.solvers.coverage import guidance
    from scanmap.solvers.detection import View

    said: list[str] = [""]
    spoken = time.monotonic()

    def report(views: Views, last: View | Rejected) -> bool:
        nonlocal spoken
        if asked():
            return False
        if not live and time.monotonic() - spoken > LINE_EVERY_S:
            spoken = time.monotonic()
            say(f"looked at {len(views.views) + len(views.rejected)} pictures, {len(views.views)} good")
        if isinstance(last, View):
            wanted = guidance(views.views, views.board, views.size) if live and part == "camera" else []
            if live:
                then = f"; next: {wanted[0]}" if wanted else ""
                said[0] = f"{len(views.views)} good: {len(last.ids)} corners, edges {last.blur_px:.1f} px{then}"
                say(said[0])
            return not live or bool(wanted) or len(views.views) < LIVE_VIEWS.get(part, sys.maxsize)
        if not live or last.reason != said[0]:
            said[0] = last.reason
            if live or len(views.rejected) <= SHOWN_REJECTED:
                say(f"not used: {last.name}: {last.reason}")
        return True

    return report


def _run(
    part: str,
    what: tuple[str, str, str | None, list[str] | None],
    out: Path,
    pictures: tuple[Path | None, Path | None],
    solve: Callable[[BoardJob, Callable[[str], None]], Solved],
) -> None:
    """Collect, solve, say, write, draw."""
    from scanmap.calibration.keeping import parts_lost, refuse_file, refuse_folder, refuse_path
    from scanmap.cli.terminal import say, stop_on_signal
    from scanmap.session import board_report
    from scanmap.session import calibrating as session

    figures, rrd = pictures
    refuse_path(out)
    refuse_folder("--figures", figures)
    refuse_file("--rrd", rrd, ".rrd")
    with stop_on_signal() as stop:
        job = _job(part, *what, stop)
        solved = solve(job, say)
    unsaid = solved.views.rejected[SHOWN_REJECTED:]
    if unsaid:
        say(f"not used: {len(unsaid)} more pictures")
    lost = parts_lost(solved.calibration, out)
    kept = session.write_calibration(solved.calibration, out, f"{part}_rms_px")
    say_written(out, kept)
    if lost and kept is not None:
        say(f"note: {kept} had the {' and the '.join(lost)} too; --calibration {kept} would have kept its head")
    for path in board_report.draw(part, solved, figures, rrd):
        say(f"wrote {path}")
    following = {"camera": "laser", "laser": "axis"}.get(part)
    if following is not None:
        say(f"next: scanmap calibrate {following} SOURCE --board {what[1]} --out {out}")


def say_written(out: Path, kept: Path | None) -> None:
    from scanmap.cli.terminal import say

    say(f"wrote {out}" + (f"; the old one is {kept}" if kept is not None else ""))
