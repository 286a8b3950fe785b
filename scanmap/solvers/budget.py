"""What the uncertainty of a calibration means for a measured point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanmap.calibration import Calibration
from scanmap.calibration.uncertainty import Uncertainty, moved, uncertainty_of
from scanmap.geometry import transform
from scanmap.triangulation import TriangulationParams, locate

Array = NDArray[np.float64]


def deviations(known: Uncertainty) -> Array:
    """One-sigma steps (D, N) along the principal directions of a covariance over N parameters, those not nil.

    Units differ by orders of magnitude (focal lengths in pixels, offsets in metres), so it is the correlation that is
    taken apart.
    """
    scale = np.sqrt(np.clip(np.diag(known.matrix), 0.0, None))
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(known.matrix / np.outer(scale, scale))
    some = values > 1e-9
    steps: Array = (vectors[:, some] * np.sqrt(values[some])).T * scale
    return steps


def calibration_sigma(calibration: Calibration, ranges_m: Array) -> Array:
    """Standard deviation (N,) [m] along the view that a calibration's own covariance gives points at ranges (N,).

    For the middle row, in the world at bearing 0. It is common to all points there, no scatter: averaging does not make
    it smaller. NaN where the calibration states no covariance, or a range is out of view.

    Source: first-order propagation, var = sum of squared displacements by one deviation of each principal direction.
    """
    known = uncertainty_of(calibration)
    column = _columns_at(calibration, ranges_m)
    if known is None or not np.isfinite(column).any():
        return np.full(len(ranges_m), np.nan)
    row = np.full(len(column), _middle_row(calibration))
    here = _world(calibration, column, row)
    view = here - np.array(calibration.mount.offset_m)
    view /= np.linalg.norm(view, axis=1)[:, None]
    variance = np.zeros(len(column))
    for step in deviations(known):
        ahead, behind = (_world(moved(calibration, known.names, s), column, row) for s in (step, -step))
        variance += (0.5 * (ahead - behind) * view).sum(axis=1) ** 2
    sigma: Array = np.sqrt(variance)
    return sigma


def _middle_row(calibration: Calibration) -> float:
    own = calibration.intrinsics
    return float(np.clip(round(own.cy), 0, own.height - 1))


def _world(calibration: Calibration, column: Array, row: Array) -> Array:
    points, _, _ = locate(column, row, calibration, TriangulationParams())
    return transform(calibration.mount.T_axis_head(), points)


def _columns_at(calibration: Calibration, ranges_m: Array) -> Array:
    """Columns (N,) of the middle row in which ranges (N,) are seen; NaN out of view."""
    column = np.linspace(0.0, calibration.intrinsics.width - 1.0, 4001)
    points, _, _ = locate(column, np.full(len(column), _middle_row(calibration)), calibration, TriangulationParams())
    distance = np.linalg.norm(points, axis=1)
    known = np.isfinite(distance)
    if known.sum() < 2:
        return np.full(len(ranges_m), np.nan)
    order = np.argsort(distance[known])
    far, at = distance[known][order], column[known][order]
    found = np.interp(-1.0 / ranges_m, -1.0 / far, at)
    return np.where((ranges_m >= far[0]) & (ranges_m <= far[-1]), found, np.nan)
