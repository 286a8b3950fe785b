"""Boards in front of a camera, from a file or live, made into a calibration.toml."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scanmap.calibration import Calibration, check_residuals
from scanmap.calibration.file import R_HEAD_CAMERA_FORWARD
from scanmap.calibration.gates import GATES
from scanmap.calibration.keeping import existing, save_beside
from scanmap.config import Config
from scanmap.errors import CalibrationError
from scanmap.geometry import rigid
from scanmap.session.board_source import is_live, pictures_of_source, turning_pictures
from scanmap.shot import Image
from scanmap.solvers import laser_plane
from scanmap.solvers.axis import AxisFit, calibrate_axis, with_axis
from scanmap.solvers.board import Board
from scanmap.solvers.board_line import BoardLine, find_board_line
from scanmap.solvers.detection import Rejected, View
from scanmap.solvers.intrinsics import calibrate_camera
from scanmap.solvers.pictures import Picture, Views, collect

# A new residual this many times the old one is no improvement worth losing the old calibration's place for.
WORSE_TIMES, WORSE_PX = 1.5, 0.1
SHOWN_PICTURES = 6
MARGIN_SQUARES = 3.0
Report = Callable[[Views, View | Rejected], bool]


class Solved(NamedTuple):
    """What a command found, with what its pictures are drawn from."""

    calibration: Calibration
    views: Views
    fit: Any  # CameraFit, LaserFit or AxisFit
    pictures: list[tuple[str, Image]]  # a few that count


@dataclass(frozen=True)
class BoardJob:
    """Where pictures come from, and what board is in them."""

    source: str  # path, `camera`, or a camera's device or URL
    board: Board
    config: Config
    report: Report = lambda views, last: True
    command: str = ""  # as the user wrote it

    @property
    def is_live(self) -> bool:
        """Whether a camera delivers the pictures."""
        return is_live(self.source)


def solve_camera(job: BoardJob, base: Calibration | None) -> Solved:
    """Intrinsics; the head is that of `base`, or none yet.

    Raises:
        CalibrationError: see `calibrate_camera`.
    """
    kept = _Kept()
    pictures = pictures_of_source(job.source, job.config)
    views = collect(pictures, job.board, use=kept.keep, distinct=True, held=job.is_live, report=job.report)
    views.require()
    fit = calibrate_camera(views.views, job.board, views.size)
    views.rejected.extend(fit.rejected)
    forward = rigid(R_HEAD_CAMERA_FORWARD, np.zeros(3))
    head = base or Calibration(fit.intrinsics, forward, np.array([0.0, 1.0, 0.0, 0.0]))
    meta = _meta(job, camera_views=len(fit.views))
    if base is None:
        meta["uncalibrated"] = ["laser plane", "axis"]
    made = replace(
        head, intrinsics=fit.intrinsics, residuals={"camera_rms_px": fit.rms_px}, meta=meta,
        covariance=fit.uncertainty.table(),
    )  # fmt: skip
    return Solved(made, views, fit, kept.of([view.name for view in fit.views]))


def solve_laser(job: BoardJob, base: Calibration, margin_m: float | None) -> Solved:
    """Laser plane; in the head frame of `base` where it has one, else in the one that plane and camera define.

    Raises:
        CalibrationError: see `fit_laser_plane`.
    """
    lines, views, kept = _lines(job, base, margin_m)
    fit = laser_plane.fit_laser_plane(lines, job.board, base.intrinsics)
    views.rejected.extend(fit.rejected)
    missing = list(base.meta.get("uncalibrated", ()))
    made = laser_plane.with_laser_plane(base, fit, keep_head="laser plane" not in missing)
    residuals = {
        **{key: value for key, value in base.residuals.items() if not key.startswith("self")},
        "laser_rms_px": fit.rms_px, "laser_rms_mm": 1e3 * fit.rms_m,
    }  # fmt: skip
    meta = _meta(job, base, laser_boards=len(fit.lines))
    return Solved(
        replace(made, residuals=residuals, meta=_without(meta, "laser plane")), views, fit,
        kept.of([line.view.name for line in fit.lines]),
    )  # fmt: skip


def check_laser(job: BoardJob, base: Calibration, margin_m: float | None) -> tuple[float, float, int]:
    """How far the lines of the pictures lie from the plane of `base`: rms [m], rms [columns], and on how many boards.

    Raises:
        CalibrationError: over the gate; the calibration is not of this head.
    """
    check_residuals(base)
    lines, _, _ = _lines(job, base, margin_m)
    rms_m, rms_px = laser_plane.residual_of(laser_plane.plane_in_camera(base), lines, job.board, base.intrinsics)
    limit = GATES["laser_rms_px"].limit_at(base.intrinsics.width)
    if not rms_px <= limit:
        raise CalibrationError(
            f"calibration refused: the laser line on {len(lines)} boards lies {1e3 * rms_m:.1f} mm rms "
            f"({rms_px:.1f} px) "
            f"off its laser plane, the gate is {limit:.2f} px; make a new one with scanmap calibrate laser"
        )
    return rms_m, rms_px, len(lines)


def solve_axis(job: BoardJob, base: Calibration) -> Solved:
    """Head offset and tilt.

    Raises:
        CalibrationError: see `calibrate_axis`.
    """
    if "laser plane" in base.meta.get("uncalibrated", ()):
        raise CalibrationError(
            "the head's frame hangs on its laser plane, which is not calibrated yet: "
            "scanmap calibrate laser comes first"
        )
    kept = _Kept()

    def use(picture: Picture, view: View) -> Rejected | None:
        if view.part is not None:
            across, down = view.part
            return Rejected(
                view.name,
                f"shows {across}x{down} corners of the chessboard, and which of them nobody can tell: the axis needs "
                "all of it, or a ChArUco board",
            )
        return kept.keep(picture, view)

    pictures = turning_pictures(job.source, job.config, base)
    views = collect(pictures, job.board, use=use, report=job.report)
    views.require()
    base.check_image(*views.size)
    fit: AxisFit = calibrate_axis(views.views, job.board, base)
    views.rejected.extend(fit.rejected)
    made = with_axis(base, fit)
    residuals = {**base.residuals, "axis_rms_px": fit.rms_px}
    meta = _meta(job, base, axis_views=len(fit.views))
    names = [view.name for view in fit.views]
    return Solved(replace(made, residuals=residuals, meta=_without(meta, "axis")), views, fit, kept.of(names))


def write_calibration(made: Calibration, out: Path, key: str) -> Path | None:
    """Write a calibration; the old one is kept beside, and stays where it is if the new one is worse.

    Args:
        key: the residual that tells how good the new part is.

    Raises:
        CalibrationError: the old one is clearly better.
    """
    check_residuals_of_new(made, key)
    old = existing(out)
    if old is not None and key in old.residuals:
        before, now = float(old.residuals[key]), float(made.residuals[key])
        if now > WORSE_TIMES * before + WORSE_PX:
            raise CalibrationError(
                f"{out} stays as it is: its {key} is {before:.3f}, the new one's {now:.3f}; take better pictures, or "
                "write the new one elsewhere with --out"
            )
    return save_beside(made, out)


def check_residuals_of_new(made: Calibration, key: str) -> None:
    """Raise CalibrationError where the part just solved is over its gate."""
    check_residuals(replace(made, residuals={key: made.residuals[key]}, meta={}))


class _Kept:
    """A few pictures to draw on, from the first to the last."""

    def __init__(self) -> None:
        self.pictures: list[tuple[str, Image]] = []
        self.every = 1
        self.count = 0

    def keep(self, picture: Picture, view: View) -> Rejected | None:
        if self.count % self.every == 0:
            self.pictures.append((picture.name, picture.image))
            if len(self.pictures) > 4 * SHOWN_PICTURES:
                del self.pictures[1::2]
                self.every *= 2
        self.count += 1
        return None

    def of(self, names: list[str]) -> list[tuple[str, Image]]:
        """Those of the named views, at most SHOWN_PICTURES, evenly."""
        some = [picture for picture in self.pictures if picture[0] in set(names)]
        if not some:
            return []
        return [some[k] for k in np.unique(np.linspace(0, len(some) - 1, SHOWN_PICTURES).astype(int))]


def _lines(job: BoardJob, base: Calibration, margin_m: float | None) -> tuple[list[BoardLine], Views, _Kept]:
    margin = MARGIN_SQUARES * job.board.square_m if margin_m is None else margin_m
    lines: list[BoardLine] = []
    kept = _Kept()

    def use(picture: Picture, view: View) -> Rejected | None:
        base.check_image(picture.image.shape[1], picture.image.shape[0])
        seen_by = base.intrinsics, job.config.laserline, margin, picture.rounding
        found = find_board_line(picture.image, picture.background, view, job.board, *seen_by)
        if isinstance(found, Rejected):
            return found
        lines.append(found)
        return kept.keep(picture, view)

    def report(views: Views, last: View | Rejected) -> bool:
        of_last = lines[-1] if lines and isinstance(last, View) else None
        views.line = np.stack([of_last.columns, of_last.rows], axis=-1) if of_last is not None else None
        return job.report(views, last)

    pictures = pictures_of_source(job.source, job.config, base, laser=True)
    live = job.is_live
    views = collect(pictures, job.board, use=use, distinct=live, held=live, report=report)
    if lines:
        return lines, views, kept
    unlit = sum("laser" in each.reason for each in views.rejected)
    if not unlit:
        views.require()
    raise CalibrationError(
        f"the laser line is visible on none of {unlit} boards: is the laser on, does it cross the squares, is the room "
        "dim enough?"
        if unlit
        else f"no board counts: {views.rejected[0].reason}"
    )


def _meta(job: BoardJob, base: Calibration | None = None, **counts: int) -> dict[str, Any]:
    before = dict(base.meta) if base is not None else {}
    today = datetime.now(UTC).date().isoformat()
    return {**before, **counts, "date": today, "board": job.board.name, "command": job.command}


def _without(meta: dict[str, Any], part: str) -> dict[str, Any]:
    missing = [each for each in meta.get("uncalibrated", ()) if each != part]
    rest = {key: value for key, value in meta.items() if key != "uncalibrated"}
    return {**rest, "uncalibrated": missing} if missing else rest
