"""The twin's own camera model: where points land on the sensor, and which way its pixels look.

Written from the formulas, apart from the code that the twin is there to test.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.geometry import inverse

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class Lens:
    """Pinhole with Brown-Conrady distortion of a calibration's camera.

    Source: Brown 1966, Conrady 1919, in the coefficients of OpenCV (k1 k2 p1 p2 k3).
    """

    def __init__(self, calibration: Calibration) -> None:
        self._own = calibration.intrinsics
        self._T_camera_head = inverse(calibration.T_head_camera)
        self._fold_radius2 = self._find_fold()

    def project(self, points_head: F64) -> F64:
        """Pixels (N, 2) column, row of head-frame points (N, 3); NaN behind the camera."""
        p = points_head @ self._T_camera_head[:3, :3].T + self._T_camera_head[:3, 3]
        depth = np.where(p[:, 2] > 1e-6, p[:, 2], np.nan)
        xy = p[:, :2] / depth[:, None]
        # Far outside the picture the polynomial may fold back into it.
        beyond = (xy**2).sum(axis=1) > self._fold_radius2
        xy = self._bent(xy)
        xy[beyond] = np.nan
        return xy * [self._own.fx, self._own.fy] + [self._own.cx, self._own.cy]

    def rays(self, columns: F64, rows: F64) -> F32:
        """Directions (N, 3) in the camera frame, z = 1, of pixels `columns`, `rows` (N,)."""
        wanted = np.stack([(columns - self._own.cx) / self._own.fx, (rows - self._own.cy) / self._own.fy], axis=-1)
        xy = wanted.copy()
        if any(self._own.distortion):
            for _ in range(12):
                xy += wanted - self._bent(xy)
        return np.concatenate([xy, np.ones((len(xy), 1))], axis=1).astype(np.float32)

    def _bent(self, xy: F64) -> F64:
        k1, k2, p1, p2, k3 = self._own.distortion
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return np.stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
            axis=-1,
        )

    def _find_fold(self) -> float:
        """Squared radius up to which r (1 + k1 r^2 + k2 r^4 + k3 r^6) grows."""
        k1, k2, _, _, k3 = self._own.distortion
        r2 = np.linspace(0.0, 25.0, 2001)
        falling = np.flatnonzero(1 + 3 * k1 * r2 + 5 * k2 * r2**2 + 7 * k3 * r2**3 <= 0)
        return float(r2[falling[0]]) if len(falling) else np.inf
