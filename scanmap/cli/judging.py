"""`scanmap calibrate self` and `check`: a scan of an ordinary room refines a head, or judges it."""

from __future__ import annotations

import shlex
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scanmap.cli.settings import CalibrationOption, ConfigOption, SetOption, again

if TYPE_CHECKING:
    from scanmap.session.judging import Measured
    from scanmap.solvers.check import Check
    from scanmap.solvers.self_calibration import Refined

Recording = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A recording (.mcap), a folder with scan.csv, or a video.")
]
Figure = Annotated[Path | None, typer.Option("--figure", metavar="F.png", help="Draw the walls as PNG.")]
Rrd = Annotated[Path | None, typer.Option("--rrd", metavar="F.rrd", help="The walls in space, for scanmap view F.rrd.")]


def self_(
    recording: Recording,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    scale: Annotated[
        Literal["auto", "baseline", "axis"],
        typer.Option(
            "--scale",
            metavar="auto|baseline|axis",
            help="The length that is known and holds the scale; auto takes the longer one.",
        ),
    ] = "auto",
    out: Annotated[
        Path, typer.Option("--out", metavar="F.toml", help="The new calibration; an old one is kept beside.")
    ] = Path("calibration.toml"),
    figure: Figure = None,
    rrd: Rrd = None,
) -> None:
    """Refine a head without a board, by a scan of an ordinary room.

    Walls must come out flat, passes must agree, a full turn must close: that gives the head's offset from the axis, the
    axis's tilt and the laser plane against the camera. On a turntable, printed markers (ArUco, AprilTag) tell the axis.
    Says what it could not observe, and writes nothing that is not better.

    Example: scanmap calibrate self room.mcap --out calibration.toml
    """
    from scanmap.calibration.keeping import refuse_file, refuse_path
    from scanmap.cli.report import rounds_bar
    from scanmap.cli.terminal import say, say_written
    from scanmap.session.judging import write_refined
    from scanmap.solvers.self_calibration import refine

    refuse_path(out)
    refuse_file("--figure", figure, ".png")
    refuse_file("--rrd", rrd, ".rrd")
    measured, is_twin = _measure(recording, config, set_, calibration)
    with rounds_bar("making walls flat") as progress:
        refined = refine(
            measured.lines, measured.calibration, None if scale == "auto" else scale, marks=measured.marks,
            progress=progress,
        )  # fmt: skip
    _print_refined(refined)
    if figure is not None:
        from scanmap.solvers.wall_figures import draw_refined

        draw_refined(refined.before, refined.after, refined.segments, refined.patches, figure)
        say(f"wrote {figure}")
    if rrd is not None:
        from scanmap.solvers.wall_figures import in_space
        from scanmap.view.walls import write_walls

        heads = (("before", refined.before), ("after", refined.after))
        write_walls(rrd, [in_space(name, head, refined.segments, refined.patches) for name, head in heads])
        say(f"wrote {rrd}")
    of_this = f"{shlex.quote(str(recording))}{again(config, set_)}"
    if not refined.gained:
        say(
            "nothing to gain: the change is within its own sigma, the head is as good as this scan can tell; nothing "
            f"is written. Use it as it is; scanmap calibrate check {of_this}{_given(calibration)} judges it"
        )
        return
    kept = write_refined(refined, out, recording, is_twin=is_twin)
    say_written(out, kept)
    files = f"{of_this}{_given(str(out))}"
    say(f"next: scanmap calibrate check {files}")
    say(f"next: scanmap replay {files} --out room.ply")


def check(
    recording: Recording,
    config: ConfigOption = None,
    set_: SetOption = None,
    calibration: CalibrationOption = None,
    not_square: Annotated[
        bool, typer.Option("--not-square", help="The room's corners are not square; do not judge by them.")
    ] = False,
    wall_mm_per_m: Annotated[
        float,
        typer.Option("--wall-mm-per-m", metavar="MM", min=0.0, max=20.0, help="How flat the walls themselves are."),
    ] = 0.5,
    figure: Figure = None,
    rrd: Rrd = None,
) -> None:
    """Judge a calibration by a scan of a room: flatness, bow, corners, repeatability.

    Held against what the calibration promises: the line's noise and its own covariance. Exit code 1 if it fails.

    Example: scanmap calibrate check room.mcap --figure walls.png
    """
    from scanmap.calibration.keeping import refuse_file
    from scanmap.cli.report import rounds_bar
    from scanmap.cli.terminal import say
    from scanmap.solvers.check import check as judge
    from scanmap.solvers.walls import CheckParams

    refuse_file("--figure", figure, ".png")
    refuse_file("--rrd", rrd, ".rrd")
    measured, _ = _measure(recording, config, set_, calibration)
    params = CheckParams(square=not not_square, wall_mm_per_m=wall_mm_per_m)
    with rounds_bar("judging walls") as progress:
        judged = judge(measured.lines, measured.calibration, params, marks=measured.marks, progress=progress)
    _print_check(judged)
    if figure is not None:
        from scanmap.solvers.wall_figures import draw_check

        draw_check(judged, measured.calibration, figure, f"{recording.name}: {'pass' if judged.passed else 'FAIL'}")
        say(f"wrote {figure}")
    if rrd is not None:
        from scanmap.solvers.wall_figures import in_space
        from scanmap.view.walls import write_walls

        heads = [("calibrated", measured.calibration)]
        if judged.refined is not None:
            heads.append(("best for this scan", judged.refined.after))
        write_walls(rrd, [in_space(name, head, judged.segments, judged.patches) for name, head in heads])
        say(f"wrote {rrd}")
    if not judged.passed:
        if judged.refined is not None:
            say(
                f"next: scanmap calibrate self {shlex.quote(str(recording))}{again(config, set_)}{_given(calibration)}"
                ", or with a board: scanmap calibrate laser"
            )
        raise typer.Exit(1)


def _given(calibration: str | None) -> str:
    """The option that names a calibration, where there is one."""
    return "" if calibration is None else f" --calibration {shlex.quote(calibration)}"


def _measure(
    recording: Path, config: str | None, set_: list[str] | None, calibration: str | None
) -> tuple[Measured, bool]:
    """The lines of a recording, read with progress; and whether they are the twin's."""
    from scanmap import session
    from scanmap.cli.report import progress_bar
    from scanmap.cli.terminal import say, stop_on_signal
    from scanmap.session.judging import measure_lines

    choice = session.Choice(config, tuple(set_ or ()), calibration)
    with stop_on_signal() as stop, session.prepare_replay(recording, choice, session.Outputs(), gated=False) as job:
        for line in job.announcement:
            say(line)
        with progress_bar("reading", job.total) as progress:
            measured = measure_lines(job, progress, stop.orderly("stopping: nothing is written"))
        is_twin = "source" in job.comments
    for fault in measured.faults[:5]:
        say(f"fault: {fault}")
    return measured, is_twin


def _print_refined(refined: Refined) -> None:
    from rich.table import Table

    from scanmap.cli.terminal import console, say
    from scanmap.solvers.self_words import UNOBSERVABLE, before_and_after, marks_words, parameter_lines, scale_words

    say(f"{len(refined.segments)} flat pieces; {scale_words(refined)}")
    table = Table(padding=(0, 0), pad_edge=False)
    for name in ("", "before", "after", "sigma", "observed"):
        table.add_column(name, justify="left" if name in ("", "observed") else "right")
    for line in parameter_lines(refined):
        table.add_row(*line)
    console.print(table)
    walls = Table(padding=(0, 0), pad_edge=False)
    for name in ("wall", "range m", "length m", "rms before", "after mm", "bow before", "after mm"):
        walls.add_column(name, justify="right")
    for k, (before, after) in enumerate(before_and_after(refined), 1):
        walls.add_row(
            str(k), f"{after.range_m:.2f}", f"{after.length_m:.2f}", f"{1e3 * before.rms_m:.2f}",
            f"{1e3 * after.rms_m:.2f}", f"{1e3 * before.bow_m:.2f}", f"{1e3 * after.bow_m:.2f}",
        )  # fmt: skip
    console.print(walls)
    say(f"all flat pieces: {refined.rms_before_px:.3f} px rms before, {refined.rms_after_px:.3f} px after")
    if refined.followed is not None:
        say(marks_words(refined.followed))
    if refined.square.walls:
        say(
            f"{refined.square.walls} upright pieces are square to each other to about "
            f"{degrees(refined.square.scatter):.2f} deg; what that says of the head is used"
        )
    say(f"not observable by any such scan: {'; '.join(UNOBSERVABLE)}")


def _print_check(judged: Check) -> None:
    from rich.table import Table

    from scanmap.cli.terminal import console, say
    from scanmap.solvers.check_words import conclusion, notes, verdict_lines

    table = Table(padding=(0, 0), pad_edge=False)
    for name in ("wall", "range m", "length m", "bearings", "rms mm", "limit", "bow mm", "limit"):
        table.add_column(name, justify="right")
    for k, wall in enumerate(judged.walls, 1):
        table.add_row(
            str(k), f"{wall.range_m:.2f}", f"{wall.length_m:.2f}", str(wall.bearings), f"{1e3 * wall.rms_m:.2f}",
            f"{1e3 * wall.rms_limit_m:.2f}", f"{1e3 * wall.bow_m:.2f}", f"{1e3 * wall.bow_limit_m:.2f}",
        )  # fmt: skip
    console.print(table)
    for passed, line in verdict_lines(judged):
        say(f"{'pass' if passed else 'FAIL'}  {line}")
    for line in notes(judged):
        say(f"note  {line}")
    say(conclusion(judged))
