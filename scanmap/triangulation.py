"""The three range models: `LaserLine` to `Profile`, columns to points in the head frame.

`plane` is the calibrated ray met with the laser plane. `ratio` and `pixel_angle` are Algorithms 1 and 2 of
the thesis, kept exact with their limits; the height of a point follows from the pinhole ray.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator

from scanmap.calibration import Calibration, PixelAngleModel, RatioModel
from scanmap.errors import CalibrationError
from scanmap.geometry import intersect_rays_plane
from scanmap.laserline import LaserLine, Reason

Array = NDArray[np.float64]

# Algorithm 2 is valid below this angle only; the thesis's limit.
THETA_MAX_DEG = 60.0
# Sampling of an image row in search of the columns a return can have.
WINDOW_STEP_PX = 8.0


class TriangulationParams(BaseModel, frozen=True, extra="forbid"):
    """Which range model turns columns into points, and between which ranges; `[triangulation]`."""

    model: Literal["plane", "ratio", "pixel_angle"] = Field(
        "plane", description="plane: calibrated ray meets laser plane; ratio, pixel_angle: Algorithms 1, 2"
    )
    range_min_m: float = Field(0.04, ge=0, description="nearer points are taken for no return [m]")
    range_max_m: float = Field(8.0, gt=0, description="farther points are taken for no return [m]")

    @model_validator(mode="after")
    def _ordered(self) -> TriangulationParams:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(f"range_min_m {self.range_min_m} must be below range_max_m {self.range_max_m}")
        return self


class Profile(NamedTuple):
    """What one shot measured. Arrays of length H, the image's rows; NaN where a row has no point."""

    points: Array  # (H, 3) head frame [m]
    range_m: Array  # (H,) distance from the head's origin
    sigma_m: Array  # (H,) |dP/du| sigma_px, standard deviation along the ray
    intensity: Array  # (H,) line height above the background [grey levels]
    column_px: Array  # (H,) the laser line's column the point came from
    reason: NDArray[np.uint8]  # (H,) Reason


def ratio_depth(column: Array, model: RatioModel) -> Array:
    """Depth d [m] of Algorithm 1 at `column` [px]; negative or infinite left of infinity.

    Source: p = (l - ppx) / l, d = x / ((tan a + tan b) - 2 p tan a), equations 7 to 12 of the thesis.
    """
    tan_a, tan_b = np.tan(np.radians([model.alpha_deg, model.beta_deg]))
    p = pixel_ratio(column, model.width)
    with np.errstate(divide="ignore"):
        depth: Array = model.baseline_m / ((tan_a + tan_b) - 2.0 * p * tan_a)
    return depth


def pixel_ratio(column: Array, width: int) -> Array:
    """The thesis's p = (l - ppx) / l."""
    return (width - column) / width


def pixel_angle_depth(column: Array, model: PixelAngleModel) -> Array:
    """Depth d [m] of Algorithm 2 at `column` [px], the bare formula without its 60 deg limit.

    Source: theta = rpc ppx + ro in degrees, d = x / tan(theta).
    """
    theta = np.radians(model.rpc_deg * column + model.ro_deg)
    with np.errstate(divide="ignore"):
        depth: Array = model.baseline_m / np.tan(theta)
    return depth


def ratio_model_of(calibration: Calibration) -> RatioModel:
    """`[ratio]` of the calibration, or the same head in Algorithm 1's terms where it has none."""
    if calibration.ratio is not None:
        return calibration.ratio
    alpha, beta = np.degrees([calibration.alpha, calibration.beta])
    return RatioModel(float(alpha), float(beta), _baseline(calibration), calibration.intrinsics.width)


def pixel_angle_model_of(calibration: Calibration) -> PixelAngleModel:
    """`[pixel_angle]` of the calibration, or the straight line through its pinhole angles where it has none."""
    if calibration.pixel_angle is not None:
        return calibration.pixel_angle
    own = calibration.intrinsics
    column = np.arange(own.width, dtype=np.float64)
    theta = np.degrees(calibration.beta + np.arctan((column - own.cx) / own.fx))
    usable = (theta > 0) & (theta < THETA_MAX_DEG)
    if usable.sum() < 2:
        raise CalibrationError("pixel_angle model: no column of this head lies between 0 and 60 deg; use model plane")
    rpc, ro = np.polyfit(column[usable], theta[usable], 1)
    return PixelAngleModel(float(rpc), float(ro), _baseline(calibration))


def triangulate(line: LaserLine, calibration: Calibration, params: TriangulationParams) -> Profile:
    """Points of one laser line in the head frame.

    Args:
        line: columns per image row, (H,).
        calibration: the head; its image height must be H.
        params: range model and limits.

    Returns:
        Profile of length H; rows without a column, below or beyond range are NaN with their reason.

    Raises:
        CalibrationError: H is not the calibration's image height.
    """
    return triangulate_all([line], calibration, params)[0]


def triangulate_all(lines: Sequence[LaserLine], calibration: Calibration, params: TriangulationParams) -> list[Profile]:
    """What `triangulate` gives for each of the lines, bit for bit, sooner."""
    rows = calibration.intrinsics.height
    for line in lines:
        if len(line.column_px) != rows:
            height = len(line.column_px)
            raise CalibrationError(f"laser line has {height} rows, the calibration {rows}")
    column, peak, _, sigma, reason = (np.concatenate(values) for values in zip(*lines, strict=True))
    row = np.tile(np.arange(rows, dtype=np.float64), len(lines))
    points, slope, below = locate(column, row, calibration, params)
    range_m = np.sqrt(np.square(points[:, 0]) + np.square(points[:, 1]) + np.square(points[:, 2]))
    found = reason == Reason.OK
    reason[found & ~(range_m <= params.range_max_m)] = Reason.BEYOND_RANGE
    reason[found & (below | (range_m < params.range_min_m))] = Reason.BELOW_RANGE
    lost = reason != Reason.OK
    for values in (points, range_m, slope, peak, column):
        values[lost] = np.nan
    sigma *= slope
    each = [slice(k, k + rows) for k in range(0, len(reason), rows)]
    return [Profile(points[k], range_m[k], sigma[k], peak[k], column[k], reason[k]) for k in each]


def locate(
    column: Array, row: Array, calibration: Calibration, params: TriangulationParams
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Points of pixels under the chosen range model.

    Args:
        column, row: (N,) pixel coordinates, NaN allowed.

    Returns:
        points (N, 3) in the head frame [m], NaN at and beyond infinity; |dP/du| (N,) [m/px]; and whether
        the model says "below range" (N,).
    """
    if params.model == "plane":
        return _locate_on_plane(column, row, calibration)
    if params.model == "ratio":
        model = ratio_model_of(calibration)
        return _locate_by_depth(column, row, calibration, lambda u: ratio_depth(u, model), None)
    angle = pixel_angle_model_of(calibration)
    # The limit stands a rounding error below 60, so that a column exactly at it is below range.
    limit = (THETA_MAX_DEG - angle.ro_deg) / angle.rpc_deg - 1e-9
    return _locate_by_depth(column, row, calibration, lambda u: pixel_angle_depth(u, angle), limit)


def column_window(calibration: Calibration, params: TriangulationParams) -> Array:
    """First and last column (H, 2) a return between range_min and range_max can have, per image row.

    NaN in rows that can have none. Nothing outside is ever the laser line: geometry is a filter.
    """
    own = calibration.intrinsics
    row = np.arange(own.height, dtype=np.float64)
    coarse = np.append(np.arange(0.0, own.width - 1, WINDOW_STEP_PX), own.width - 1.0)
    column = np.tile(coarse, (own.height, 1))
    place = _against_limits(column, row, calibration, params)
    window = _hull(column, place, row, calibration, params)
    # Limits so close together that they fall between two samples: from too near to too far in one step.
    skips = np.diff(place, axis=1)
    narrow = (np.abs(skips) == 2) & np.isnan(window[:, :1])
    some = np.flatnonzero(narrow.any(axis=1))
    if some.size:
        k = narrow[some].argmax(axis=1)
        fine = coarse[k, None] + (coarse[k + 1] - coarse[k])[:, None] * np.linspace(0.0, 1.0, 65)
        place = _against_limits(fine, row[some], calibration, params)
        window[some] = _hull(fine, place, row[some], calibration, params)
    return window


def _against_limits(
    column: Array, row: Array, calibration: Calibration, params: TriangulationParams
) -> NDArray[np.int8]:
    """Whether pixels (N, M) of rows (N,) lie too near (-1), between the limits (0), or too far (1)."""
    points, _, below = locate(column.ravel(), np.repeat(row, column.shape[1]), calibration, params)
    range_m = np.linalg.norm(points, axis=-1)
    near = below | (range_m < params.range_min_m)
    place = np.where(near, -1, np.where(range_m <= params.range_max_m, 0, 1))
    return place.astype(np.int8).reshape(column.shape)


def _hull(
    column: Array, place: NDArray[np.int8], row: Array, calibration: Calibration, params: TriangulationParams
) -> Array:
    """First and last column (N, 2) between the limits, by bisection between the samples `column` (N, M)."""
    inside = place == 0
    window = np.full((len(row), 2), np.nan)
    some = np.flatnonzero(inside.any(axis=1))
    last = column.shape[1] - 1
    edges = (inside[some].argmax(axis=1), last - inside[some, ::-1].argmax(axis=1))
    for side, (edge, outward) in enumerate(zip(edges, (-1, 1), strict=True)):
        good, bad = column[some, edge], column[some, np.clip(edge + outward, 0, last)]
        for _ in range(12):
            middle = 0.5 * (good + bad)
            fits = _against_limits(middle[:, None], row[some], calibration, params)[:, 0] == 0
            good, bad = np.where(fits, middle, good), np.where(fits, bad, middle)
        window[some, side] = good
    return window


def _baseline(calibration: Calibration) -> float:
    """Baseline [m] of a head the thesis's two models hold for."""
    baseline, plane = calibration.baseline_m, calibration.laser_plane
    if baseline < 1e-6:
        raise CalibrationError("this head has no baseline: its camera lies in the laser plane")
    side = plane[:3] @ calibration.T_head_camera[:3, 3] + plane[3]
    if side * (plane[:3] @ calibration.T_head_camera[:3, 0]) >= 0:
        raise CalibrationError(
            "models ratio and pixel_angle want near returns on the right of the image (camera left of the laser); "
            "this head has them on the left; use model plane"
        )
    return baseline


def _locate_on_plane(column: Array, row: Array, calibration: Calibration) -> tuple[Array, Array, NDArray[np.bool_]]:
    R, origin = calibration.T_head_camera[:3, :3], calibration.T_head_camera[:3, 3]
    plane = calibration.laser_plane
    seen = calibration.intrinsics.rays(column, row)
    rays = _turned(R, seen)
    t = intersect_rays_plane(origin, rays.T, plane)
    t[~(t > 0)] = np.nan  # beyond infinity the ray meets the plane behind the camera
    points = np.ascontiguousarray((origin[:, None] + t * rays).T)
    d_rays = _turned(R, calibration.intrinsics.rays_per_column(seen))
    # d/du of o + t r with n.(o + t r) + d = 0.
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray parallel to the plane, whose t is NaN
        slip = _along(plane, d_rays) / _along(plane, rays)
        slope = np.abs(t) * np.sqrt(np.square(d_rays - slip * rays).sum(axis=0))
    return points, slope, np.zeros(len(column), dtype=bool)


def _turned(R: Array, vectors: Array) -> Array:
    """Vectors (N, 3) turned by R, as (3, N): not by BLAS, whose sums depend on how many there are."""
    x, y, z = vectors.T
    turned: Array = R[:, :1] * x + R[:, 1:2] * y + R[:, 2:] * z
    return turned


def _along(normal: Array, vectors: Array) -> Array:
    """Components (N,) of vectors (3, N) along a normal."""
    along: Array = vectors[0] * normal[0] + vectors[1] * normal[1] + vectors[2] * normal[2]
    return along


def _locate_by_depth(
    column: Array, row: Array, calibration: Calibration, depth_of: Callable[[Array], Array], last_column: float | None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    own = calibration.intrinsics
    baseline, beta = _baseline(calibration), calibration.beta

    def point(u: Array) -> Array:
        depth = depth_of(u)
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.nan)
        height = -(row - own.cy) / own.fy * (depth * np.cos(beta) + baseline * np.sin(beta))
        return np.stack([depth, np.zeros_like(depth), height], axis=-1)

    points = point(column)
    h = 1e-3
    slope = np.linalg.norm(point(column + h) - point(column - h), axis=-1) / (2.0 * h)
    below = np.zeros(len(column), dtype=bool) if last_column is None else column >= last_column
    points[below] = np.nan
    return points, slope, below
