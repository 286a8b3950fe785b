"""The laser line on a board: which rows of a picture show it, and where it is in space."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Intrinsics
from scanmap.geometry import intersect_rays_plane
from scanmap.laserline import LaserLineParams, Reason, Rounding, find_laser_line
from scanmap.shot import Image
from scanmap.solvers.board import Board
from scanmap.solvers.board_pose import BoardPose, board_pose, project
from scanmap.solvers.detection import Rejected, View

Array = NDArray[np.float64]

# A flat board shows a straight line: rows further off it than this are no board [px at a width of 1600 or less].
STRAIGHT_PX = 1.0
ROWS_LEAST = 30
# [squares] the line must be at least this long to be told from anything else.
LENGTH_LEAST = 1.5
# [share] of the rows on the squares themselves that must lie on one straight line.
STRAIGHT_SHARE = 0.5
# A corner this many times further off than the median one stands under the laser line.
ODD_CORNER, ODD_CORNER_PX = 4.0, 0.4


class BoardLine(NamedTuple):
    """One picture of the laser line on the board."""

    view: View
    columns: Array  # (N,) of the line [px]
    rows: Array  # (N,)
    sigma_px: Array  # (N,)


def find_board_line(
    image: Image,
    background: Image | None,
    view: View,
    board: Board,
    intrinsics: Intrinsics,
    params: LaserLineParams,
    margin_m: float,
    rounding: Rounding | None = None,
) -> BoardLine | Rejected:
    """The laser line on a board that was found in a picture.

    Args:
        image: (H, W, 3) BGR or (H, W) grey, laser on.
        background: the same view with the laser off, or None.
        view: the board.
        board: what it is.
        intrinsics: of the camera.
        params: how the line is found.
        margin_m: how far the flat sheet goes on beyond the squares [m].
        rounding: of the file that the image was.
    """
    view, pose = _steady(view, board, intrinsics)
    if not np.isfinite(pose.residuals).all() or pose.rms_px > 2.0 * max(1.0, intrinsics.width / 1600.0):
        return Rejected(
            view.name, f"the board fits the camera only to {pose.rms_px:.1f} px rms: another camera or board?"
        )
    seen = view.board_seen(board)
    window = board_window(pose, seen, intrinsics, margin_m)
    line = find_laser_line(image, params, background, window, rounding)
    rows = np.flatnonzero(line.reason == Reason.OK)
    if len(rows) < ROWS_LEAST:
        return Rejected(view.name, f"laser not visible on the board: {len(rows)} rows with a line, {ROWS_LEAST} needed")
    columns = line.column_px[rows]
    inner = board_window(pose, seen, intrinsics, 0.0)[rows]
    on_squares = (columns >= inner[:, 0]) & (columns <= inner[:, 1])
    on_line = straight_rows(columns, rows.astype(np.float64), intrinsics, on_squares)
    fault = _fault(on_line, rows, columns, on_squares, board, pose, intrinsics)
    if fault:
        return Rejected(view.name, fault)
    return BoardLine(view, columns[on_line], rows[on_line].astype(np.float64), line.sigma_px[rows[on_line]])


def board_window(pose: BoardPose, board: Board, intrinsics: Intrinsics, margin_m: float) -> Array:
    """First and last column (H, 2) of the board and its margin per image row; NaN in rows without."""
    mask = np.zeros((intrinsics.height, intrinsics.width), np.uint8)
    outline = _edge_points(board.outline(margin_m))
    pixels = project(outline, pose.T_camera_board, intrinsics)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    cv2.fillPoly(mask, [np.rint(np.clip(pixels, -30000, 30000)).astype(np.int32)], 1)
    window = np.full((intrinsics.height, 2), np.nan)
    some = np.flatnonzero(mask.any(axis=1))
    window[some, 0] = mask[some].argmax(axis=1)
    window[some, 1] = intrinsics.width - 1 - mask[some, ::-1].argmax(axis=1)
    return window


def straight_rows(
    columns: Array, rows: Array, intrinsics: Intrinsics, on_squares: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which pixels (N,) lie on the one straight line, distortion removed, that most of them lie on.

    Where enough of them are on the squares, these say which line it is: beside the sheet there may be a table close
    behind it. Every pair of a sample is tried: what a random sample would find, without chance.
    """
    rays = intrinsics.rays(columns, rows)
    x, y = rays[:, 0], rays[:, 1]
    tolerance = STRAIGHT_PX * max(1.0, intrinsics.width / 1600.0) / intrinsics.fx
    sure = on_squares if on_squares.sum() >= ROWS_LEAST else np.ones(len(rows), dtype=bool)
    at = np.flatnonzero(sure)
    sample = at[np.unique(np.linspace(0, len(at) - 1, 48).astype(int))]
    i, j = (sample[k] for k in np.triu_indices(len(sample), 8))
    slope = (x[j] - x[i]) / (y[j] - y[i])
    off = np.abs(x[None, :] - x[i, None] - slope[:, None] * (y[None, :] - y[i, None]))
    best: NDArray[np.bool_] = off[np.argmax((off[:, sure] < tolerance).sum(axis=1))] < tolerance
    for _ in range(3):
        fit = np.polynomial.Polynomial.fit(y[best], x[best], 1)
        best = np.asarray(np.abs(x - fit(y)) < tolerance)
        if best.sum() < 8:
            break
    return best


def points_on_board(line: BoardLine, board: Board, intrinsics: Intrinsics) -> tuple[Array, Array]:
    """Points (N, 3) of the line in the camera frame [m], and how they move with the column (N, 3) [m/px]."""
    T = board_pose(line.view, board, intrinsics).T_camera_board
    plane = np.append(T[:3, 2], -T[:3, 2] @ T[:3, 3])

    def met(columns: Array) -> Array:
        rays = intrinsics.rays(columns, line.rows)
        return rays * intersect_rays_plane(np.zeros(3), rays, plane)[:, None]

    return met(line.columns), met(line.columns + 0.5) - met(line.columns - 0.5)


def _steady(view: View, board: Board, intrinsics: Intrinsics) -> tuple[View, BoardPose]:
    """The view without the corners that the laser line pulled aside, and its pose."""
    pose = board_pose(view, board, intrinsics)
    off = np.linalg.norm(pose.residuals, axis=1)
    keep = off <= max(ODD_CORNER * float(np.median(off)), ODD_CORNER_PX)
    if not np.isfinite(off).all() or keep.all() or keep.sum() < max(12, 0.6 * len(keep)):
        return view, pose
    view = view._replace(ids=view.ids[keep], corners=view.corners[keep], dropped=view.dropped + int((~keep).sum()))
    return view, board_pose(view, board, intrinsics)


def _fault(
    on_line: NDArray[np.bool_], rows: NDArray[np.intp], columns: Array, on_squares: NDArray[np.bool_],
    board: Board, pose: BoardPose, own: Intrinsics,
) -> str:  # fmt: skip
    """Why a line is not to be believed; empty if it is."""
    if on_line.sum() < ROWS_LEAST:
        return f"laser not visible on the board: {int(on_line.sum())} rows on a straight line, {ROWS_LEAST} needed"
    share = float(on_line[on_squares].mean()) if on_squares.sum() >= ROWS_LEAST else float(on_line.mean())
    if share < STRAIGHT_SHARE:
        return f"only {100 * share:.0f} % of the rows lie on one straight line: is it the laser, and is the board flat?"
    corners = project(board.points[[0, 1]], pose.T_camera_board, own)
    length = np.hypot(np.ptp(rows[on_line]), np.ptp(columns[on_line])) / np.linalg.norm(corners[1] - corners[0])
    if length < LENGTH_LEAST:
        return f"the line crosses only {length:.1f} squares of the board, {LENGTH_LEAST} needed"
    return ""


def _edge_points(quad: Array) -> Array:
    """(40, 3) points along the edges of a quadrilateral (4, 3): distortion bends its edges."""
    share = np.linspace(0.0, 1.0, 10, endpoint=False)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in zip(quad, np.roll(quad, -1, axis=0), strict=True)])
