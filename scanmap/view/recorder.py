"""`View`: shows a scan while it grows, as an .rrd file, live to a viewer on this machine, or both.

A view is a spectator. Whatever goes wrong in it is a logged warning; the scan goes on.
"""

from __future__ import annotations

import logging
import shutil
import threading
import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Concatenate, ParamSpec

import numpy as np

from scanmap.calibration import Calibration
from scanmap.laserline import LaserLineParams, Reason
from scanmap.pipeline import Step
from scanmap.scan import Scan
from scanmap.view import entities as at
from scanmap.view.blueprint import eye_over, layout
from scanmap.view.entities import ViewParams
from scanmap.view.pictures import sent, shrink_factor
from scanmap.view.scene import LASER_RED, height_colours, log_grid, scan_colours
from scanmap.view.thesis_view import ThesisView

if TYPE_CHECKING:
    import rerun as rr

    from scanmap.grid import OccupancyGrid

logger = logging.getLogger(__name__)
P = ParamSpec("P")

# On a full disk the library's writer dies in silence and its closing may hang: stop before that.
MIN_FREE_BYTES = 32_000_000
CLOSE_TIMEOUT_S = 20.0
FREE_CHECK_EVERY = 8

LEVELS = ("TRACE", "DEBUG", "INFO", "WARN", "ERROR", "CRITICAL")


def isolated(method: Callable[Concatenate[View, P], None]) -> Callable[Concatenate[View, P], None]:
    """Make a failure of the view a warning, said once for each cause."""

    @wraps(method)
    def call(self: View, /, *args: P.args, **kwargs: P.kwargs) -> None:
        if not self.alive:
            return
        try:
            method(self, *args, **kwargs)
        except Exception as error:
            self.complain(f"{type(error).__name__}: {error}")

    return call


class View:
    """A scan on its way to the viewer; `step` is a `Sink`. Made by `open_view`, ended by `close`."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        calibration: Calibration,
        params: ViewParams,
        thesis: ThesisView | None,
        rrd: Path | None,
    ) -> None:
        self.alive = True
        self.whole = True  # False once it is known that the .rrd lacks its end
        self._recording = recording
        self._calibration = calibration
        self._params = params
        self._thesis = thesis
        self.rrd = rrd  # the file, where there is one
        self._shrink = shrink_factor(calibration.intrinsics.width, params.image_width_px)
        self._complaints: set[str] = set()
        self._states: dict[str, str] = {}
        self._steps = 0
        self._time_zero = 0.0
        self._last_index = -1
        self._low, self._high = np.inf, -np.inf  # heights seen so far [m]

    @isolated
    def step(self, step: Step) -> None:
        """Show one shot: head, points, picture with line, plots; a `Sink`."""
        if self._steps % FREE_CHECK_EVERY == 0 and not self._disk_has_room():
            return
        if self._steps == 0:
            self._time_zero = step.shot.time
        self._recording.set_time(at.SHOT, sequence=step.shot.index)
        self._recording.set_time(at.SCAN_TIME, duration=step.shot.time - self._time_zero)
        self._last_index = step.shot.index
        if step.fault:
            self._log("WARN", f"shot {step.shot.index}: {step.fault}")
        self._set_state(at.SCAN_STATE, "scanning")
        self._log_plots(step)
        self._log_points(step)
        readable = not (step.line.reason == Reason.DAMAGED).all()
        every = self._params.image_every
        if every and self._steps % every == 0 and readable:
            self._log_image(step)
        if self._thesis is not None:
            self._thesis.log_numbers(step)
            if self._steps % self._params.thesis_every == 0 and readable:
                self._thesis.log_pictures(step)
        self._steps += 1

    @isolated
    def look_at(self, params: ViewParams, laserline: LaserLineParams) -> None:
        """From the next shot on show the thesis's view with another row, grey conversion or overlay colour."""
        if self._thesis is not None:
            self._thesis = ThesisView(self._recording, self._calibration, laserline, params)

    @isolated
    def grid(self, grid: OccupancyGrid) -> None:
        """Show the occupancy grid as it is now, on the floor."""
        log_grid(self._recording, at.GRID, grid)

    @isolated
    def log(self, level: str, text: str) -> None:
        """Add a line to the view's log; `level` is INFO, WARN, ERROR (any case, also logging's names)."""
        self._log(level, text)

    @isolated
    def finish(self, scan: Scan, grid: OccupancyGrid | None = None) -> None:
        """Show the finished, filtered cloud and the final map; the layout's eyes are fitted to it."""
        import rerun as rr

        self._recording.set_time(at.SHOT, sequence=self._last_index + 1)
        self._set_state(at.SCAN_STATE, "finished")
        points, colours = scan_colours(scan, self._params.max_points_result)
        above = points[:, 2] > self._params.hide_above_m
        for path, part in ((at.CLOUD, ~above), (at.CLOUD_ABOVE, above)):
            cloud = rr.Points3D(points[part], colors=colours[part], radii=-self._params.point_radius_px)
            self._recording.log(path, cloud, static=True)
        if grid is not None:
            self.grid(grid)
            log_grid(self._recording, at.RESULT_GRID, grid, static=True)
        shown = points[~above] if (~above).any() else points
        if len(shown):
            low, high = np.percentile(shown, [2.0, 98.0], axis=0)
            eye = eye_over(low, high, float(np.median(scan.bearings)))
            blueprint = layout(rows=self._calibration.intrinsics.height, thesis=self._thesis is not None, eye=eye)
            # Whoever watches live keeps the eye they have chosen; the file opens with this one.
            self._recording.send_blueprint(blueprint, make_active=False, make_default=True)

    def close(self) -> None:
        """Write what is left and end; may be called twice, never raises, and never waits for ever."""
        if not self.alive:
            return
        if self._states.get(at.SCAN_STATE) == "scanning":
            self._end_state()
        self.alive = False
        closing = threading.Thread(target=self._recording.disconnect, name="view-close", daemon=True)
        closing.start()
        closing.join(CLOSE_TIMEOUT_S)
        if closing.is_alive():
            import rerun as rr

            rr.unregister_shutdown()  # it would wait for the same thing when the program ends
        if closing.is_alive() or (self.rrd is not None and not is_whole(self.rrd)):
            self.whole = False
            self.complain(f"{self.rrd} could not be written to its end; is the disk full?")

    def __enter__(self) -> View:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def complain(self, what: str) -> None:
        """Warn that the view fails, once for each cause."""
        if what not in self._complaints:
            self._complaints.add(what)
            logger.warning("the view has a fault, the scan goes on: %s", what)

    @isolated
    def _end_state(self) -> None:
        self._set_state(at.SCAN_STATE, "stopped")

    def _log_plots(self, step: Step) -> None:
        import rerun as rr

        log, shot = self._recording.log, step.shot
        T = self._calibration.mount.T_world_head(shot.bearing)
        log(at.HEAD, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        log(at.BEARING, rr.Scalars(np.degrees([shot.bearing_commanded, shot.bearing])))
        rows = step.profile.reason
        found = int((rows == Reason.OK).sum())
        log(at.ROWS, rr.Scalars(float(found)))
        self._set_state(at.LINE_STATE, line_state(found, len(rows), bool((rows == Reason.DAMAGED).all())))

    def _log_points(self, step: Step) -> None:
        import rerun as rr

        found = np.flatnonzero(step.profile.reason == Reason.OK)
        found = found[:: -(-len(found) // self._params.max_points_per_shot) or 1]
        T = self._calibration.mount.T_world_head(step.shot.bearing)
        points = (step.profile.points[found] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        z = points[:, 2]
        if len(z):
            # Percentiles: a single stray point would wash out the colours of all that follow.
            low, high = np.percentile(z, [8.0, 92.0])
            self._low, self._high = min(self._low, float(low)), max(self._high, float(high))
        colours = height_colours(z, self._low, min(self._high, self._params.hide_above_m))
        above = z > self._params.hide_above_m
        for path, part in ((at.POINTS, ~above), (at.POINTS_ABOVE, above)):
            if part.any():
                cloud = rr.Points3D(points[part], colors=colours[part], radii=-self._params.point_radius_px)
                self._recording.log(path, cloud)

    def _log_image(self, step: Step) -> None:
        """The picture and the line in it, always together: a line never lies on another shot's picture."""
        import rerun as rr

        picture = sent(step.shot.image, self._shrink, self._params.jpeg_quality)
        self._recording.log(at.IMAGE, rr.EncodedImage(contents=picture.data, media_type=picture.media_type))
        rows = np.flatnonzero(step.profile.reason == Reason.OK)
        # The viewer counts a pixel's centre as 0.5.
        line = (np.stack([step.line.column_px[rows], rows], axis=1) + 0.5) / self._shrink
        self._recording.log(at.LINE, rr.Points2D(line.astype(np.float32), colors=LASER_RED, radii=-1.0))

    def _log(self, level: str, text: str) -> None:
        import rerun as rr

        name = {"WARNING": "WARN"}.get(level.upper(), level.upper())
        self._recording.log(at.LOG, rr.TextLog(text, level=name if name in LEVELS else "INFO"))

    def _set_state(self, path: str, state: str) -> None:
        import rerun as rr

        if self._states.get(path) != state:
            self._states[path] = state
            self._recording.log(path, rr.StateChange(state=state))

    def _disk_has_room(self) -> bool:
        if self.rrd is None or shutil.disk_usage(self.rrd.parent).free >= MIN_FREE_BYTES:
            return True
        self.complain(f"less than {MIN_FREE_BYTES // 1_000_000} MB free for {self.rrd}; the view ends here")
        self.close()
        return False


def is_whole(rrd: Path) -> bool:
    """Whether a recording has its footer, the last thing that is written."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that the footer is missing is only a warning there
        try:
            RrdReader(str(rrd)).store()
        except (RuntimeError, OSError, Warning):
            return False
    return True


def line_state(found: int, rows: int, damaged: bool) -> str:
    """One word or two for how well a shot's line was found."""
    if damaged:
        return "damaged image"
    if found == 0:
        return "no line"
    return "line found" if 2 * found >= rows else "few rows"
