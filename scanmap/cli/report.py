"""What a command prints: progress while scanning, the summary after it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.table import Table

from scanmap.cli.terminal import console, say

if TYPE_CHECKING:
    from scanmap.session import Progress, Result
    from scanmap.session.summary import Summary

SHOWN_FAULTS = 10
LINE_EVERY_S = 10.0  # progress in a log file, where no bar can be drawn


@contextmanager
def progress_bar(work: str, total: int | None) -> Iterator[Callable[[Progress], None]]:
    """A bar with time left, bearing and rows found; gives the function that moves it.

    Where nobody watches (a pipe, a log file) a line now and then.
    """
    if not console.is_terminal:
        yield _lines(work)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"), BarColumn(bar_width=None), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("left{task.fields[where]}"),
    )  # fmt: skip
    # Not stdout: the console writes there itself.
    bar = Bar(*columns, console=console, expand=True, redirect_stdout=False)
    task = bar.add_task(work, total=total, where="")

    def move(progress: Progress) -> None:
        bar.start()  # not before: its thread would keep replay from copying this process
        where = f", bearing {progress.bearing_deg:.2f} deg, {progress.rows_found}/{progress.rows} rows"
        bar.update(task, completed=progress.done, total=progress.total, where=where)

    try:
        yield move
    finally:
        bar.stop()


@contextmanager
def rounds_bar(work: str) -> Iterator[Callable[[int, int], None]]:
    """A bar for work of a few rounds; gives the function that is told (done, all). Where nobody watches, one line."""
    if not console.is_terminal:
        say(f"{work} ...")
        yield lambda done, total: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), MofNCompleteColumn())
    with Bar(*columns, console=console, expand=True, redirect_stdout=False) as bar:
        task = bar.add_task(work, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _lines(work: str) -> Callable[[Progress], None]:
    begun = last = time.monotonic()

    def move(progress: Progress) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last < LINE_EVERY_S:
            return
        last = now
        total = progress.total
        left = f", {(now - begun) * (total / progress.done - 1.0):.0f} s left" if total and progress.done else ""
        say(
            f"{work} {progress.done}/{total or '?'}{left}, bearing {progress.bearing_deg:.2f} deg, "
            f"{progress.rows_found}/{progress.rows} rows"
        )

    return move


def print_summary(summary: Summary) -> None:
    """Points, ranges, rows without return and why, and the accuracy budget."""
    cells = summary.bearings * summary.rows
    share = 100.0 * summary.points / cells if cells else 0.0
    bearings = "1 bearing" if summary.bearings == 1 else f"{summary.bearings} bearings"
    say(f"{summary.points} points from {bearings} x {summary.rows} rows ({share:.1f} % of the rows)")
    if summary.points:
        say(f"range {summary.range_min_m:.3f} to {summary.range_max_m:.3f} m, median {summary.range_median_m:.3f} m")
    if summary.lost:
        reasons = ", ".join(
            f"{reason.words} {count} ({100.0 * count / cells:.1f} %)" for reason, count in summary.lost.items()
        )
        say(f"rows without a point: {reasons}")
    if not summary.budget:
        return
    say("accuracy budget (sigma of a point):")
    table = Table()
    stated = bool(summary.calibration)
    for name in ("range", "points", "median mm", "95 % mm", *(("calibration mm",) if stated else ())):
        table.add_column(name, justify="left" if name == "range" else "right")
    for band in summary.budget:
        row = [band.name, str(band.points), f"{1e3 * band.sigma_median_m:.2f}", f"{1e3 * band.sigma_p95_m:.2f}"]
        table.add_row(*row, *((f"{1e3 * band.calibration_m:.2f}",) if stated else ()))
    console.print(table)
    say(_calibration_words(summary))


def _calibration_words(summary: Summary) -> str:
    """What the calibration adds to the budget, common to all points of a range."""
    if not summary.calibration:
        return "calibration: it states no covariance, so its own error is not in this budget"
    seen = [f"{1e3 * sigma:.2f} mm at {far:g} m" for far, sigma in summary.calibration if not math.isnan(sigma)]
    words = ", ".join(seen) if seen else "no round range is in view"
    return f"calibration: its own uncertainty (sigma, common to all points there) is {words}"


def print_result(result: Result) -> None:
    """Everything a scan or replay ends with."""
    print_summary(result.summary)
    for fault in result.faults[:SHOWN_FAULTS]:
        say(f"fault: {fault}")
    if len(result.faults) > SHOWN_FAULTS:
        say(f"fault: and {len(result.faults) - SHOWN_FAULTS} more")
    if result.floor_note:
        say(result.floor_note)
    if result.truth is not None:
        truth = result.truth
        say(
            f"error against truth: median {1e3 * truth.median_m:.2f} mm, 95 % {1e3 * truth.p95_m:.2f} mm, "
            f"completeness {100.0 * truth.completeness:.1f} %"
        )
    for path in result.files:
        say(f"wrote {path}")
    for path, error in result.unwritten:
        say(f"NOT written {path}: {error}")
    if result.ended == "interrupted":
        say(f"interrupted after {result.shots} shots; everything scanned until then is kept")
    for command in result.next_commands:
        say(f"next: {command}")
