"""What is said and shown while pictures of a board are collected."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scanmap.calibration import Calibration
    from scanmap.solvers.coverage import Progress
    from scanmap.solvers.detection import Rejected, View
    from scanmap.solvers.pictures import Views
    from scanmap.view.board_live import BoardView

# Live: so many good views without a wish left are enough.
LIVE_VIEWS = {"camera": 20, "laser": 15}
SHOWN_REJECTED = 12
LINE_EVERY_S = 5.0  # so much silence at most, while pictures of a folder are looked at
AGAIN_S = 2.0  # live: no faster does one complaint follow another
STARTED = {
    "camera": "hold the board into the picture, still for a moment each time; Ctrl-C ends it",
    "laser": "hold the board so that the laser crosses its squares, still for a moment each time; Ctrl-C ends it",
    "axis": "the head turns, the board stands still; Ctrl-C ends it",
}


class Collecting:
    """The report of `collect`: words in the terminal, live also the view; False ends the collection."""

    def __init__(
        self, part: str, asked: Callable[[], bool], *, live: bool, base: Calibration | None, view: BoardView | None
    ) -> None:
        from scanmap.cli.terminal import say

        self._part, self._asked, self._live, self._base, self._view = part, asked, live, base, view
        self._said, self._spoken = "", time.monotonic()
        if live:
            say(STARTED[part])

    def __call__(self, views: Views, last: View | Rejected) -> bool:
        """Tell of one more picture."""
        from scanmap.solvers.detection import View

        if self._asked():
            return False
        if not self._live:
            self._of_folder(views, last)
            return True
        if isinstance(last, View):
            return self._good(views, last)
        self._show(views, None, f"not used: {last.reason}")
        if last.reason != self._said and time.monotonic() - self._spoken > AGAIN_S:
            self._say(f"not used: {last.reason}", last.reason)
        return True

    def _of_folder(self, views: Views, last: View | Rejected) -> None:
        from scanmap.cli.terminal import say
        from scanmap.solvers.detection import Rejected

        if time.monotonic() - self._spoken > LINE_EVERY_S:
            count = len(views.views) + len(views.rejected)
            self._say(f"looked at {count} pictures, {len(views.views)} good", "")
        if isinstance(last, Rejected) and len(views.rejected) <= SHOWN_REJECTED:
            say(f"not used: {last.name}: {last.reason}")

    def _good(self, views: Views, last: View) -> bool:
        progress = self._progress(views)
        words = [
            f"{len(views.views)} good: {len(last.ids)} corners, edges {last.blur_px:.1f} px"
            + (f", {last.dropped} corners lost to glare or shadow" if last.dropped else ""),
            self._how_far(views, progress),
        ]
        if progress.wishes and self._part != "axis":
            words.append(f"next: {', '.join(progress.wishes[:2])}")
        self._say("; ".join(words), "")
        self._show(views, last, *words, *progress.wishes[2:])
        enough = LIVE_VIEWS.get(self._part, sys.maxsize)
        return len(views.views) < enough or bool(progress.wishes)

    def _how_far(self, views: Views, progress: Progress) -> str:
        if self._part == "axis":
            bearings = [math.degrees(view.bearing) for view in views.views]
            return f"bearing {bearings[-1]:.1f} deg, {max(bearings) - min(bearings):.1f} deg so far"
        if self._part == "laser":
            near, far = progress.depths_m
            return f"boards at {near:.2f} to {far:.2f} m, tilted within {progress.tilt_deg:.0f} deg"
        return f"{100 * progress.covered:.0f} % of the picture covered, tilted within {progress.tilt_deg:.0f} deg"

    def _progress(self, views: Views) -> Progress:
        from scanmap.solvers.coverage import progress_of

        camera = self._base.intrinsics if self._base is not None and self._part != "camera" else None
        return progress_of(views.views, views.board, views.size, camera)

    def _say(self, text: str, reason: str) -> None:
        from scanmap.cli.terminal import say

        self._said, self._spoken = reason, time.monotonic()
        say(text)

    def _show(self, views: Views, good: View | None, *words: str) -> None:
        from scanmap.solvers.coverage import coverage_of

        if self._view is None or views.picture is None:
            return
        counts = coverage_of(views.views, views.size).counts
        lines = [f"# {len(views.views)} good views", *words]
        corners = good.corners if good is not None else None
        self._view.show(views.picture.image, corners, views.line if good is not None else None, counts, lines)
