"""Where a board stands in front of a known camera, and the head's frame before its laser plane."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Intrinsics
from scanmap.errors import CalibrationError
from scanmap.geometry import rigid
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


def head_frame_of(plane: Array) -> Array:
    """T_head_camera (4, 4) of the head frame that a laser plane (4,) in the camera frame defines.

    The laser plane is y = 0, z is the camera's up within it, x points away from the camera's back, and the origin is
    the foot of the camera's centre on the plane. For the thesis's head that is (0, baseline, 0) and a yaw of -beta.
    Where along the plane the laser sits, and where in it the beam points, no board can tell.
    """
    normal = plane[:3] / np.linalg.norm(plane[:3])
    # y is left, the camera's -x.
    y = -np.sign(normal[0] or 1.0) * normal
    up = np.array([0.0, -1.0, 0.0])
    z = up - (up @ y) * y
    if np.linalg.norm(z) < 0.1:
        raise CalibrationError(
            "the laser plane lies along the picture's rows: turn the camera or the laser by 90 deg, one column is "
            "measured per row"
        )
    z /= np.linalg.norm(z)
    R = np.stack([np.cross(y, z), y, z])
    distance = plane[3] / np.linalg.norm(plane[:3]) * float(np.sign(y @ normal))
    return rigid(R, [0.0, distance, 0.0])
