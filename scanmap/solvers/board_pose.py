"""Where a board stands in front of a known camera."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Intrinsics
from scanmap.solvers.board import Board
from scanmap.solvers.detection import View

Array = NDArray[np.float64]


class BoardPose(NamedTuple):
    """Pose of a board in one view; NaN where none fits."""

    T_camera_board: Array  # (4, 4) [m]
    residuals: Array  # (N, 2) seen - predicted [px]

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the corners from where the pose has them [px]."""
        return float(np.sqrt((self.residuals**2).sum(axis=1).mean()))


def board_pose(view: View, board: Board, intrinsics: Intrinsics) -> BoardPose:
    """Pose of the board by its corners.

    Of the two poses that a flat target seen from afar can have, the one that fits better.

    Source: Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014; refined by
    Levenberg-Marquardt on the reprojection error.
    """
    K, k = intrinsics.matrix, np.array(intrinsics.distortion)
    points, corners = board.points[view.ids], np.ascontiguousarray(view.corners)
    # Its plane-based solver wants the points around its origin.
    centre = points.mean(axis=0)
    found, turns, shifts, _ = cv2.solvePnPGeneric(points - centre, corners, K, k, flags=cv2.SOLVEPNP_IPPE)
    best: BoardPose | None = None
    for turn, shift in zip(turns, shifts, strict=True) if found else ():
        better = cv2.solvePnPRefineLM(points - centre, corners, K, k, turn.copy(), shift.copy())
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(better[0])[0]
        T[:3, 3] = better[1].ravel() - T[:3, :3] @ centre
        seen = BoardPose(T, corners - project(points, T, intrinsics))
        if shift.ravel()[2] > 0 and (best is None or seen.rms_px < best.rms_px):
            best = seen
    if best is None or not np.isfinite(best.residuals).all():
        return BoardPose(np.full((4, 4), np.nan), np.full((len(points), 2), np.nan))
    return best


def project(points: Array, T_camera_board: Array, intrinsics: Intrinsics) -> Array:
    """Pixels (N, 2) of points (N, 3) in the board's frame [m]."""
    return intrinsics.project(points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])


def rough_camera(size: tuple[int, int]) -> Intrinsics:
    """An ordinary webcam of pictures of `size` = width, height [px], for a first look: 60 deg wide."""
    width, height = size
    f = width / (2.0 * np.tan(np.radians(30.0)))
    return Intrinsics(width, height, float(f), float(f), (width - 1) / 2, (height - 1) / 2)
