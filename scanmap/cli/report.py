"""What a command prints: progress while scanning, the summary after it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from scanmap.session import Progress, Result
    from scanmap.session.summary import Summary

console = Console(highlight=False, soft_wrap=True)


def say(text: str) -> None:
    """One line to the user, taken as it is."""
    console.print(text, markup=False)


@contextmanager
def progress_bar() -> Iterator[Callable[[Progress], None]]:
    """A bar with time left, bearing and rows found; gives the function that moves it."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("time left"),
        TimeRemainingColumn(), TextColumn("{task.fields[where]}"),
    )  # fmt: skip
    with Bar(*columns, console=console) as bar:
        task = bar.add_task("scanning", total=None, where="")

        def move(progress: Progress) -> None:
            where = f"bearing {progress.bearing_deg:.2f} deg, {progress.rows_found}/{progress.rows} rows"
            bar.update(task, completed=progress.done, total=progress.total, where=where)

        yield move


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Ctrl-C or SIGTERM asks for an orderly end; gives the function that tells whether it was asked for.

    A second Ctrl-C interrupts at once.
    """
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        say("stopping: the head parks, everything scanned is kept (again to stop at once)")

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def print_summary(summary: Summary) -> None:
    """Points, ranges, rows without return and why, and the accuracy budget."""
    cells = summary.bearings * summary.rows
    share = 100.0 * summary.points / cells if cells else 0.0
    say(f"{summary.points} points from {summary.bearings} bearings x {summary.rows} rows ({share:.1f} % of the rows)")
    if summary.points:
        say(f"range {summary.range_min_m:.3f} to {summary.range_max_m:.3f} m, median {summary.range_median_m:.3f} m")
    if summary.lost:
        reasons = ", ".join(
            f"{reason.words} {count} ({100.0 * count / cells:.1f} %)" for reason, count in summary.lost.items()
        )
        say(f"rows without a point: {reasons}")
    if not summary.budget:
        return
    table = Table(title="accuracy budget (sigma of a point)", title_justify="left")
    for name in ("range", "points", "median mm", "95 % mm"):
        table.add_column(name, justify="left" if name == "range" else "right")
    for band in summary.budget:
        table.add_row(band.name, str(band.points), f"{1e3 * band.sigma_median_m:.2f}", f"{1e3 * band.sigma_p95_m:.2f}")
    console.print(table)


def print_result(result: Result) -> None:
    """Everything a scan or replay ends with."""
    print_summary(result.summary)
    for fault in result.faults[:10]:
        say(f"fault: {fault}")
    if len(result.faults) > 10:
        say(f"fault: and {len(result.faults) - 10} more; the recording's /diagnostics has them all")
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
    if result.next_commands:
        say("next: " + "   ".join(result.next_commands))
