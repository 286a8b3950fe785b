"""How wide the line is where it falls: all bearings of a sweep together tell it.

The variance of the laser's sheet grows with the square of the range (a Gaussian beam; Siegman 1986, 17.1), and a camera
sees it divided by the square of the depth. A surface that slants across the sheet shows more of it, or less: by
|v x t| / |n t|, where t runs along the surface from one bearing to the next, v is the camera's ray and n the sheet's
normal, in the plane in which the head turns. The lens blurs it, and a tone curve widens what is bright. What these do
is fitted to the widths of all lines, and what is left over (a waist, a lens out of focus) is taken from medians by
column.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.laserline import MEAN_ROWS, means_along
from scanmap.scan import Scan

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Of lines by their columns, whose medians tell what is left over; lines of one, at least; lines in all that are enough.
_GROUPS, _LEAST, _ENOUGH = 16, 400, 40_000
_ROUNDS, _FAR = 8, 2.0  # of the fit, and what is far off it [its own scatter]
_MOST_BY_HEIGHT = 0.07  # that tone curves widen lines by; lines cut in half are lower, too, for another reason
_LEAST_SHARE = 0.25  # of the usual variance, that no line has less of
# Bearings that tell how a surface slants: texture is more than one's share nearer, another surface farther. It is known
# where it widens the line as much on both sides; and nothing is seen of surfaces the sheet hardly meets.
_APART, _FARTHEST = float(np.radians(1.0)), float(np.radians(15.0))
_BENT, _GRAZING = 0.03, 0.2


class Seen(NamedTuple):
    """Usual widths of some lines, arrays of one shape."""

    width_px: F64  # standard deviation of their profile; NaN where there is no line
    slant_known: Mask


class _Model(NamedTuple):
    """What the widths of a sweep's lines have in common."""

    # (3,) of the lens [px^2]; of the sheet, and what it grows by with the range, times the focal length's square.
    variance: F64
    least: float  # of the variance [px^2]
    by_height: float  # logarithm of the width by that of the height
    column: F64  # (G,) rising [px]
    rest: F64  # (G,) logarithm of what is left there


class Widths:
    """How wide the lines of a sweep usually are."""

    def __init__(self, scan: Scan, calibration: Calibration, shapes: Sequence[F32]) -> None:
        """Of a scan and the heights and widths of its lines, (2, H) for each bearing; `of` fits the model to them."""
        self._scan, self._shapes = scan, shapes
        self._model = _Model(np.zeros(3), 0.0, 0.0, np.zeros(1), np.zeros(1))
        T = np.stack([scan.mount.T_world_head(float(bearing)) for bearing in scan.bearings])
        T_camera = T @ calibration.T_head_camera
        self._camera, self._forward = T_camera[:, :3, 3], T_camera[:, :3, 2]
        self._across = T[:, :2, :3] @ calibration.laser_plane[:3]
        self._beside = _beside(scan.bearings)

    @classmethod
    def of(cls, scan: Scan, calibration: Calibration, shapes: Sequence[F32], asked: Mask) -> Widths | None:
        """From the lines `asked` (B, H) of a scan, whose heights and widths are `shapes`; None of too few."""
        if int(asked.sum()) < _LEAST:
            return None
        own, every = cls(scan, calibration, shapes), max(1, int(asked.sum()) // _ENOUGH)
        rows = np.arange(every // 2, scan.rows, every)
        height, width = (np.stack([shape[k, rows] for shape in shapes]).astype(np.float64) for k in (0, 1))
        terms, slant_known = own._terms(np.arange(len(scan)), rows)
        some = asked[:, rows] & np.isfinite(terms[-1]) & (width > 0.0)
        if np.count_nonzero(some & slant_known) >= _LEAST:
            some &= slant_known
        if np.count_nonzero(some) < _LEAST:
            return None
        own._model = _fitted(terms[:, some], height[some], width[some], scan.column_px[:, rows][some])
        return own

    def of_bearing(self, k: int) -> Seen:
        """Usual widths of the lines (H,) of one bearing."""
        seen = self._seen(np.array([k]), np.arange(self._scan.rows))
        return Seen(*(values[0] for values in seen))

    def ratios(self) -> tuple[F64, Mask]:
        """Logarithms (B, ceil(H / MEAN_ROWS)) of mean widths over the usual ones; and where the slant is known."""
        width = means_along(np.stack([shape[1] for shape in self._shapes]))
        rows = np.minimum(np.arange(width.shape[1]) * MEAN_ROWS + MEAN_ROWS // 2, self._scan.rows - 1)
        seen = self._seen(np.arange(len(self._scan)), rows)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.log(width / seen.width_px), seen.slant_known

    def _seen(self, bearings: Index, rows: Index) -> Seen:
        """Usual widths (N, M) of the lines of some bearings (N,) in some rows (M,)."""
        terms, slant_known = self._terms(bearings, rows)
        height = np.stack([self._shapes[k][0, rows] for k in bearings]).astype(np.float64)
        column = self._scan.column_px[np.ix_(bearings, rows)]
        return Seen(np.exp(_logarithm(self._model, terms, height, column)), slant_known)

    def _terms(self, bearings: Index, rows: Index) -> tuple[F64, Mask]:
        """What the variance (3, N, M) of lines is made of, and where the slant of what they lie on is known."""
        points = self._scan.points
        own = points[np.ix_(bearings, rows)].astype(np.float64)
        ray = own - self._camera[bearings, None]
        depth = (ray * self._forward[bearings, None]).sum(axis=-1)
        wider, at_end = [], np.zeros(len(bearings), bool)
        for beside in self._beside:
            at_end |= beside[bearings] < 0
            other = np.where(beside[bearings] < 0, bearings, beside[bearings])
            along = points[np.ix_(other, rows)][..., :2] - own[..., :2]
            met = np.abs((along * self._across[bearings, None]).sum(axis=-1))
            with np.errstate(invalid="ignore", divide="ignore"):
                shown = np.abs(ray[..., 0] * along[..., 1] - ray[..., 1] * along[..., 0])
                shown /= met * np.hypot(ray[..., 0], ray[..., 1])
                steep = met < _GRAZING * np.hypot(along[..., 0], along[..., 1])
            wider.append(np.where((beside[bearings] < 0)[:, None] | steep, np.nan, shown))
        # One side alone may lie beyond a corner: it is the best guess, and no more, unless the sweep ends there.
        first, second = (np.where(np.isfinite(one), one, other) for one, other in (wider, wider[::-1]))
        with np.errstate(invalid="ignore"):
            bent = ~(np.abs(first - second) < _BENT)
        slant = np.where(bent, np.nan, 0.5 * (first + second))
        known = np.isfinite(slant) & ((np.isfinite(wider[0]) & np.isfinite(wider[1])) | at_end[:, None])
        range_m = self._scan.range_m[np.ix_(bearings, rows)].astype(np.float64)
        sheet = np.square(np.where(np.isfinite(slant), slant, 1.0) / depth)
        return np.stack([np.ones_like(sheet), sheet, sheet * np.square(range_m)]), known


def _beside(bearings: F64) -> tuple[Index, Index]:
    """For each bearing (B,) [rad] the next one on either side that is far enough to tell a slant, -1 for none."""
    order = np.argsort(bearings, kind="stable")
    turns, place = bearings[order], np.arange(len(bearings))
    sides = []
    for at in (
        np.searchsorted(turns, turns + _APART - 1e-9),
        np.searchsorted(turns, turns - _APART + 1e-9, "right") - 1,
    ):
        inside = (at >= 0) & (at < len(turns))
        there = np.where(inside, at, place)
        near = inside & (np.abs(turns[there] - turns) <= _FARTHEST)
        side = np.empty(len(bearings), np.intp)
        side[order] = np.where(near, order[there], -1)
        sides.append(side)
    return sides[0], sides[1]


def _fitted(terms: F64, height: F64, width: F64, column: F32) -> _Model:
    """The model of lines (N,) of some heights and widths, at some columns."""
    measured, bright = np.square(width), np.log(height)
    weight, by_height = np.ones_like(width), 0.0
    for _ in range(_ROUNDS):
        even = measured * np.exp(-2.0 * by_height * bright)
        variance = _not_negative(terms * (weight / even), weight)
        least = _LEAST_SHARE * float(np.median(even))
        rest = 0.5 * np.log(measured / np.maximum(variance @ terms, least))
        aside, off = bright - np.average(bright, weights=weight), rest - np.average(rest, weights=weight)
        slope = float((weight * aside * off).sum() / max((weight * np.square(aside)).sum(), 1e-9))
        by_height = min(max(slope, 0.0), _MOST_BY_HEIGHT)
        rest = off - by_height * aside
        weight = 1.0 / (1.0 + np.square(rest / max(_FAR * 1.48 * float(np.median(np.abs(rest))), 1e-6)))
    model = _Model(variance, least, by_height, np.zeros(1), np.zeros(1))
    rest = np.log(width) - _logarithm(model, terms, height, column)
    groups = np.array_split(np.argsort(column, kind="stable"), max(1, min(_GROUPS, len(column) // _LEAST)))
    middle, left = (np.array([np.median(values[some]) for some in groups], np.float64) for values in (column, rest))
    return model._replace(column=middle, rest=left)


def _not_negative(terms: F64, values: F64) -> F64:
    """Least squares (T,) of values (N,) that are made of terms (T, N), none of them negative."""
    square, right = terms @ terms.T, terms @ values
    best, left = np.zeros(len(terms)), 0.0
    for some in range(1, 1 << len(terms)):
        own = [k for k in range(len(terms)) if some >> k & 1]
        part = np.linalg.lstsq(square[np.ix_(own, own)], right[own], rcond=1e-12)[0]
        gain = float(part @ right[own])
        if (part >= 0.0).all() and gain > left:
            best, left = np.zeros(len(terms)), gain
            best[own] = part
    return best


def _logarithm(model: _Model, terms: F64, height: F64, column: F32) -> F64:
    """Logarithms of the usual widths of lines."""
    with np.errstate(invalid="ignore", divide="ignore"):
        made = np.maximum(np.tensordot(model.variance, terms, 1), model.least)
        left = np.interp(column, model.column, model.rest)
        return np.asarray(0.5 * np.log(made) + model.by_height * np.log(height) + left)
