"""`calibrate laser`: the laser plane from its line on a board, with its covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, Intrinsics, Uncertainty, moved, uncertainty_of
from scanmap.calibration.gates import GATES
from scanmap.calibration.uncertainty import INTRINSICS, PLANE
from scanmap.errors import CalibrationError
from scanmap.geometry import fit_plane, inverse
from scanmap.solvers.board import Board
from scanmap.solvers.board_line import BoardLine, points_on_board
from scanmap.solvers.board_pose import head_frame_of
from scanmap.solvers.detection import Rejected

Array = NDArray[np.float64]

LINES_LEAST = 5
# A board whose line lies this far off the plane of the others shows something else, or moved [px at 1600 or less].
ODD_PX = 3.0
ODD_SHARE = 0.34
# Nearest and farthest tenth of the points: boards all at one distance leave the plane's turn open.
DEPTH_RATIO_LEAST = 1.2
# What the plane must be known to, one sigma.
ANGLE_SIGMA_MOST_DEG = 0.2
OFFSET_SIGMA_MOST_M = 1e-3
_TURNS = 30


class LaserFit(NamedTuple):
    """A laser plane solved from boards."""

    plane: Array  # (4,) n.x + d = 0 in the camera frame [m]
    covariance: Array  # (4, 4) of the plane in the camera frame, from the boards alone
    slope: Array  # (4, 9) by the intrinsics
    lines: list[BoardLine]  # that count
    points: list[Array]  # per line (N, 3) camera frame [m]
    off_m: list[Array]  # per line (N,) distance from the plane [m]
    off_px: list[Array]  # per line (N,) the same in image columns
    rejected: list[Rejected]

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the points from the plane [m]."""
        return _rms(self.off_m)

    @property
    def rms_px(self) -> float:
        """The same in image columns."""
        return _rms(self.off_px)

    @property
    def depths_m(self) -> tuple[float, float]:
        """Nearest and farthest tenth of the points along the camera's axis [m]."""
        low, high = np.percentile(np.concatenate([p[:, 2] for p in self.points]), [10, 90])
        return float(low), float(high)


def fit_laser_plane(lines: Sequence[BoardLine], board: Board, intrinsics: Intrinsics) -> LaserFit:
    """Solve the laser plane in the camera frame from its lines on boards.

    Minimises the distance of the lines from the plane in image columns, where their noise is even, with Huber's
    weights; the covariance counts each board as one measurement, for its pose moves all of its points together.

    Raises:
        CalibrationError: too few boards, all at one distance, too many that contradict each other, or a plane that is
            not known well enough.
    """
    _require_lines(len(lines), "")
    clouds = [points_on_board(line, board, intrinsics) for line in lines]
    start = _consensus(clouds, intrinsics.width)
    bound = ODD_PX * max(1.0, intrinsics.width / 1600.0)
    good, rejected = list(range(len(lines))), list[Rejected]()
    while True:
        plane, normal, gradients = _refined(start, [clouds[k] for k in good])
        median = [float(np.median(np.abs(_off_px(plane, clouds[k])))) for k in good]
        worst = int(np.argmax(median))
        # A board that says the same as the others, only less well, stays.
        if median[worst] <= max(bound / 2, 6.0 * float(np.median(median))):
            break
        rejected.append(
            Rejected(lines[good[worst]].view.name, f"its line is {median[worst]:.1f} px off the others' plane")
        )
        del good[worst]
        if len(rejected) > ODD_SHARE * len(lines):
            raise CalibrationError(
                f"the lines on {len(rejected)} of {len(lines)} boards lie on no common plane: is the laser one "
                "straight line, fixed to the camera, and is the camera's calibration of this camera?"
            )
    _require_lines(len(good), f" after {len(rejected)} that contradict the others")
    chosen = [clouds[k] for k in good]
    fit = LaserFit(
        plane, _sandwich(plane, normal, gradients),
        _slope_by_intrinsics(plane, [lines[k] for k in good], board, intrinsics),
        [lines[k] for k in good], [p for p, _ in chosen], [p @ plane[:3] + plane[3] for p, _ in chosen],
        [_off_px(plane, cloud) for cloud in chosen], rejected,
    )  # fmt: skip
    return _checked(fit, intrinsics)


def with_laser_plane(calibration: Calibration, fit: LaserFit, *, keep_head: bool) -> Calibration:
    """The calibration with this laser plane and what is known of its uncertainty.

    Args:
        calibration: gives the intrinsics that `fit` was made with.
        keep_head: leave `T_head_camera` as it is and express the plane in it; else draw the head's frame anew from
            camera and plane (`head_frame_of`).
    """
    T = calibration.T_head_camera if keep_head else head_frame_of(fit.plane)
    carry = inverse(T).T  # takes plane coordinates from the camera to the head frame
    plane = carry @ fit.plane
    before = calibration.laser_plane if keep_head else np.array([0.0, 1.0, 0.0, 0.0])
    side = 1.0 if plane[:3] @ before[:3] >= 0 else -1.0
    known = uncertainty_of(calibration) or Uncertainty((), np.zeros((0, 0)))
    known = known.without(() if keep_head else [name for name in known.names if name not in INTRINSICS])
    slope = np.zeros((4, len(known.names)))
    for k, name in enumerate(known.names):
        if name in INTRINSICS:
            slope[:, k] = side * carry @ fit.slope[:, INTRINSICS.index(name)]
    joined = known.joined(PLANE, carry @ fit.covariance @ carry.T, slope)
    plane = side * plane / np.linalg.norm(plane[:3]) if keep_head else before
    mount = calibration.mount if keep_head else type(calibration.mount)()
    return replace(calibration, T_head_camera=T, laser_plane=plane, mount=mount, covariance=joined.table())


def residual_of(plane: Array, lines: Sequence[BoardLine], board: Board, intrinsics: Intrinsics) -> tuple[float, float]:
    """How far the lines lie from a given plane (4,) of the camera frame: rms [m], rms [image columns].

    A few boards that show something else are left out as in the fit; many are the plane's fault and count.
    """
    clouds = [points_on_board(line, board, intrinsics) for line in lines]
    bound = 0.5 * ODD_PX * max(1.0, intrinsics.width / 1600.0)
    near = [cloud for cloud in clouds if np.median(np.abs(_off_px(plane, cloud))) <= bound]
    clouds = near if len(near) >= (1.0 - ODD_SHARE) * len(clouds) else clouds
    return _rms([p @ plane[:3] + plane[3] for p, _ in clouds]), _rms([_off_px(plane, cloud) for cloud in clouds])


def plane_in_camera(calibration: Calibration) -> Array:
    """The calibration's laser plane (4,) in the camera frame."""
    plane: Array = calibration.T_head_camera.T @ calibration.laser_plane
    return plane


def _require_lines(count: int, after: str) -> None:
    if count < LINES_LEAST:
        raise CalibrationError(
            f"the laser line is usable on {count} boards{after}; at least {LINES_LEAST} are needed, 15 are good: "
            "hold the board near and far and turned both ways, with the line across its squares"
        )


def _rms(values: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(list(values)) ** 2)))


def _off_px(plane: Array, cloud: tuple[Array, Array]) -> Array:
    """Distance (N,) of a line from the plane, in image columns."""
    points, per_px = cloud
    off: Array = (points @ plane[:3] + plane[3]) / _per_column(plane, per_px)
    return off


def _per_column(plane: Array, per_px: Array) -> Array:
    """How the distance from the plane grows with the column (N,), kept from zero where a board lies in the plane."""
    rate = per_px @ plane[:3]
    least = 0.2 * np.linalg.norm(per_px, axis=1)
    return np.where(np.abs(rate) < least, np.where(rate < 0, -least, least), rate)


def _consensus(clouds: Sequence[tuple[Array, Array]], width: int) -> Array:
    """The plane through two of the lines that most of the lines lie on."""
    few = [(p[:: max(1, len(p) // 12)], d[:: max(1, len(p) // 12)]) for p, d in clouds]
    chosen = np.unique(np.linspace(0, len(few) - 1, _TURNS).astype(int))
    bound = ODD_PX * max(1.0, width / 1600.0)
    best, score = np.zeros(4), -1.0
    for i, j in combinations(chosen, 2):
        found = fit_plane(np.concatenate([few[i][0], few[j][0]]))
        plane = np.append(found.normal, found.d)
        off = [np.median(np.abs(_off_px(plane, cloud))) for cloud in few]
        # Full marks on the plane, none beyond the bound.
        value = float(np.clip(1.0 - np.array(off) / bound, 0.0, None).sum())
        if value > score:
            best, score = plane, value
    return best


def _refined(start: Array, clouds: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Plane (4,), each board's normal matrix (V, 3, 3) and gradient (V, 3) in the tangent of the plane."""
    points = np.concatenate([p for p, _ in clouds])
    per_px = np.concatenate([d for _, d in clouds])
    board = np.repeat(np.arange(len(clouds)), [len(p) for p, _ in clouds])
    plane = start
    for _ in range(15):
        basis = _tangent(plane)
        rate = _per_column(plane, per_px)
        off = (points @ plane[:3] + plane[3]) / rate
        J = np.concatenate([points @ basis[:3, :2], np.ones((len(points), 1))], axis=1) / rate[:, None]
        limit = 1.5 * 1.4826 * float(np.median(np.abs(off))) + 1e-9
        weight = np.minimum(1.0, limit / np.maximum(np.abs(off), 1e-12))
        A = (J * weight[:, None]).T @ J
        step = -np.linalg.lstsq(A, J.T @ (weight * off), rcond=None)[0]
        plane = plane + basis @ step
        plane = plane / np.linalg.norm(plane[:3])
        if np.abs(step).max() < 1e-10:
            break
    gradients = np.zeros((len(clouds), 3))
    np.add.at(gradients, board, J * (weight * off)[:, None])
    normal = np.zeros((len(clouds), 3, 3))
    np.add.at(normal, board, (J * weight[:, None])[:, :, None] * J[:, None, :])
    return plane, normal, gradients


def _tangent(plane: Array) -> Array:
    """(4, 3): two turns of the normal and the offset."""
    aside = np.linalg.svd(plane[None, :3])[2][1:]
    basis = np.zeros((4, 3))
    basis[:3, :2] = aside.T
    basis[3, 2] = 1.0
    return basis


def _sandwich(plane: Array, normal: Array, gradients: Array) -> Array:
    """(4, 4) covariance with each board as one measurement.

    A board far from the others draws the plane to itself and hides its own error, so every board counts as far off as
    it would be from the plane of the others alone.

    Source: Bell and McCaffrey, "Bias reduction in standard errors for linear regression", 2002 (the jackknife form).
    """
    count = len(gradients)
    inverse_A = np.linalg.pinv(normal.sum(axis=0))
    apart = np.array([np.linalg.pinv(np.eye(3) - of_board @ inverse_A) for of_board in normal])
    alone = np.einsum("vij,vj->vi", apart, gradients)
    inner = inverse_A @ (alone.T @ alone) @ inverse_A * (count - 1) / count
    basis = _tangent(plane)
    covariance: Array = basis @ inner @ basis.T
    return covariance


def _slope_by_intrinsics(plane: Array, lines: Sequence[BoardLine], board: Board, own: Intrinsics) -> Array:
    """Derivative (4, 9) of the plane by the intrinsics, poses of the boards solved anew."""
    slope = np.zeros((4, 9))
    head = Calibration(own, np.eye(4), np.array([0.0, 1.0, 0.0, 0.0]))
    steps = [1e-3 * own.fx, 1e-3 * own.fy, 1e-3 * own.fx, 1e-3 * own.fx, 1e-2, 1e-2, 1e-3, 1e-3, 1e-2]
    for k, (name, step) in enumerate(zip(INTRINSICS, steps, strict=True)):
        both = []
        for by in (-step, step):
            camera = moved(head, [name], np.array([by])).intrinsics
            both.append(_refined(plane, [points_on_board(line, board, camera) for line in lines])[0])
        slope[:, k] = (both[1] - both[0]) / (2.0 * step)
    return slope


def _checked(fit: LaserFit, intrinsics: Intrinsics) -> LaserFit:
    """The fit, if every gate passes.

    Raises:
        CalibrationError: the first gate it fails, with what to do.
    """
    near, far = fit.depths_m
    if far < DEPTH_RATIO_LEAST * near:
        raise CalibrationError(
            f"all boards are at one distance ({near:.2f} to {far:.2f} m), which leaves the laser plane's "
            "direction open: hold the board near and far"
        )
    limit = GATES["laser_rms_px"].limit_at(intrinsics.width)
    if fit.rms_px > limit:
        raise CalibrationError(
            f"the lines miss the laser plane by {fit.rms_px:.2f} px rms ({1e3 * fit.rms_m:.2f} mm), over the gate of "
            f"{limit:.2f} px: is the laser fixed to the camera, and one straight line?"
        )
    angle = float(np.degrees(np.sqrt(np.trace(fit.covariance[:3, :3]))))
    # The offset is asked for amid the boards: at the camera it swings with the normal.
    middle = np.append(np.concatenate(fit.points).mean(axis=0), 1.0)
    offset = float(np.sqrt(max(middle @ fit.covariance @ middle, 0.0)))
    if angle > ANGLE_SIGMA_MOST_DEG or offset > OFFSET_SIGMA_MOST_M:
        raise CalibrationError(
            f"the laser plane is only known to {angle:.2f} deg and {1e3 * offset:.2f} mm ({ANGLE_SIGMA_MOST_DEG} "
            f"deg and {1e3 * OFFSET_SIGMA_MOST_M:g} mm needed): more boards, nearer and farther, turned both ways"
        )
    return fit
