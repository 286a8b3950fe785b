"""The thesis's way to a calibration: a few measured distances, and the three range models fitted to them.

All fits minimise the sum of squared relative errors d_model / d_measured - 1; Algorithm 2 is the straight line
theta = rpc ppx + ro through theta = atan(x / d), as the thesis says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration, CalibrationFile, PixelAngleModel, RatioModel
from scanmap.errors import CalibrationError
from scanmap.solvers.pairs import Pairs, once_each
from scanmap.triangulation import pixel_angle_depth, ratio_depth

Array = NDArray[np.float64]

# The constants the thesis prints, and those its table of Algorithm 2 follows from.
PUBLISHED_RATIO = RatioModel(32.3, 25.7, 0.08, 1600)
PUBLISHED_ANGLE = PixelAngleModel(0.0439, -8.7683, 0.08)
TABLE_ANGLE = PixelAngleModel(0.044, -8.768, 0.08)


@dataclass(frozen=True)
class PinholeModel:
    """The exact pinhole head: d = x / tan(beta + atan(((2 ppx + 1) / l - 1) tan alpha))."""

    alpha_deg: float
    beta_deg: float
    baseline_m: float
    width: int  # [px] l

    def depth(self, column: Array) -> Array:
        """Depth d [m] at `column` (N,) [px]."""
        alpha, beta = np.radians([self.alpha_deg, self.beta_deg])
        with np.errstate(divide="ignore"):
            depth: Array = self.baseline_m / np.tan(
                beta + np.arctan(((2.0 * column + 1.0) / self.width - 1.0) * np.tan(alpha))
            )
        return depth

    def infinity(self) -> float:
        """Column [px] at which depth is infinite."""
        alpha, beta = np.radians([self.alpha_deg, self.beta_deg])
        return float(((1.0 - np.tan(beta) / np.tan(alpha)) * self.width - 1.0) / 2.0)


@dataclass(frozen=True)
class TableFit:
    """The models fitted to a table, in the columns of a head whose near returns are on the right."""

    width: int
    mirrored: bool  # the table's near returns are on the left: its columns were counted from the other side
    ratio: RatioModel
    angle: PixelAngleModel  # the thesis's straight line through the angles
    angle_by_distance: PixelAngleModel  # the same model by relative errors of distance: better where it is far
    pinhole: PinholeModel  # baseline as it was measured
    free: PinholeModel | None  # baseline fitted too; None where the table cannot tell it
    best: PinholeModel  # of the two, the one that predicts a row left out better
    infinity_slack: float  # [%] of the distance a pixel makes at the farthest row: what a whole column is worth


def columns_rightward(column: Array, width: int, mirrored: bool) -> Array:
    """Columns (N,) counted so that nearer is further right."""
    return width - 1.0 - column if mirrored else column


def fit_table(pairs: Pairs, width: int, baseline_m: float, chosen: NDArray[np.intp]) -> TableFit:
    """Fit all models to the rows `chosen` of a table.

    Args:
        pairs: with columns, `check_fit` passed.
        width: of the image along the axis the line moves on [px].
        baseline_m: camera to laser, by ruler.

    Raises:
        CalibrationError: the distances do not fall or rise with the column: no head measures that.
    """
    column, distance = once_each(pairs.column[chosen], pairs.distance_m[chosen])
    trend = float(np.corrcoef(column, 1.0 / distance)[0, 1])
    if abs(trend) < 0.8:
        raise CalibrationError(
            f"the distances do not follow the columns (correlation of 1/d with ppx {trend:.2f}, a head has nearly 1): "
            "is a row wrong, or are the pixels of the other axis in the table?"
        )
    u = columns_rightward(column, width, trend < 0)
    ratio = fit_ratio(u, distance, width, baseline_m)
    held = fit_pinhole(u, distance, ratio)
    free = fit_pinhole(u, distance, ratio, free_baseline=True) if len(u) >= 4 else None
    if free is not None and not 0.2 < free.baseline_m / baseline_m < 5.0:
        free = None
    best = held
    if free is not None and _left_out(u, distance, ratio, True) < _left_out(u, distance, ratio, False):
        best = free
    far = int(distance.argmax())
    slack = 100.0 * abs(float(best.depth(u[far] + 0.5) - best.depth(u[far] - 0.5))) / distance[far]
    angle = fit_angle(u, distance, baseline_m)
    return TableFit(width, trend < 0, ratio, angle, refine_angle(u, distance, angle), held, free, best, slack)


def fit_ratio(column: Array, distance: Array, width: int, baseline_m: float) -> RatioModel:
    """Algorithm 1's alpha and beta. The baseline is held: it only scales both tangents."""

    def model(x: Array) -> RatioModel:
        alpha, beta = np.degrees(np.arctan(x))
        return RatioModel(float(alpha), float(beta), baseline_m, width)

    # 1 / d is linear in p: x / d = (ta + tb) - 2 p ta.
    p = (width - column) / width
    slope, start = np.polyfit(p, baseline_m / distance, 1)
    tan_a = max(-0.5 * slope, 1e-3)
    return model(_solve(lambda x: ratio_depth(column, model(x)) / distance - 1.0, [tan_a, start - tan_a]))


def fit_angle(column: Array, distance: Array, baseline_m: float) -> PixelAngleModel:
    """Algorithm 2's rpc and ro: the straight line through atan(x / d)."""
    rpc, ro = np.polyfit(column, np.degrees(np.arctan(baseline_m / distance)), 1)
    return PixelAngleModel(float(rpc), float(ro), baseline_m)


def refine_angle(column: Array, distance: Array, start: PixelAngleModel) -> PixelAngleModel:
    """Algorithm 2's rpc and ro by least relative errors of distance."""

    def model(x: Array) -> PixelAngleModel:
        return PixelAngleModel(float(x[0]), float(x[1]), start.baseline_m)

    return model(_solve(lambda x: pixel_angle_depth(column, model(x)) / distance - 1.0, [start.rpc_deg, start.ro_deg]))


def fit_pinhole(column: Array, distance: Array, start: RatioModel, *, free_baseline: bool = False) -> PinholeModel:
    """The pinhole head's alpha and beta, and x if it is free."""

    def model(x: Array) -> PinholeModel:
        alpha, beta = np.degrees(np.arctan(x[0])), np.degrees(x[1])
        return PinholeModel(float(alpha), float(beta), float(x[2] if free_baseline else start.baseline_m), start.width)

    first = [np.tan(np.radians(start.alpha_deg)), np.radians(start.beta_deg)]
    first += [start.baseline_m] if free_baseline else []
    return model(_solve(lambda x: model(x).depth(column) / distance - 1.0, first))


def calibration_of(fit: TableFit, height: int, base: Calibration | None = None) -> Calibration:
    """The fit as a calibration; on top of `base`, if there is one, only `[ratio]` and `[pixel_angle]` are new.

    A mirrored table makes a head whose camera stands right of the laser; the thesis's two models do not know such a
    head, so it has only the plane model.
    """
    if base is not None:
        return replace(base, ratio=fit.ratio, pixel_angle=fit.angle)
    best = fit.best
    document = {
        "image": {"width": fit.width, "height": height},
        "head": {"baseline_m": best.baseline_m, "beta_deg": best.beta_deg, "alpha_deg": best.alpha_deg},
    }
    head = CalibrationFile.model_validate(document).build()
    if not fit.mirrored:
        return replace(head, ratio=fit.ratio, pixel_angle=fit.angle)
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    # Mirrored at the laser plane, and the image with it: x right becomes x left, so the camera's axis is turned back.
    T = mirror @ head.T_head_camera @ np.diag([-1.0, 1.0, 1.0, 1.0])
    return replace(head, T_head_camera=T)


def depths_of(fit: TableFit, pairs: Pairs) -> dict[str, Array]:
    """Depths [m] of every row of the table by every fitted model; and by the published constants, if it has any."""
    u = columns_rightward(pairs.column, fit.width, fit.mirrored)
    depths = {
        "ratio fitted": ratio_depth(u, fit.ratio),
        "pixel_angle fitted": pixel_angle_depth(u, fit.angle),
        "pixel_angle by distance": pixel_angle_depth(u, fit.angle_by_distance),
        "pinhole fitted": fit.pinhole.depth(u),
    }
    if fit.free is not None:
        depths["pinhole with x fitted"] = fit.free.depth(u)
    if pairs.published:
        depths["ratio recomputed"] = ratio_depth(u, PUBLISHED_RATIO)
        depths["pixel_angle recomputed"] = pixel_angle_depth(u, TABLE_ANGLE)
    return depths


def _solve(residual: Callable[[Array], Array], start: list[float]) -> Array:
    from scipy.optimize import least_squares

    solution = least_squares(residual, start, x_scale=np.maximum(np.abs(start), 1e-3), xtol=1e-12, ftol=1e-12)
    if not np.isfinite(solution.x).all():
        raise CalibrationError("no head fits these distances: the fit did not converge; look at the rows of the table")
    found: Array = solution.x
    return found


def _left_out(column: Array, distance: Array, start: RatioModel, free_baseline: bool) -> float:
    """Rms relative error of rows predicted by a fit to the others (cross-validation)."""
    errors = []
    for k in range(len(column)):
        rest = np.arange(len(column)) != k
        model = fit_pinhole(column[rest], distance[rest], start, free_baseline=free_baseline)
        errors.append(model.depth(column[k : k + 1])[0] / distance[k] - 1.0)
    worst = float(np.sqrt(np.mean(np.square(errors))))
    return worst if np.isfinite(worst) else np.inf
