"""Boards in front of a camera, from a file or live, made into a calibration.toml."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
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
from scanmap.errors import CalibrationError, CameraError, ConfigError
from scanmap.geometry import rigid
from scanmap.rig.camera import open_camera
from scanmap.session.rigs import open_rig
from scanmap.shot import Image, decode_image
from scanmap.solvers import laser_plane
from scanmap.solvers.axis import AxisFit, calibrate_axis, with_axis
from scanmap.solvers.board import Board
from scanmap.solvers.board_line import BoardLine, find_board_line
from scanmap.solvers.detection import Rejected, View
from scanmap.solvers.intrinsics import calibrate_camera
from scanmap.solvers.pictures import Picture, Views, collect, pictures_of, read_pictures
from scanmap.sweep import sweep

LIVE = "camera"
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
        """Whether a camera delivers the pictures; a folder or file of that name goes first."""
        if not self.source.startswith("/dev/") and Path(self.source).exists():
            return False
        if self.source == LIVE or "://" in self.source:
            return True
        return self.source.startswith("/dev/") or self.source.isdecimal()


def solve_camera(job: BoardJob, base: Calibration | None) -> Solved:
    """Intrinsics; the head is that of `base`, or none yet.

    Raises:
        CalibrationError: see `calibrate_camera`.
    """
    kept = _Kept()
    views = collect(_pictures(job), job.board, use=kept.keep, distinct=True, report=job.report)
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
    if not lines:
        raise CalibrationError("the laser line is visible on none of the boards, so the plane cannot be checked")
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

    views = collect(_pictures(job, turning=True), job.board, use=use, report=job.report)
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
        found = find_board_line(
            picture.image, picture.background, view, job.board, base.intrinsics, job.config.laserline, margin
        )
        if isinstance(found, Rejected):
            return found
        lines.append(found)
        return kept.keep(picture, view)

    views = collect(_pictures(job, laser=True), job.board, use=use, report=job.report)
    if not lines and not any("laser" in each.reason for each in views.rejected):
        views.require()
    return lines, views, kept


def _pictures(job: BoardJob, *, laser: bool = False, turning: bool = False) -> Iterator[Picture | Rejected]:
    if not job.is_live:
        return read_pictures(Path(job.source))
    config = job.config
    if job.source != LIVE:
        source: int | str = int(job.source) if job.source.isdecimal() else job.source
        config = config.model_copy(update={"camera": config.camera.model_copy(update={"source": source})})
        if turning:
            raise ConfigError("the axis needs a head that turns: SOURCE = camera with --config of your rig")
    return _turning(config) if turning else _live(config, laser=laser and job.source == LIVE)


def _turning(config: Config) -> Iterator[Picture | Rejected]:
    if config.rig != "hardware":
        raise ConfigError(
            "the axis needs a head that turns: SOURCE = camera with --config of your rig (rig = 'hardware')"
        )
    opened = open_rig(config, config.head())
    try:
        yield from pictures_of(sweep(opened.rig, config.sweep, sleep=opened.sleep, clock=opened.clock))
    finally:
        opened.close()


def _live(config: Config, *, laser: bool) -> Iterator[Picture | Rejected]:
    """Pictures as the camera sends them, until nobody asks for more; the laser lit where the rig can."""
    with ExitStack() as opened:
        if laser and config.rig == "hardware":
            rig = open_rig(config, config.head())
            opened.callback(rig.close)
            rig.rig.stage.laser(True)
            camera = rig.rig.camera
        else:
            camera = open_camera(config.camera)
            opened.callback(camera.close)
        number = 0
        while True:
            try:
                frame = camera.grab()
            except CameraError as error:
                if not number:
                    raise
                # What was collected before the camera went is not lost.
                yield Rejected("the camera", f"{error}; going on with the pictures so far")
                return
            yield Picture(f"picture {number}", decode_image(frame.image).image)
            number += 1


def _meta(job: BoardJob, base: Calibration | None = None, **counts: int) -> dict[str, Any]:
    before = dict(base.meta) if base is not None else {}
    today = datetime.now(UTC).date().isoformat()
    return {**before, **counts, "date": today, "board": job.board.name, "command": job.command}


def _without(meta: dict[str, Any], part: str) -> dict[str, Any]:
    missing = [each for each in meta.get("uncalibrated", ()) if each != part]
    rest = {key: value for key, value in meta.items() if key != "uncalibrated"}
    return {**rest, "uncalibrated": missing} if missing else rest
