"""What a head would measure, before it is built: reach, range step, error bars, field of view, points on a wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.errors import CalibrationError
from scanmap.triangulation import TriangulationParams, column_window, locate

Array = NDArray[np.float64]

RANGES_M = (0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0)


@dataclass(frozen=True)
class Design:
    """One head in numbers; the middle row stands for all where nothing else is said."""

    name: str
    baseline_m: float
    beta_deg: float
    alpha_deg: float  # half the horizontal view
    size: tuple[int, int]  # [px]
    nearest_m: float  # range at the image's border, or range_min where that is farther
    farthest_m: float  # range_max, or where the view ends
    column_infinity: float  # NaN where no ray is parallel to the laser plane
    columns_used: float  # between nearest and farthest
    view_up_deg: float  # of the laser plane, from the head's origin, at 2 m
    view_down_deg: float
    rows_per_deg: float
    ranges_m: Array  # (N,)
    column: Array  # (N,) where the line stands; NaN outside of the view or the limits
    step_m: Array  # (N,) range by one column
    sigma_m: Array  # (N,) of one point
    model_error: str  # how the thesis's models do, or why they do not apply


def evaluate(
    name: str, head: Calibration, limits: TriangulationParams, sigma_px: float, ranges_m: Array | None = None
) -> Design:
    """What a head measures.

    Args:
        name: of the head in tables.
        head: any head; its columns are sampled, so distortion counts.
        limits: the ranges that count.
        sigma_px: standard deviation of a found column [px].
        ranges_m: where to say step and sigma, (N,); left out, round ones, or six over a short reach.

    Raises:
        CalibrationError: no column of this head has a return within the limits.
    """
    own = head.intrinsics
    ranges = np.array(RANGES_M) if ranges_m is None else ranges_m
    row = float(np.clip(round(own.cy), 0, own.height - 1))
    window = column_window(head, limits)[int(row)]
    if not np.isfinite(window).all():
        raise CalibrationError(
            f"{name}: this camera never sees the laser between {limits.range_min_m:g} and {limits.range_max_m:g} m; "
            "turn it in by another beta, or take a wider lens"
        )
    column = np.linspace(window[0], window[1], 4001)
    _, distance, slope = _ranges(head, column, row, limits)
    order = np.argsort(distance)
    nearest, farthest = distance[order[0]], distance[order[-1]]
    if ranges_m is None and np.count_nonzero((ranges >= nearest) & (ranges <= farthest)) < 3:
        ranges = np.geomspace(nearest, farthest, 6)
    # The window's ends are found by bisection: a little beside the limits.
    inside = (ranges >= 0.999 * nearest) & (ranges <= 1.001 * farthest)
    # Ranges are nearly inverse to the column, so it is the inverse that is interpolated.
    at = np.where(inside, np.interp(-1.0 / ranges, -1.0 / distance[order], column[order]), np.nan)
    step = np.where(inside, np.exp(np.interp(np.log(ranges), np.log(distance[order]), np.log(slope[order]))), np.nan)
    up, down, rows_per_deg = _upright_view(head, limits, min(2.0, float(farthest)))
    return Design(
        name=name, baseline_m=head.baseline_m, beta_deg=float(np.degrees(head.beta)),
        alpha_deg=float(np.degrees(head.alpha)), size=(own.width, own.height), nearest_m=float(nearest),
        farthest_m=float(farthest), column_infinity=_infinity(head, row), columns_used=float(window[1] - window[0]),
        view_up_deg=up, view_down_deg=down, rows_per_deg=rows_per_deg, ranges_m=ranges, column=at, step_m=step,
        sigma_m=step * sigma_px, model_error=_model_error(head, column, row),
    )  # fmt: skip


def curve(head: Calibration, limits: TriangulationParams) -> tuple[Array, Array, Array]:
    """Columns, ranges [m] and range steps [m/px] of the middle row, (N,) each, over all that is seen."""
    own = head.intrinsics
    row = float(np.clip(round(own.cy), 0, own.height - 1))
    window = column_window(head, limits)[int(row)]
    return _ranges(head, np.linspace(window[0], window[1], 2001), row, limits)


def points_on_wall(design: Design, distance_m: float, width_m: float, height_m: float, step_deg: float) -> int:
    """About how many points a scan puts on a wall straight ahead, upright, its middle at laser height."""
    bearings = 2.0 * np.degrees(np.arctan(0.5 * width_m / distance_m)) / step_deg
    half = float(np.degrees(np.arctan(0.5 * height_m / distance_m)))
    seen = min(half, design.view_up_deg) + min(half, design.view_down_deg)
    return int(bearings * max(seen, 0.0) * design.rows_per_deg)


def _ranges(head: Calibration, column: Array, row: float, limits: TriangulationParams) -> tuple[Array, Array, Array]:
    points, slope, _ = locate(column, np.full(len(column), row), head, TriangulationParams(
        range_min_m=limits.range_min_m, range_max_m=limits.range_max_m))  # fmt: skip
    distance = np.linalg.norm(points, axis=1)
    known = np.isfinite(distance)
    return column[known], distance[known], slope[known]


def _infinity(head: Calibration, row: float) -> float:
    """Column in which the ray runs parallel to the laser plane."""
    own = head.intrinsics
    column = np.linspace(-0.5, own.width - 0.5, 20_001)
    toward = own.rays(column, np.full(len(column), row)) @ head.T_head_camera[:3, :3].T @ head.laser_plane[:3]
    change = np.flatnonzero(np.diff(np.sign(toward)) != 0)
    if not change.size:
        return float("nan")
    k = int(change[0])
    return float(column[k] - toward[k] * (column[k + 1] - column[k]) / (toward[k + 1] - toward[k]))


def _upright_view(head: Calibration, limits: TriangulationParams, distance_m: float) -> tuple[float, float, float]:
    """How far up and down the laser plane is seen at a range [deg], and how many rows a degree has there."""
    own = head.intrinsics
    row = np.arange(own.height, dtype=np.float64)
    window = column_window(head, limits)
    elevation = np.full(own.height, np.nan)
    for k in np.flatnonzero(np.isfinite(window[:, 0])):
        column = np.linspace(window[k, 0], window[k, 1], 65)
        points, _, _ = locate(column, np.full(65, row[k]), head, limits)
        reach = np.linalg.norm(points, axis=1)
        some = np.isfinite(reach)
        if some.sum() > 1 and reach[some].min() <= distance_m <= reach[some].max():
            inverse = 1.0 / reach[some]
            order = np.argsort(inverse)
            x, y, z = (np.interp(1.0 / distance_m, inverse[order], points[some][order, axis]) for axis in range(3))
            elevation[k] = np.degrees(np.arctan2(z, np.hypot(x, y)))
    known = elevation[np.isfinite(elevation)]
    if known.size < 2:
        return 0.0, 0.0, 0.0
    return float(known.max()), float(-known.min()), float((known.size - 1) / max(np.ptp(known), 1e-9))


def _model_error(head: Calibration, column: Array, row: float) -> str:
    """How far Algorithms 1 and 2 are off this head between 0.3 and 3 m."""
    words = []
    for model in ("ratio", "pixel_angle"):
        try:
            points, _, below = locate(column, np.full(len(column), row), head, TriangulationParams(model=model))
        except CalibrationError:
            return "the thesis's models do not hold for this head"
        exact = locate(column, np.full(len(column), row), head, TriangulationParams())[0]
        depth = np.where(below, np.nan, points[:, 0])
        near = (exact[:, 0] > 0.3) & (exact[:, 0] < 3.0) & np.isfinite(depth)
        if near.any():
            words.append(f"{model} {100.0 * np.abs(depth[near] / exact[near, 0] - 1.0).max():.1f} %")
    if not words:
        return "nothing in view from 0.3 to 3 m to compare the thesis's models by"
    return "worst error against the plane model from 0.3 to 3 m: " + ", ".join(words)
