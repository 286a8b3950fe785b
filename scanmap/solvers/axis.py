"""`calibrate axis`: where the rotation axis is, from a board that stands still while the head turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, Uncertainty, moved, uncertainty_of
from scanmap.calibration.gates import GATES
from scanmap.calibration.uncertainty import INTRINSICS
from scanmap.errors import CalibrationError
from scanmap.geometry import HeadMount, inverse, rigid, rotation_z
from scanmap.solvers.axis_joint import joint_step
from scanmap.solvers.board import Board
from scanmap.solvers.board_pose import board_pose, project
from scanmap.solvers.detection import Rejected, View

Array = NDArray[np.float64]

VIEWS_LEAST = 5
# [deg] the head must turn this far with the board in sight.
SPAN_LEAST_DEG = 15.0
# [share] by which the turn seen in the pictures may differ from the bearings.
TURN_MOST = 0.03
# A view this many times worse than the median view, and worse than this, is of a board that moved.
ODD_TIMES, ODD_PX = 4.0, 0.5
ODD_SHARE = 0.34
# What the axis must be known to, one sigma.
OFFSET_SIGMA_MOST_M, TILT_SIGMA_MOST_DEG = 2e-3, 0.2
SOLVED = ("offset_x", "offset_y", "tilt_x", "tilt_y")


class AxisFit(NamedTuple):
    """How the head sits on its axis, solved from a board seen over several bearings."""

    mount: HeadMount
    own: Array  # (4, 4) covariance of SOLVED from the corners alone
    slope: Array  # (4, 9) by the intrinsics
    views: list[View]  # that count
    residuals: list[Array]  # per view (N, 2) [px]
    rejected: list[Rejected]
    span_deg: float  # bearings the board was seen over
    turn: float  # turn seen in the pictures over turn of the bearings: 1 for a stage that does what it says
    agrees: bool = True  # whether the turn wants a camera that the calibration's own uncertainty allows

    @property
    def rms_px(self) -> float:
        """Per corner, both coordinates [px]."""
        return float(np.sqrt(np.concatenate([(r**2).sum(axis=1) for r in self.residuals]).mean()))


def calibrate_axis(views: Sequence[View], board: Board, calibration: Calibration) -> AxisFit:
    """Solve head offset and tilt from views with bearings of one board that stands still.

    The height of the head's origin along the axis and the bearing called 0 are free by definition and stay as they
    are in `calibration`.

    Raises:
        CalibrationError: too few views or too small a turn, a motor that turns the other way or another angle than it
            says, a board that moved, or an axis that is not known well enough.
    """
    if any(not np.isfinite(view.bearing) for view in views):
        raise CalibrationError(
            "these pictures come without bearings: give a recording, or a folder with scan.csv (frame,bearing_deg)"
        )
    _require(views)
    poses = [board_pose(view, board, calibration.intrinsics) for view in views]
    T_head_camera = calibration.T_head_camera
    good, T_head_board, rejected = _one_way_round(views, [T_head_camera @ p.T_camera_board for p in poses], board)
    turn = _turn(good, T_head_board)
    fault = _turn_fault(turn)
    if fault:
        raise CalibrationError(fault)
    start = _start(good, T_head_board, calibration)
    while True:
        solved = _solve(good, board, calibration, start)
        rms = np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in solved.residuals])
        worst = int(rms.argmax())
        if rms[worst] <= max(ODD_TIMES * float(np.median(rms)), ODD_PX):
            break
        rejected.append(
            Rejected(good[worst].name, f"contradicts the others: {rms[worst]:.1f} px rms; did the board move?")
        )
        del good[worst]
        if len(rejected) > ODD_SHARE * len(views):
            raise CalibrationError(
                f"{len(rejected)} of {len(views)} views contradict the others: the board must stand still while "
                "the head turns, and the bearings must be those of the pictures"
            )
        _require(good)
    return _checked(_with_camera(solved, good, board, calibration, (rejected, turn)), calibration)


def with_axis(calibration: Calibration, fit: AxisFit) -> Calibration:
    """The calibration with this mount and what is known of its uncertainty."""
    known = uncertainty_of(calibration) or Uncertainty((), np.zeros((0, 0)))
    slope = np.zeros((4, len(known.names)))
    for k, name in enumerate(known.names):
        if name in INTRINSICS:
            slope[:, k] = fit.slope[:, INTRINSICS.index(name)]
    return replace(calibration, mount=fit.mount, covariance=known.joined(SOLVED, fit.own, slope).table())


class _Solved(NamedTuple):
    x: Array  # (10,) SOLVED, then rotation vector and position of the board in the axis frame
    residuals: list[Array]
    covariance: Array  # (4, 4)
    jacobian: Array  # of all residuals by x


def _require(views: Sequence[View]) -> None:
    if len(views) < VIEWS_LEAST:
        raise CalibrationError(
            f"the board is usable in {len(views)} pictures; at least {VIEWS_LEAST} are needed: turn in steps of a few "
            "degrees while the board stays in sight"
        )
    span = _span_deg(views)
    if span < SPAN_LEAST_DEG:
        raise CalibrationError(
            f"the board is in sight over {span:.1f} deg of bearing; at least {SPAN_LEAST_DEG:g} are needed: put it "
            "farther away, and sweep from one edge of the picture to the other"
        )


def _span_deg(views: Sequence[View]) -> float:
    return float(np.degrees(np.ptp([view.bearing for view in views]))) if views else 0.0


def _one_way_round(
    views: Sequence[View], T_head_board: list[Array], board: Board
) -> tuple[list[View], list[Array], list[Rejected]]:
    """The views with their corners numbered alike: a chessboard looks the same upside down.

    Between two bearings the board seems to turn by their difference; numbered the other way round it would be off by
    half a turn.
    """
    good, poses, rejected = list[View](), list[Array](), list[Rejected]()
    half_turn = np.diag([-1.0, -1.0, 1.0])
    middle = board.points[:, :2].min(axis=0) + board.points[:, :2].max(axis=0)
    for view, pose in zip(views, T_head_board, strict=True):
        if not np.isfinite(pose).all():
            rejected.append(Rejected(view.name, "no pose of the board fits its corners"))
            continue
        if poses and board.kind == "chessboard":
            flipped = pose @ rigid(half_turn, [*middle, 0.0])
            turned = [_angle(poses[0][:3, :3].T @ each[:3, :3]) for each in (pose, flipped)]
            expected = abs(view.bearing - good[0].bearing)
            if abs(turned[1] - expected) < abs(turned[0] - expected):
                pose, view = flipped, view._replace(ids=len(board.points) - 1 - view.ids)  # noqa: PLW2901
        good.append(view)
        poses.append(pose)
    return good, poses, rejected


def _angle(R: Array) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0)))


def _turns(views: Sequence[View], T_head_board: Sequence[Array]) -> tuple[Array, Array]:
    """Rotation vectors (P, 3) of the board in the head frame from one view to another, and bearing steps (P,)."""
    from scipy.spatial.transform import Rotation

    order = np.argsort([view.bearing for view in views])
    half = max(1, len(order) // 2)
    vectors, steps = [], []
    for i, j in zip(order[:-half], order[half:], strict=True):
        vectors.append(Rotation.from_matrix(T_head_board[j][:3, :3] @ T_head_board[i][:3, :3].T).as_rotvec())
        steps.append(views[j].bearing - views[i].bearing)
    return np.array(vectors), np.array(steps)


def _turn(views: Sequence[View], T_head_board: Sequence[Array]) -> float:
    """Turn of the head seen in the pictures over the turn of its bearings; about the head's up, so signed."""
    vectors, steps = _turns(views, T_head_board)
    axis = np.linalg.svd(vectors)[2][0]
    axis = axis if axis[2] > 0 else -axis
    # What stands still seems to turn the other way.
    return float(-(vectors @ axis) @ steps / (steps @ steps))


def _turn_fault(turn: float) -> str:
    """Why a stage that turns `turn` times what it says cannot be calibrated; empty if it can."""
    if turn < 0:
        return (
            "the motor turns the wrong way: bearings grow counter-clockwise seen from above, the pictures turn "
            "clockwise; invert its direction ($3 of GRBL, or swap one coil) or mirroring of the camera is on"
        )
    if abs(turn - 1.0) > TURN_MOST:
        return (
            f"the head turns {turn:.3f} deg for every degree of its bearing: correct the stage's steps per degree by "
            f"that factor (or is the board {'smaller' if turn > 1 else 'larger'} in the picture than the camera's "
            "calibration allows?)"
        )
    return ""


def _start(views: Sequence[View], T_head_board: Sequence[Array], calibration: Calibration) -> Array:
    """First guess (10,): axis direction from the turns, its place from the shifts."""
    from scipy.spatial.transform import Rotation

    vectors, _ = _turns(views, T_head_board)
    axis = np.linalg.svd(vectors)[2][0]
    axis = axis if axis[2] > 0 else -axis
    # Ry(ty) Rx(tx) axis = z.
    tilt_x = np.arctan2(axis[1], axis[2])
    tilt_y = -np.arctan2(axis[0], np.hypot(axis[1], axis[2]))
    mount = HeadMount((0.0, 0.0, calibration.mount.offset_m[2]), (float(np.degrees(tilt_x)), float(np.degrees(tilt_y))))
    # In the axis frame: Rz(b) (q + o) is the same point of the world for every b, q the board's origin.
    A, rhs = [], []
    q = [mount.T_axis_head() @ T for T in T_head_board]
    for view, each in zip(views, q, strict=True):
        R = rotation_z(view.bearing)[:2, :2]
        A.append(np.concatenate([R, -np.eye(2)], axis=1))
        rhs.append(-R @ each[:2, 3])
    found = np.linalg.lstsq(np.concatenate(A), np.concatenate(rhs), rcond=None)[0]
    mount = mount._replace(offset_m=(float(found[0]), float(found[1]), calibration.mount.offset_m[2]))
    middle = len(views) // 2
    T_world_board = mount.T_world_head(views[middle].bearing) @ T_head_board[middle]
    turn = Rotation.from_matrix(T_world_board[:3, :3]).as_rotvec()
    return np.concatenate([found[:2], [tilt_x, tilt_y], turn, T_world_board[:3, 3]])


def _mount(x: Array, calibration: Calibration) -> HeadMount:
    tilt = np.degrees(x[2:4])
    return HeadMount((float(x[0]), float(x[1]), calibration.mount.offset_m[2]), (float(tilt[0]), float(tilt[1])))


def _residuals(x: Array, views: Sequence[View], board: Board, calibration: Calibration) -> list[Array]:
    from scipy.spatial.transform import Rotation

    mount = _mount(x, calibration)
    T_world_board = rigid(Rotation.from_rotvec(x[4:7]).as_matrix(), x[7:10])
    T_camera_head = inverse(calibration.T_head_camera)
    found = []
    for view in views:
        T_camera_board = T_camera_head @ inverse(mount.T_world_head(view.bearing)) @ T_world_board
        found.append(view.corners - project(board.points[view.ids], T_camera_board, calibration.intrinsics))
    return found


def _solve(views: Sequence[View], board: Board, calibration: Calibration, start: Array) -> _Solved:
    from scipy.optimize import least_squares

    def off(x: Array) -> Array:
        # A guess that puts corners behind the camera is merely a bad one.
        flat: Array = np.nan_to_num(
            np.concatenate([r.ravel() for r in _residuals(x, views, board, calibration)]), nan=1e3
        )
        return flat

    found = least_squares(off, start, x_scale="jac", loss="soft_l1", f_scale=1.0, max_nfev=60)
    J, count = found.jac, len(found.fun)
    variance = float(found.fun @ found.fun) / max(1, count - 10)
    scale = np.linalg.norm(J, axis=0)
    covariance = variance * np.linalg.pinv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    return _Solved(found.x, _residuals(found.x, views, board, calibration), covariance[:4, :4], J)


def _with_camera(
    solved: _Solved, views: list[View], board: Board, calibration: Calibration, rest: tuple[list[Rejected], float]
) -> AxisFit:
    """The fit, its camera no surer than its calibration says: see `joint_step`."""
    change = _by_intrinsics(views, board, calibration, solved.x)
    joint = joint_step(np.concatenate([r.ravel() for r in solved.residuals]), solved.jacobian, change, calibration)
    rejected, turn = rest
    if joint is None or not joint.agrees:
        # Source: implicit function theorem at the least squares minimum.
        slope: Array = np.asarray(-np.linalg.lstsq(solved.jacobian, change, rcond=None)[0][:4], np.float64)
        own, x, residuals = solved.covariance, solved.x, solved.residuals
    else:
        own, x, slope = joint.own, solved.x + joint.step, joint.slope
        residuals = _residuals(x, views, board, moved(calibration, INTRINSICS, joint.camera))
    return AxisFit(
        _mount(x, calibration), own, slope, views, residuals, rejected, _span_deg(views), turn,
        joint is None or joint.agrees,
    )  # fmt: skip


def _by_intrinsics(views: Sequence[View], board: Board, calibration: Calibration, x: Array) -> Array:
    """Derivative (R, 9) of all residuals by the intrinsics."""
    own = calibration.intrinsics
    steps = [1e-3 * own.fx, 1e-3 * own.fy, 1e-3 * own.fx, 1e-3 * own.fx, 1e-2, 1e-2, 1e-3, 1e-3, 1e-2]
    columns = []
    for name, step in zip(INTRINSICS, steps, strict=True):
        both = [
            np.concatenate([r.ravel() for r in _residuals(x, views, board, moved(calibration, [name], by))])
            for by in (np.array([-step]), np.array([step]))
        ]
        columns.append((both[1] - both[0]) / (2.0 * step))
    return np.stack(columns, axis=1)


def _checked(fit: AxisFit, calibration: Calibration) -> AxisFit:
    """The fit, if every gate passes.

    Raises:
        CalibrationError: the first gate it fails, with what to do.
    """
    limit = GATES["axis_rms_px"].limit_at(calibration.intrinsics.width)
    if fit.rms_px > limit:
        raise CalibrationError(
            f"corners miss the turn about one axis by {fit.rms_px:.2f} px rms, over the gate of {limit:.2f}: "
            "does the head wobble, did the board move, are the bearings right?"
        )
    sigma = np.sqrt(np.diag(fit.own))
    offset, tilt = float(sigma[:2].max()), float(np.degrees(sigma[2:].max()))
    if offset > OFFSET_SIGMA_MOST_M or tilt > TILT_SIGMA_MOST_DEG:
        raise CalibrationError(
            f"the axis is only known to {1e3 * offset:.1f} mm and {tilt:.2f} deg ({1e3 * OFFSET_SIGMA_MOST_M:g} mm and "
            f"{TILT_SIGMA_MOST_DEG:g} deg needed): more bearings, a wider turn, a board larger in the picture"
        )
    return fit
