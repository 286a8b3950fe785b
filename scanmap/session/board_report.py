"""A calibration from boards in words and pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanmap.calibration import Calibration, uncertainty_of
from scanmap.session.calibrating import Solved
from scanmap.solvers import board_figures, laser_plane
from scanmap.solvers.axis import SOLVED, AxisFit
from scanmap.solvers.board import Board
from scanmap.solvers.board_pose import board_pose
from scanmap.view.boards import write_boards


def laser_words(solved: Solved, base: Calibration) -> list[str]:
    """The laser plane in words; also what its scale tells against the calibration that it replaces."""
    fit: laser_plane.LaserFit = solved.fit
    made, before = solved.calibration, base.baseline_m
    near, far = fit.depths_m
    words = [
        f"{len(fit.lines)} boards, {sum(len(p) for p in fit.points)} points, {near:.2f} to {far:.2f} m; "
        f"rms {1e3 * fit.rms_m:.2f} mm ({fit.rms_px:.2f} px)",
        f"camera {1e3 * made.baseline_m:.2f} mm from the laser plane, turned in by {np.degrees(made.beta):.3f} deg",
        sure_words(made),
    ]
    if before > 1e-3 and abs(made.baseline_m / before - 1.0) > 0.05:
        words.append(
            f"warning: the calibration before had {1e3 * before:.1f} mm, a factor of "
            f"{made.baseline_m / before:.3f}: is the "
            f"square of {solved.views.board.name} measured on the print?"
        )
    return words


def board_words(board: Board, base: Calibration | None) -> list[str]:
    """A warning where the same board had other lengths in the calibration before."""
    before = str(base.meta.get("board", "")) if base is not None else ""
    if before in ("", board.name) or before.split(":")[:2] != board.name.split(":")[:2]:
        return []
    return [
        f"warning: the calibration before was made with {before}, this is {board.name}; pictures cannot tell a length: "
        "if it is the same board, one of them is wrong"
    ]


def sure_words(made: Calibration) -> str:
    """What the calibration's covariance means for the laser plane, one line."""
    known = uncertainty_of(made)
    if known is None:
        return "nothing is known of its uncertainty"
    turn = np.degrees(np.hypot(known.sigma("plane_nx"), known.sigma("plane_nz")))
    return f"known to {turn:.3f} deg and {1e3 * known.sigma('plane_d'):.3f} mm at the head's origin (one sigma)"


def axis_words(solved: Solved) -> list[str]:
    """The mount in words, a line each."""
    fit: AxisFit = solved.fit
    known = uncertainty_of(solved.calibration)
    sigma = [known.sigma(name) if known else 0.0 for name in SOLVED]
    (x, y, _), (tilt_x, tilt_y) = fit.mount.offset_m, fit.mount.tilt_deg
    doubt = (
        "warning: the turn seen in the pictures contradicts the camera's calibration by more than its uncertainty: "
        "did the focus change, or are the stage's steps per degree a little off?"
    )
    return [
        *([] if fit.agrees else [doubt]),
        f"{len(fit.views)} views over {fit.span_deg:.1f} deg, rms {fit.rms_px:.3f} px; the head turns "
        f"{fit.turn:.4f} deg "
        "for every degree of its bearing",
        f"head offset from the axis: x {1e3 * x:.2f} +- {1e3 * sigma[0]:.2f}, y {1e3 * y:.2f} +- "
        f"{1e3 * sigma[1]:.2f} mm",
        f"axis tilted about x {tilt_x:.3f} +- {np.degrees(sigma[2]):.3f}, about y {tilt_y:.3f} +- "
        f"{np.degrees(sigma[3]):.3f} deg",
        "height along the axis and the bearing called 0 cannot be seen from a board; they stay as they were",
    ]


def draw(part: str, solved: Solved, figures: Path | None, rrd: Path | None) -> list[Path]:
    """Write the pictures of the check; gives the files."""
    written: list[Path] = []
    made, fit, board = solved.calibration, solved.fit, solved.views.board
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        chart, boards = figures / f"{part}.png", figures / f"{part}-boards.png"
        size = solved.views.size
        if part == "camera":
            board_figures.draw_camera(fit, size, chart)
        elif part == "laser":
            board_figures.draw_laser(fit, size, chart)
        else:
            board_figures.draw_axis(fit, chart)
        lines = fit.lines if part == "laser" else ()
        views = [line.view for line in lines] or fit.views
        plane = fit.plane if part == "laser" else None
        board_figures.draw_boards(solved.pictures, board, views, made.intrinsics, boards, lines, plane)
        written += [path for path in (chart, boards) if path.is_file()]
    if rrd is not None:
        views = [line.view for line in fit.lines] if part == "laser" else fit.views
        poses = [board_pose(view, board, made.intrinsics).T_camera_board for view in views]
        points, off_m = (fit.points, fit.off_m) if part == "laser" else ([], [])
        write_boards(rrd, made, board.outline(), poses, points, off_m, solved.pictures[:1])
        written.append(rrd)
    return written
