"""The camera: pinhole with Brown-Conrady distortion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
            found = cv2.undistortPoints(
                pixels[:, None], self.matrix, np.array(self.distortion), None, None, None, criteria
            )[:, 0]
            back = self.project(np.concatenate([found, np.ones((len(found), 1))], axis=1))
            found[~(np.abs(back - pixels).max(axis=1) < 1e-3)] = np.nan
            xy[known] = found
        return np.concatenate([xy, np.ones((known.size, 1))], axis=1).reshape(*shape, 3)

    def rays_per_column(self, rays: Array) -> Array:
        """Derivative (..., 3) of `rays` (..., 3) by the pixel's column [1/px]: the distortion's Jacobian, inverted."""
        if not self.distorted:
            return np.broadcast_to(np.array([1.0 / self.fx, 0.0, 0.0]), rays.shape)
        x, y = rays[..., 0], rays[..., 1]
        k1, k2, p1, p2, k3 = self.distortion
        xx, xy, yy = x * x, x * y, y * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        twice = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))
        j_xx = radial + xx * twice + 2.0 * p1 * y + 6.0 * p2 * x
        j_xy = xy * twice + 2.0 * p1 * x + 2.0 * p2 * y
        j_yy = radial + yy * twice + 6.0 * p1 * y + 2.0 * p2 * x
        with np.errstate(divide="ignore", invalid="ignore"):  # where a polynomial folds over
            per_column = 1.0 / ((j_xx * j_yy - j_xy * j_xy) * self.fx)
            return np.stack([j_yy * per_column, -j_xy * per_column, np.zeros_like(x)], axis=-1)

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
