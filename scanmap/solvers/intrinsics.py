"""`calibrate camera`: intrinsics and distortion from views of a board, with their covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Intrinsics, Uncertainty
from scanmap.calibration.gates import GATES
from scanmap.calibration.uncertainty import INTRINSICS
from scanmap.errors import CalibrationError
from scanmap.solvers.board import Board
from scanmap.solvers.board_pose import project
from scanmap.solvers.coverage import VIEWS_LEAST, coverage_of, hints, tilt_spread_deg
from scanmap.solvers.detection import Rejected, View

Array = NDArray[np.float64]

# A view this many times worse than the median view, and worse than this, does not show this board at rest.
ODD_TIMES, ODD_PX = 3.0, 0.2
# No more than this share of the views may be odd: else nobody knows which.
ODD_SHARE = 0.34
# [share] the focal length must be known to.
FOCAL_SIGMA_MOST = 0.005
# [deg] least spread of the boards' directions: parallel boards leave the focal length open (Zhang 2000).
TILT_LEAST_DEG = 15.0
# [share of the picture's half] how far the principal point may lie from the middle.
CENTRE_MOST = 0.4


class CameraFit(NamedTuple):
    """A camera solved from views of a board."""

    intrinsics: Intrinsics
    uncertainty: Uncertainty
    views: list[View]  # that count
    poses: Array  # (V, 4, 4) T_camera_board
    residuals: list[Array]  # per view (N, 2) seen - predicted [px]
    rejected: list[Rejected]
    rms_px: float  # over all corners, per corner (both coordinates), as OpenCV counts it
    tilt_deg: float  # spread of the boards' directions
    covered: float  # share of the picture where corners were seen


def calibrate_camera(views: Sequence[View], board: Board, size: tuple[int, int]) -> CameraFit:
    """Solve pinhole and Brown-Conrady distortion from views of a board.

    Args:
        views: of one camera at one focus.
        board: what they show.
        size: width and height of the pictures [px].

    Raises:
        CalibrationError: too few views, all of them parallel, too many that contradict each other, or a result that
            is not known well enough; says which and what to do.

    Source: Zhang, "A flexible new technique for camera calibration", PAMI 2000.
    """
    _require_views(len(views), "")
    good, rejected = list(views), list[Rejected]()
    while True:
        intrinsics, poses, residuals = _solve(good, board, size)
        rms = np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in residuals])
        odd = rms > np.maximum(ODD_TIMES * np.median(rms), ODD_PX)
        if not odd.any():
            break
        # The worst first: it may have bent the others.
        worst = int(rms.argmax())
        rejected.append(Rejected(good[worst].name, f"contradicts the others: {rms[worst]:.2f} px rms"))
        del good[worst]
        if len(rejected) > ODD_SHARE * len(views):
            raise CalibrationError(
                f"{len(rejected)} of {len(views)} views contradict the others: is the board {board.name}, flat and "
                "stiff, and did the focus stay fixed?"
            )
    _require_views(len(good), f" after {len(rejected)} that contradict the others")
    return _checked(CameraFit(
        intrinsics,
        _uncertainty(good, board, intrinsics, poses, residuals),
        good, poses, residuals, rejected,
        float(np.sqrt(np.concatenate([(r**2).sum(axis=1) for r in residuals]).mean())),
        tilt_spread_deg(poses),
        coverage_of(good, size).share,
    ), size)  # fmt: skip


def distorted_camera(intrinsics: Intrinsics) -> tuple[Array, Array]:
    """Camera matrix (3, 3) and distortion (5,) as OpenCV takes them."""
    return intrinsics.matrix, np.array(intrinsics.distortion)


def _require_views(count: int, after: str) -> None:
    if count < VIEWS_LEAST:
        raise CalibrationError(
            f"{count} usable views{after}; at least {VIEWS_LEAST} are needed, 20 are good: hold the board near "
            "and far, "
            "tilted up, down, left and right, into every corner of the picture"
        )


def _solve(views: Sequence[View], board: Board, size: tuple[int, int]) -> tuple[Intrinsics, Array, list[Array]]:
    objects = [board.points[view.ids].astype(np.float32)[:, None] for view in views]
    corners = [view.corners.astype(np.float32)[:, None] for view in views]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    try:
        _, K, k, turns, shifts = cv2.calibrateCamera(objects, corners, size, None, None, criteria=criteria)
    except cv2.error as error:
        raise CalibrationError("no camera fits these views: are all of them of one camera and one board?") from error
    k = np.asarray(k).ravel()
    intrinsics = Intrinsics(
        *size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]),
        (float(k[0]), float(k[1]), float(k[2]), float(k[3]), float(k[4])),
    )  # fmt: skip
    if not np.isfinite([*K.ravel(), *k]).all():
        raise CalibrationError("no camera fits these views: are all of them of one camera and one board?")
    poses = np.array([_pose(turn, shift) for turn, shift in zip(turns, shifts, strict=True)])
    residuals = [
        view.corners - project(board.points[view.ids], pose, intrinsics)
        for view, pose in zip(views, poses, strict=True)
    ]
    return intrinsics, poses, residuals


def _pose(turn: Any, shift: Any) -> Array:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(turn)[0]
    T[:3, 3] = np.asarray(shift).ravel()
    return T


def _uncertainty(
    views: Sequence[View], board: Board, intrinsics: Intrinsics, poses: Array, residuals: list[Array]
) -> Uncertainty:
    """Covariance of the nine intrinsics: inverse of the normal matrix with every board's pose eliminated."""
    K, k = distorted_camera(intrinsics)
    total = np.zeros((9, 9))
    for view, pose in zip(views, poses, strict=True):
        turn = cv2.Rodrigues(pose[:3, :3])[0]
        slope = cv2.projectPoints(board.points[view.ids], turn, pose[:3, 3], K, k)[1]
        own, of_pose = slope[:, 6:15], slope[:, :6]
        cross = own.T @ of_pose
        total += own.T @ own - cross @ np.linalg.solve(of_pose.T @ of_pose, cross.T)
    count = sum(r.size for r in residuals)
    variance = sum(float((r**2).sum()) for r in residuals) / (count - 9 - 6 * len(views))
    scale = np.sqrt(np.diag(total))
    matrix = variance * np.linalg.inv(total / np.outer(scale, scale)) / np.outer(scale, scale)
    return Uncertainty(INTRINSICS, 0.5 * (matrix + matrix.T))


def _checked(fit: CameraFit, size: tuple[int, int]) -> CameraFit:
    """The fit, if every gate passes.

    Raises:
        CalibrationError: the first gate it fails, with what to do.
    """
    own, limit = fit.intrinsics, GATES["camera_rms_px"].limit_at(size[0])
    todo = "; ".join(hints(fit.views, fit.poses, size)) or "take more views"
    if fit.tilt_deg < TILT_LEAST_DEG:
        raise CalibrationError(
            f"all {len(fit.views)} views are nearly parallel (directions within {fit.tilt_deg:.0f} deg, "
            f"{TILT_LEAST_DEG:.0f} needed), which leaves the focal length open: tilt the board by 30 deg each way"
        )
    if fit.rms_px > limit:
        raise CalibrationError(
            f"corners miss the camera model by {fit.rms_px:.2f} px rms, over the gate of {limit:.2f}: is the "
            "board flat, "
            "the focus fixed, and every picture still?"
        )
    sigma = max(fit.uncertainty.sigma("fx") / own.fx, fit.uncertainty.sigma("fy") / own.fy)
    if sigma > FOCAL_SIGMA_MOST:
        raise CalibrationError(
            f"the focal length is only known to {100 * sigma:.2f} %, {100 * FOCAL_SIGMA_MOST:g} % is needed: {todo}"
        )
    off = max(abs(2 * own.cx / (size[0] - 1) - 1), abs(2 * own.cy / (size[1] - 1) - 1))
    if off > CENTRE_MOST or not 0.8 < own.fx / own.fy < 1.25:
        raise CalibrationError(
            f"the camera comes out as fx {own.fx:.0f}, fy {own.fy:.0f}, centre {own.cx:.0f}, {own.cy:.0f} of "
            f"{size[0]}x{size[1]} px, which no webcam is: {todo}"
        )
    return fit


def describe_fit(fit: CameraFit, say: Callable[[str], None]) -> None:
    """The result in words, a line each."""
    own, sure = fit.intrinsics, fit.uncertainty
    say(f"{len(fit.views)} views, {sum(len(v.ids) for v in fit.views)} corners, rms {fit.rms_px:.3f} px")
    say(f"fx {own.fx:.2f} +- {sure.sigma('fx'):.2f}, fy {own.fy:.2f} +- {sure.sigma('fy'):.2f} px")
    say(f"cx {own.cx:.2f} +- {sure.sigma('cx'):.2f}, cy {own.cy:.2f} +- {sure.sigma('cy'):.2f} px")
    terms = zip(INTRINSICS[4:], own.distortion, strict=True)
    say(", ".join(f"{name} {value:.4f} +- {sure.sigma(name):.4f}" for name, value in terms))
    say(f"boards tilted within {fit.tilt_deg:.0f} deg, corners in {100 * fit.covered:.0f} % of the picture")
    for wish in hints(fit.views, fit.poses, (own.width, own.height)):
        say(f"better still: {wish}")
    lost = _share_without_ray(own)
    if lost > 0:
        say(
            f"warning: in {100 * lost:.1f} % of the picture, at its rim, the distortion is not known and nothing "
            "can be measured: hold the board there too"
        )


def _share_without_ray(own: Intrinsics) -> float:
    """Share of the picture where the distortion polynomial folds over, as it does where no corner held it."""
    u, v = np.meshgrid(np.linspace(0, own.width - 1, 41), np.linspace(0, own.height - 1, 31))
    return float(np.isnan(own.rays(u.ravel(), v.ravel())[:, 0]).mean())
