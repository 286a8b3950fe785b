"""The camera: pinhole with Brown-Conrady distortion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A ray that comes back this near to its pixel is its own, and this near is near enough.
_SAME_PX, _EXACT_PX = 1e-3, 1e-6
_TABLE, _NEWTON_STEPS = 1000, 8


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole with Brown-Conrady distortion, OpenCV's convention, pixels; pixel centres at integers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1 k2 p1 p2 k3

    @cached_property
    def matrix(self) -> Array:
        """(3, 3) camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.distortion)

    def rays(self, column: Array, row: Array) -> Array:
        """Directions (..., 3) with z = 1 in the camera frame of pixels `column`, `row` (...,); NaN passes.

        NaN too where no ray comes out at the pixel: a polynomial that folds over inside the image.
        """
        if not self.distorted:
            x = (column - self.cx) / self.fx
            y = (row - self.cy) / self.fy
            return np.stack([x, y, np.ones_like(x)], axis=-1)
        shape = np.shape(column)
        known = np.isfinite(column).ravel()
        xy = np.full((known.size, 2), np.nan)
        if known.any():
            pixels = np.stack([column.ravel()[known], row.ravel()[known]], axis=-1)
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
            found: Array = cv2.undistortPoints(
                pixels[:, None], self.matrix, np.array(self.distortion), None, None, None, criteria
            )[:, 0].astype(np.float64)
            lost = np.flatnonzero(~(self._off_px(found, pixels) < _EXACT_PX))
            if lost.size:
                found[lost] = self._undistorted(pixels[lost])
                found[lost[~(self._off_px(found[lost], pixels[lost]) < _SAME_PX)]] = np.nan
            xy[known] = found
        return np.concatenate([xy, np.ones((known.size, 1))], axis=1).reshape(*shape, 3)

    def rays_per_column(self, rays: Array) -> Array:
        """Derivative (..., 3) of `rays` (..., 3) by the pixel's column [1/px]: the distortion's Jacobian, inverted."""
        if not self.distorted:
            return np.broadcast_to(np.array([1.0 / self.fx, 0.0, 0.0]), rays.shape)
        j_xx, j_xy, j_yy = self._stretches(rays[..., 0], rays[..., 1])
        with np.errstate(divide="ignore", invalid="ignore"):  # where a polynomial folds over
            per_column = 1.0 / ((j_xx * j_yy - j_xy * j_xy) * self.fx)
            return np.stack([j_yy * per_column, -j_xy * per_column, np.zeros_like(j_xx)], axis=-1)

    def project(self, points_cam: Array) -> Array:
        """Pixels (..., 2) column, row of points (..., 3) [m] in the camera frame; NaN behind the camera."""
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(points_cam[..., 2] > 0, points_cam[..., 2], np.nan)
            x, y = points_cam[..., 0] / z, points_cam[..., 1] / z
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=-1)

    @cached_property
    def _fold(self) -> float:
        """Distance from the axis, at z = 1, from which on the lens folds over; a million if it does not."""
        k1, k2, _, _, k3 = self.distortion
        inverse_squares = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3])
        real = inverse_squares.real[np.abs(inverse_squares.imag) < 1e-9]
        return float(1.0 / np.sqrt(max(real.max(initial=0.0), 1e-12)))

    def _off_px(self, xy: Array, pixels: Array) -> Array:
        """How far (N,) from their pixels (N, 2) rays (N, 2) come back [px]; endlessly beyond the fold."""
        back = self.project(np.concatenate([xy, np.ones((len(xy), 1))], axis=1))
        off: Array = np.where(np.hypot(xy[:, 0], xy[:, 1]) < self._fold, np.abs(back - pixels).max(axis=1), np.inf)
        return off

    def _undistorted(self, pixels: Array) -> Array:
        """Rays (N, 2) of pixels (N, 2), for strong lenses where OpenCV's fixed point is not reached.

        Of the radial part, which grows up to the fold, by a table; the rest by Newton's method.
        """
        focal, centre = np.array([self.fx, self.fy]), np.array([self.cx, self.cy])
        seen = (pixels - centre) / focal
        k1, k2, _, _, k3 = self.distortion
        away = np.tan(np.linspace(0.0, np.arctan(self._fold), _TABLE)[:-1])
        r2 = np.square(away)
        far = np.hypot(seen[:, 0], seen[:, 1])
        found = np.interp(far, away * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))), away)
        xy: Array = seen * (found / np.maximum(far, 1e-12))[:, None]
        for _ in range(_NEWTON_STEPS):
            off = (self.project(np.concatenate([xy, np.ones((len(xy), 1))], axis=1)) - pixels) / focal
            j_xx, j_xy, j_yy = self._stretches(xy[:, 0], xy[:, 1])
            with np.errstate(all="ignore"):  # where no ray comes out
                per_area = 1.0 / (j_xx * j_yy - j_xy * j_xy)
                x = (j_yy * off[:, 0] - j_xy * off[:, 1]) * per_area
                y = (j_xx * off[:, 1] - j_xy * off[:, 0]) * per_area
                xy = xy - np.stack([x, y], axis=1)
        return xy

    def _stretches(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Derivatives of the distorted place of rays (x, y, 1): x by x, x by y (and y by x), y by y."""
        k1, k2, p1, p2, k3 = self.distortion
        xx, xy, yy = x * x, x * y, y * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        twice = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))
        return (
            radial + xx * twice + 2.0 * p1 * y + 6.0 * p2 * x,
            xy * twice + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + yy * twice + 6.0 * p1 * y + 2.0 * p2 * x,
        )
